"""What the standards of museums allow, of the words that a crate uses: written out from LIDO 1.1 and the CIDOC CRM.

LIDO: for each element that a record has, its children in order as the schema has them (`?` at most one, `*` any
number, `+` at least one), and its attributes. CIDOC CRM 7.1.2 and CRMdig 3.2.1: classes with those that they are kinds
of, as far as the properties need them; properties with domain and range.
"""

import re
from xml.etree.ElementTree import Element

LIDO = "{http://www.lido-schema.org}"
LANGUAGE = "{http://www.w3.org/XML/1998/namespace}lang"
CHILDREN = {
    "lidoWrap": "lido+",
    "lido": "lidoRecID+ objectPublishedID* category? applicationProfile? descriptiveMetadata+ administrativeMetadata+",
    "descriptiveMetadata": "objectClassificationWrap objectIdentificationWrap eventWrap? objectRelationWrap?",
    "objectClassificationWrap": "objectWorkTypeWrap classificationWrap?",
    "objectWorkTypeWrap": "objectWorkType+",
    "objectIdentificationWrap": "titleWrap inscriptionsWrap? repositoryWrap? displayStateEditionWrap? "
    "objectDescriptionWrap? objectMeasurementsWrap? objectMaterialsTechWrap?",
    "titleWrap": "titleSet+",
    "titleSet": "appellationValue+ sourceAppellation*",
    "repositoryWrap": "repositorySet*",
    "repositorySet": "displayRepository* repositoryName? workID* repositoryLocation? sourceRepositorySet*",
    "repositoryName": "legalBodyID* legalBodyName* legalBodyWeblink*",
    "repositoryLocation": "placeID* namePlaceSet* gml* partOfPlace* placeClassification*",
    "namePlaceSet": "appellationValue+ sourceAppellation*",
    "eventWrap": "eventSet*",
    "eventSet": "displayEvent* event?",
    "event": "eventID* eventType roleInEvent* eventName* eventActor* culture* eventDate? periodName* eventPlace* "
    "eventMethod* eventMaterialsTech* eventObjectMeasurements* thingPresent* relatedEventSet* eventDescriptionSet*",
    "eventActor": "displayActorInRole* actorInRole?",
    "actorInRole": "actor roleActor* attributionQualifierActor* extentActor* sourceActorInRole*",
    "actor": "actorID* nameActorSet+ nationalityActor* vitalDatesActor* vitalPlaceActor* genderActor*",
    "nameActorSet": "appellationValue+ sourceAppellation*",
    "eventDate": "displayDate* date?",
    "resourceDateTaken": "displayDate* date?",
    "date": "earliestDate? latestDate?",
    "thingPresent": "displayObject* object?",
    "eventDescriptionSet": "descriptiveNoteID* descriptiveNoteValue* sourceDescriptiveNote*",
    "administrativeMetadata": "rightsWorkWrap? recordWrap resourceWrap?",
    "recordWrap": "recordID+ recordType recordSource+ recordRights* recordInfoSet* collection*",
    "recordSource": "legalBodyID* legalBodyName* legalBodyWeblink*",
    "resourceSource": "legalBodyID* legalBodyName* legalBodyWeblink*",
    "legalBodyName": "appellationValue+ sourceAppellation*",
    "resourceWrap": "resourceSet*",
    "resourceSet": "resourceID* resourceRepresentation* resourceType? resourceRelType* resourcePerspective* "
    "resourceDescription* resourceDateTaken? resourceSource* rightsResource*",
    "rightsResource": "rightsType* rightsDate? rightsHolder* creditLine*",
    **dict.fromkeys(
        ("objectWorkType", "eventType", "roleActor", "eventMethod", "recordType", "resourceType", "rightsType"),
        "conceptID* term*",
    ),
}
TEXT = {
    **dict.fromkeys(("lidoRecID", "recordID", "resourceID", "conceptID"), "needs type"),
    **dict.fromkeys(("workID", "earliestDate", "latestDate"), "may have type"),
    **dict.fromkeys(
        ("appellationValue", "sourceAppellation", "displayDate", "displayObject", "descriptiveNoteValue", "term"),
        "may have language",
    ),
    "resourceDescription": "may have language",
}
"""Elements with text instead of children."""


def lido_faults(element: Element) -> list[str]:
    """What the schema forbids in an element and below it."""
    name = element.tag.removeprefix(LIDO)
    children = [child.tag.removeprefix(LIDO) for child in element]
    attributes = set(element.attrib)
    if name in TEXT:
        needs = {LIDO + "type"} if TEXT[name] == "needs type" else set()
        allowed = {LANGUAGE} if "language" in TEXT[name] else {LIDO + "type"}
        sound = not children and (element.text or "").strip() and needs <= attributes <= allowed
        return [] if sound else [f"{name}: {element.text!r} {children} {attributes}"]
    model = "".join(
        f"(?:{part.rstrip('?*+')} ){part[-1] if part[-1] in '?*+' else ''}" for part in CHILDREN.get(name, "").split()
    )
    needs = {LANGUAGE} if name.endswith("Metadata") else set()
    faults = [fault for child in element for fault in lido_faults(child)]
    if name not in CHILDREN or not re.fullmatch(model, "".join(f"{child} " for child in children)):
        faults.append(f"{name}: has {children}")
    if attributes != needs or (element.text or "").strip():
        faults.append(f"{name}: has {attributes}, text {element.text!r}")
    return faults


