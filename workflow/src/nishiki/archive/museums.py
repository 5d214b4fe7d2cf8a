"""Describe a packed scene for museums: as a LIDO 1.1 record and as a CIDOC CRM 7.1 graph.

The object, its digitisation as an event, and photographs and results as resources. Elements stand in the order of the
schema of the LIDO working group of CIDOC (ICOM, 2021). What capture.yaml does not say is left out, but the elements
that the schema demands: the kind of the object and the source of the record (generally its repository, in the words of
LIDO) are 'not stated' then, and a scene without a title is called by its name. https://lido-schema.org/schema/v1.1/lido-v1.1.html

The photographs are a D2 Digitization Process on a physical object, every stage is a D10 Software Execution on what it
read. Identifiers are those of the crate's description, so that both graphs can be joined. What is not known is left
out. https://www.cidoc-crm.org https://www.cidoc-crm.org/crmdig
"""

from typing import Any
from xml.etree import ElementTree as XML

from nishiki.archive.crate import METADATA, Digitisation, Entity, PackedStage, days_of, ended, ids, is_address, started
from nishiki.artifacts.provenance import canonical

LIDO = "lido.xml"
NAMESPACE = "http://www.lido-schema.org"
LANGUAGE = "{http://www.w3.org/XML/1998/namespace}lang"
TERMS = "http://terminology.lido-schema.org/"
URI, LOCAL, INVENTORY_NUMBER, ITEM = (f"{TERMS}lido{number}" for number in ("00099", "00100", "00113", "00141"))
"""Of the terminology of LIDO: kinds of identifiers, and the record of a single object."""
NOT_STATED = "not stated"
UNKNOWN_LANGUAGE = "und"


def lido_text(scene: Digitisation) -> str:
    """Write the record as XML.

    Raises
    ------
    ValueError
        Where a text of capture.yaml has a character that XML cannot hold.
    """
    XML.register_namespace("lido", NAMESPACE)
    wrap = XML.Element(_name("lidoWrap"))
    record = _add(wrap, "lido")
    identifier = f"{scene.scene}/sha256:{scene.digest}"
    _add(record, "lidoRecID", identifier, type=LOCAL)
    _describe(_add(record, "descriptiveMetadata", language="en"), scene)
    _administer(_add(record, "administrativeMetadata", language="en"), scene, identifier)
    XML.indent(wrap, " ")
    text = '<?xml version="1.0" encoding="UTF-8"?>\n' + XML.tostring(wrap, encoding="unicode") + "\n"
    try:
        XML.fromstring(text)
    except XML.ParseError as error:
        raise ValueError(f"a text of capture.yaml cannot be written as XML ({error})") from None
    return text


def _describe(parent: XML.Element, scene: Digitisation) -> None:
    kinds = _add(_add(parent, "objectClassificationWrap"), "objectWorkTypeWrap")
    kind = scene.said("object_kind")
    _term(_add(kinds, "objectWorkType"), kind or NOT_STATED, UNKNOWN_LANGUAGE if kind else "en")
    identification = _add(parent, "objectIdentificationWrap")
    title = _add(_add(identification, "titleWrap"), "titleSet")
    _add(title, "appellationValue", scene.said("title") or scene.scene, language=UNKNOWN_LANGUAGE)
    if not scene.said("title"):
        _add(title, "sourceAppellation", "Name of the scene; capture.yaml states no title.", language="en")
    if any(scene.said(key) for key in ("object_id", "object_holder", "object_place")):
        _repository(_add(_add(identification, "repositoryWrap"), "repositorySet"), scene)
    events = _add(parent, "eventWrap")
    if _made(scene):
        production = _add(_add(events, "eventSet"), "event")
        _term(_add(production, "eventType"), "Production")
        if scene.said("object_maker"):
            actor = _add(_add(_add(production, "eventActor"), "actorInRole"), "actor")
            _appellation(_add(actor, "nameActorSet"), scene.said("object_maker"))
        _date(production, "eventDate", scene.said("object_made"))
    _digitisation(_add(_add(events, "eventSet"), "event"), scene)


def _repository(repository: XML.Element, scene: Digitisation) -> None:
    """Who keeps the object, under which number, and where."""
    if scene.said("object_holder"):
        name = _add(repository, "repositoryName")
        _appellation(_add(name, "legalBodyName"), scene.said("object_holder"))
    if scene.said("object_id"):
        _add(repository, "workID", scene.said("object_id"), type=INVENTORY_NUMBER)
    if scene.said("object_place"):
        _appellation(_add(_add(repository, "repositoryLocation"), "namePlaceSet"), scene.said("object_place"))


def _digitisation(event: XML.Element, scene: Digitisation) -> None:
    """Add the digitisation of the object to an event."""
    _term(_add(event, "eventType"), "Digitization")
    if scene.said("creator"):
        role = _add(_add(event, "eventActor"), "actorInRole")
        _appellation(_add(_add(role, "actor"), "nameActorSet"), scene.said("creator"))
        _term(_add(role, "roleActor"), "creator of the photographs")
    _date(event, "eventDate", scene.said("date"))
    if scene.technique:
        _term(_add(event, "eventMethod"), scene.technique)
    if scene.camera:
        _add(_add(event, "thingPresent"), "displayObject", f"Camera: {scene.camera}", language="en")
    if scene.said("notes"):
        note = _add(event, "eventDescriptionSet")
        _add(note, "descriptiveNoteValue", scene.said("notes"), language=UNKNOWN_LANGUAGE)


def _administer(parent: XML.Element, scene: Digitisation, identifier: str) -> None:
    record = _add(parent, "recordWrap")
    _add(record, "recordID", identifier, type=LOCAL)
    kind = _add(record, "recordType")
    _add(kind, "conceptID", ITEM, type=URI)
    _term(kind, "Item-level record")
    holder = scene.said("object_holder")
    source = _add(_add(record, "recordSource"), "legalBodyName")
    _appellation(source, holder or NOT_STATED, UNKNOWN_LANGUAGE if holder else "en")
    resources = _add(parent, "resourceWrap")
    photographs = _resource(resources, f"sha256:{scene.digest}", "photographs", scene.scale)
    _date(photographs, "resourceDateTaken", scene.said("date"))
    if scene.said("creator"):
        source = _add(photographs, "resourceSource")
        _appellation(_add(source, "legalBodyName"), scene.said("creator"))
    _rights(photographs, scene)
    made = ", ".join(stage.stage for stage in scene.stages)
    results = _resource(resources, "./", "data sets", f"Made from the photographs by Nishiki {scene.version}: {made}")
    _rights(results, scene)


def _resource(parent: XML.Element, identifier: str, kind: str, description: str) -> XML.Element:
    resource = _add(parent, "resourceSet")
    _add(resource, "resourceID", identifier, type=LOCAL)
    _term(_add(resource, "resourceType"), kind)
    if description:
        _add(resource, "resourceDescription", description, language="en")
    return resource


def _rights(resource: XML.Element, scene: Digitisation) -> None:
    rights = scene.said("rights")
    if rights:
        kind = _add(_add(resource, "rightsResource"), "rightsType")
        if is_address(rights):
            _add(kind, "conceptID", rights, type=URI)
        else:
            _term(kind, rights, UNKNOWN_LANGUAGE)


def _date(parent: XML.Element, name: str, text: str) -> None:
    """When something happened, as text, and as span of ISO days where the text is a date."""
    if text:
        dates = _add(parent, name)
        _add(dates, "displayDate", text)
        if days := days_of(text):
            span = _add(dates, "date")
            for element, moment in zip(("earliestDate", "latestDate"), days, strict=True):
                _add(span, element, moment.partition("T")[0])


def _appellation(parent: XML.Element, name: str, language: str = UNKNOWN_LANGUAGE) -> None:
    _add(parent, "appellationValue", name, language=language)


def _term(parent: XML.Element, word: str, language: str = "en") -> None:
    _add(parent, "term", word, language=language)


def _add(parent: XML.Element, tag: str, text: str = "", *, type: str = "", language: str = "") -> XML.Element:
    """Append an element to a parent."""
    element = XML.SubElement(parent, _name(tag))
    if type:
        element.set(_name("type"), type)
    if language:
        element.set(LANGUAGE, language)
    element.text = text or None
    return element


def _name(tag: str) -> str:
    return f"{{{NAMESPACE}}}{tag}"


CIDOC_CRM = "cidoc-crm.jsonld"
CONTEXT = {
    "crm": "http://www.cidoc-crm.org/cidoc-crm/",
    "dig": "http://www.ics.forth.gr/isl/CRMdig/",
    "label": "http://www.w3.org/2000/01/rdf-schema#label",
    "xsd": "http://www.w3.org/2001/XMLSchema#",
}


def crm_graph(scene: Digitisation) -> Entity:
    """Build the graph of a scene: object, digitisation, capture, stages, and the crate that holds them."""
    folders = ["capture/", *(stage.folder for stage in scene.stages)]
    crate = _node("./", "dig:D1_Digital_Object", scene.said("title") or scene.scene)
    crate |= {"crm:P106_is_composed_of": ids(folders), "crm:P129_is_about": {"@id": _named("object")}}
    software = _node("code/Snakefile", "dig:D14_Software", f"Nishiki {scene.version}")
    stages = [entity for stage in scene.stages for entity in _stage(stage)]
    graph = [
        crate,
        *_object(scene),
        *_production_node(scene),
        *_digitisation_node(scene),
        *_capture(scene),
        software,
        *stages,
    ]
    return {"@context": CONTEXT, "@graph": graph}


def _object(scene: Digitisation) -> list[Entity]:
    """Describe the object, its keeper and its place."""
    kind = "crm:E22_Human-Made_Object" if _made(scene) else "crm:E19_Physical_Object"
    node = _node(_named("object"), kind, scene.said("title"))
    nodes = [node]
    if scene.said("object_id"):
        node["crm:P48_has_preferred_identifier"] = _appellation_node("crm:E42_Identifier", scene.said("object_id"))
    if scene.said("title"):
        node["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", scene.said("title"))
    if scene.said("object_kind"):
        node["crm:P2_has_type"] = {"@type": "crm:E55_Type", "label": scene.said("object_kind")}
    if scene.said("object_holder"):
        node["crm:P50_has_current_keeper"] = {"@id": _named("holder")}
        nodes.append(_actor("holder", scene.said("object_holder")))
    if scene.said("object_place"):
        place = {"@type": "crm:E53_Place", "label": scene.said("object_place")}
        place["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", scene.said("object_place"))
        node["crm:P55_has_current_location"] = place
    return nodes