KINDS_OF = {
    "dig:D1_Digital_Object": ["crm:E73_Information_Object"],
    "dig:D2_Digitization_Process": ["dig:D11_Digital_Measurement_Event"],
    "dig:D7_Digital_Machine_Event": ["crm:E65_Creation"],
    "dig:D8_Digital_Device": ["crm:E22_Human-Made_Object"],
    "dig:D9_Data_Object": ["crm:E54_Dimension", "dig:D1_Digital_Object"],
    "dig:D10_Software_Execution": ["dig:D7_Digital_Machine_Event"],
    "dig:D11_Digital_Measurement_Event": ["dig:D7_Digital_Machine_Event", "crm:E16_Measurement"],
    "dig:D14_Software": ["dig:D1_Digital_Object"],
    "crm:E5_Event": ["crm:E4_Period"],
    "crm:E4_Period": ["crm:E2_Temporal_Entity"],
    "crm:E7_Activity": ["crm:E5_Event"],
    "crm:E11_Modification": ["crm:E7_Activity"],
    "crm:E12_Production": ["crm:E11_Modification"],
    "crm:E18_Physical_Thing": ["crm:E72_Legal_Object"],
    "crm:E19_Physical_Object": ["crm:E18_Physical_Thing"],
    "crm:E22_Human-Made_Object": ["crm:E19_Physical_Object", "crm:E24_Physical_Human-Made_Thing"],
    "crm:E24_Physical_Human-Made_Thing": ["crm:E18_Physical_Thing"],
    "crm:E30_Right": ["crm:E89_Propositional_Object"],
    "crm:E39_Actor": ["crm:E77_Persistent_Item"],
    "crm:E41_Appellation": ["crm:E90_Symbolic_Object"],
    "crm:E42_Identifier": ["crm:E41_Appellation"],
    "crm:E52_Time-Span": ["crm:E1_CRM_Entity"],
    "crm:E53_Place": ["crm:E1_CRM_Entity"],
    "crm:E55_Type": ["crm:E28_Conceptual_Object"],
    "crm:E65_Creation": ["crm:E7_Activity"],
    "crm:E73_Information_Object": ["crm:E89_Propositional_Object", "crm:E90_Symbolic_Object"],
    "crm:E90_Symbolic_Object": ["crm:E72_Legal_Object"],
}
ANYTHING, LITERAL = "crm:E1_CRM_Entity", "literal"
PROPERTIES = {
    "crm:P1_is_identified_by": (ANYTHING, "crm:E41_Appellation"),
    "crm:P2_has_type": (ANYTHING, "crm:E55_Type"),
    "crm:P3_has_note": (ANYTHING, LITERAL),
    "crm:P4_has_time-span": ("crm:E2_Temporal_Entity", "crm:E52_Time-Span"),
    "crm:P14_carried_out_by": ("crm:E7_Activity", "crm:E39_Actor"),
    "crm:P32_used_general_technique": ("crm:E7_Activity", "crm:E55_Type"),
    "crm:P48_has_preferred_identifier": (ANYTHING, "crm:E42_Identifier"),
    "crm:P50_has_current_keeper": ("crm:E18_Physical_Thing", "crm:E39_Actor"),
    "crm:P55_has_current_location": ("crm:E19_Physical_Object", "crm:E53_Place"),
    "crm:P82_at_some_time_within": ("crm:E52_Time-Span", LITERAL),
    "crm:P82a_begin_of_the_begin": ("crm:E52_Time-Span", LITERAL),
    "crm:P82b_end_of_the_end": ("crm:E52_Time-Span", LITERAL),
    "crm:P104_is_subject_to": ("crm:E72_Legal_Object", "crm:E30_Right"),
    "crm:P108_has_produced": ("crm:E12_Production", "crm:E24_Physical_Human-Made_Thing"),
    "crm:P106_is_composed_of": ("crm:E90_Symbolic_Object", "crm:E90_Symbolic_Object"),
    "crm:P129_is_about": ("crm:E89_Propositional_Object", ANYTHING),
    "crm:P190_has_symbolic_content": ("crm:E90_Symbolic_Object", LITERAL),
    "dig:L1_digitized": ("dig:D2_Digitization_Process", "crm:E18_Physical_Thing"),
    "dig:L2_used_as_source": ("dig:D10_Software_Execution", "dig:D1_Digital_Object"),
    "dig:L11_had_output": ("dig:D7_Digital_Machine_Event", "dig:D1_Digital_Object"),
    "dig:L12_happened_on_device": ("dig:D7_Digital_Machine_Event", "dig:D8_Digital_Device"),
    "dig:L13_used_parameters": ("dig:D10_Software_Execution", "dig:D1_Digital_Object"),
    "dig:L20_has_created": ("dig:D11_Digital_Measurement_Event", "dig:D9_Data_Object"),
    "dig:L23_used_software_or_firmware": ("dig:D7_Digital_Machine_Event", "dig:D14_Software"),
    "dig:L31_has_starting_date-time": ("crm:E5_Event", LITERAL),
    "dig:L32_has_ending_date-time": ("crm:E5_Event", LITERAL),
}


def kinds(name: str) -> set[str]:
    """A class and all that it is a kind of."""
    return {name, ANYTHING}.union(*(kinds(above) for above in KINDS_OF.get(name, ())))