def _made(scene: Digitisation) -> bool:
    return bool(scene.said("object_maker") or scene.said("object_made"))


def _production_node(scene: Digitisation) -> list[Entity]:
    """Describe the production of the object: people and dates."""
    if not _made(scene):
        return []
    event = _node(_named("production"), "crm:E12_Production", "")
    event["crm:P108_has_produced"] = {"@id": _named("object")}
    nodes = [event]
    if scene.said("object_maker"):
        event["crm:P14_carried_out_by"] = {"@id": _named("maker")}
        nodes.append(_actor("maker", scene.said("object_maker")))
    if scene.said("object_made"):
        event["crm:P4_has_time-span"] = _time_span(scene.said("object_made"))
    return nodes


def _digitisation_node(scene: Digitisation) -> list[Entity]:
    """Describe the digitisation: object, photographer, date, camera and technique."""
    event = _node(_named("digitisation"), "dig:D2_Digitization_Process", f"Photographs of {scene.scene}")
    event |= {"dig:L1_digitized": {"@id": _named("object")}, "dig:L20_has_created": {"@id": "capture/"}}
    nodes = [event]
    if scene.said("creator"):
        event["crm:P14_carried_out_by"] = {"@id": _named("creator")}
        nodes.append(_actor("creator", scene.said("creator")))
    if scene.said("date"):
        event["crm:P4_has_time-span"] = _time_span(scene.said("date"))
    if scene.technique:
        event["crm:P32_used_general_technique"] = {"@type": "crm:E55_Type", "label": scene.technique}
    if scene.camera:
        event["dig:L12_happened_on_device"] = {"@id": _named("camera")}
        nodes.append(_node(_named("camera"), "dig:D8_Digital_Device", scene.camera))
    if scene.said("notes"):
        event["crm:P3_has_note"] = scene.said("notes")
    return nodes


def _capture(scene: Digitisation) -> list[Entity]:
    """Describe the sealed photographs and the rights in them."""
    capture = _node("capture/", "dig:D9_Data_Object", "Sealed capture")
    capture["crm:P1_is_identified_by"] = _appellation_node("crm:E42_Identifier", f"sha256:{scene.digest}")
    if scene.scale:
        capture["crm:P3_has_note"] = scene.scale
    rights = scene.said("rights")
    if not rights:
        return [capture]
    place = rights if is_address(rights) else _named("rights")
    capture["crm:P104_is_subject_to"] = {"@id": place}
    return [capture, _node(place, "crm:E30_Right", rights)]


def _stage(stage: PackedStage) -> list[Entity]:
    """Describe the run of a stage, its settings and its result."""
    run = _node(_named(f"run-{stage.name}"), "dig:D10_Software_Execution", f"{stage.name}: {stage.does}")
    run |= {
        "dig:L23_used_software_or_firmware": {"@id": "code/Snakefile"},
        "dig:L2_used_as_source": ids(stage.sources),
        "dig:L13_used_parameters": {"@id": _named(f"settings-{stage.name}")},
        "dig:L11_had_output": {"@id": stage.folder},
        "dig:L31_has_starting_date-time": _moment(started(stage)),
        "dig:L32_has_ending_date-time": _moment(ended(stage)),
    }
    settings = _node(_named(f"settings-{stage.name}"), "dig:D1_Digital_Object", f"settings of {stage.name}")
    settings["crm:P190_has_symbolic_content"] = canonical(stage.manifest["settings"])
    result = _node(stage.folder, "dig:D1_Digital_Object", f"{stage.name} {stage.manifest['key']}")
    digest = stage.files["artifact.json"][1]
    result["crm:P1_is_identified_by"] = _appellation_node("crm:E42_Identifier", f"sha256:{digest}")
    return [run, settings, result]


def _time_span(text: str) -> Entity:
    span: Entity = {"@type": "crm:E52_Time-Span", "label": text, "crm:P82_at_some_time_within": text}
    if days := days_of(text):
        span["crm:P82a_begin_of_the_begin"], span["crm:P82b_end_of_the_end"] = map(_moment, days)
    return span


def _moment(text: str) -> Entity:
    return {"@type": "xsd:dateTime", "@value": text}


def _actor(name: str, text: str) -> Entity:
    actor = _node(_named(name), "crm:E39_Actor", text)
    actor["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", text)
    return actor


def _appellation_node(kind: str, text: str) -> Entity:
    return {"@type": kind, "crm:P190_has_symbolic_content": text}


def _node(place: str, kind: str, label: str) -> dict[str, Any]:
    return {"@id": place, "@type": kind, **({"label": label} if label else {})}


def _named(name: str) -> str:
    """Return an identifier of the crate's description."""
    return f"{METADATA}#{name}"
