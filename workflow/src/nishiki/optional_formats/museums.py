"""Describe a packed scene for museums: as a LIDO 1.1 record and as a CIDOC CRM 7.1 graph, both in `RECORDS`.

The object, its digitisation as an event, and photographs and results as resources. Elements stand in the order of the
schema of the LIDO working group of CIDOC (ICOM, 2021). What capture.yaml does not say is left out, but the elements
that the schema demands: the kind of the object and the source of the record (generally its repository, in the words of
LIDO) are 'not stated' then, and a scene without a title is called by its name. https://lido-schema.org/schema/v1.1/lido-v1.1.html

The photographs are a D2 Digitization Process on a physical object, every stage is a D10 Software Execution on what it
read. Identifiers are those of the crate's description, so that both graphs can be joined. What is not known is left
out. https://www.cidoc-crm.org https://www.cidoc-crm.org/crmdig
"""

from collections.abc import Callable
from typing import Any, NamedTuple
from xml.etree import ElementTree as XML

from nishiki.artifacts import packed
from nishiki.artifacts.provenance import canonical

LIDO = "lido.xml"
TERMS = "http://terminology.lido-schema.org/"
NAMES = {"URI": "00099", "LOCAL": "00100", "INVENTORY_NUMBER": "00113", "ITEM": "00141"}
"""Numbers in the terminology of LIDO: kinds of identifiers, and the record of a single object."""


def lido_text(scene: packed.PackedScene) -> str:
    """Write the record as XML, by the template `lido.xml.j2`.

    Raises
    ------
    ValueError
        Where a text of capture.yaml has a character that XML cannot hold.
    """
    import jinja2

    def days(text: str) -> list[str]:
        """Return the first and the last day of a date, none of a text that is none."""
        return [moment.partition("T")[0] for moment in packed.days_of(text) or ()]

    loader = jinja2.PackageLoader("nishiki.optional_formats", ".")
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    words = {name: f"{TERMS}lido{number}" for name, number in NAMES.items()}
    facts = {"identifier": f"{scene.name}/sha256:{scene.digest}", "made": _is_made(scene), "days": days}
    text = environment.get_template("lido.xml.j2").render(scene=scene, is_address=packed.is_address, **facts, **words)
    try:
        record = XML.fromstring(text)
    except XML.ParseError as error:
        raise ValueError(f"a text of capture.yaml cannot be written as XML ({error})") from None
    XML.register_namespace("lido", "http://www.lido-schema.org")
    XML.indent(record, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + XML.tostring(record, encoding="unicode") + "\n"


CIDOC_CRM = "cidoc-crm.jsonld"
CONTEXT = {
    "crm": "http://www.cidoc-crm.org/cidoc-crm/",
    "dig": "http://www.ics.forth.gr/isl/CRMdig/",
    "label": "http://www.w3.org/2000/01/rdf-schema#label",
    "xsd": "http://www.w3.org/2001/XMLSchema#",
}


def crm_graph(scene: packed.PackedScene) -> packed.Entity:
    """Build the graph of a scene: object, digitisation, capture, stages, and the crate that holds them."""
    folders = ["capture/", *(stage.folder for stage in scene.stages)]
    crate = _node("./", "dig:D1_Digital_Object", scene.about_value("title") or scene.name)
    crate |= {"crm:P106_is_composed_of": packed.ids(folders), "crm:P129_is_about": {"@id": _identifier("object")}}
    software = _node("code/Snakefile", "dig:D14_Software", f"Nishiki {scene.version}")
    stages = [entity for stage in scene.stages for entity in _stage(stage)]
    described = [*_object(scene), *_production_node(scene), *_digitisation_node(scene), *_capture(scene)]
    return {"@context": CONTEXT, "@graph": [crate, *described, software, *stages]}


def _object(scene: packed.PackedScene) -> list[packed.Entity]:
    """Describe the object, its keeper and its place."""
    kind = "crm:E22_Human-Made_Object" if _is_made(scene) else "crm:E19_Physical_Object"
    node = _node(_identifier("object"), kind, scene.about_value("title"))
    nodes = [node]
    if scene.about_value("object_id"):
        node["crm:P48_has_preferred_identifier"] = _appellation_node(
            "crm:E42_Identifier", scene.about_value("object_id")
        )
    if scene.about_value("title"):
        node["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", scene.about_value("title"))
    if scene.about_value("object_kind"):
        node["crm:P2_has_type"] = {"@type": "crm:E55_Type", "label": scene.about_value("object_kind")}
    if scene.about_value("object_holder"):
        node["crm:P50_has_current_keeper"] = {"@id": _identifier("holder")}
        nodes.append(_actor("holder", scene.about_value("object_holder")))
    if scene.about_value("object_place"):
        place = {"@type": "crm:E53_Place", "label": scene.about_value("object_place")}
        place["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", scene.about_value("object_place"))
        node["crm:P55_has_current_location"] = place
    return nodes


def _is_made(scene: packed.PackedScene) -> bool:
    return bool(scene.about_value("object_maker") or scene.about_value("object_made"))


def _production_node(scene: packed.PackedScene) -> list[packed.Entity]:
    """Describe the production of the object: people and dates."""
    if not _is_made(scene):
        return []
    event = _node(_identifier("production"), "crm:E12_Production", "")
    event["crm:P108_has_produced"] = {"@id": _identifier("object")}
    nodes = [event]
    if scene.about_value("object_maker"):
        event["crm:P14_carried_out_by"] = {"@id": _identifier("maker")}
        nodes.append(_actor("maker", scene.about_value("object_maker")))
    if scene.about_value("object_made"):
        event["crm:P4_has_time-span"] = _time_span(scene.about_value("object_made"))
    return nodes


def _digitisation_node(scene: packed.PackedScene) -> list[packed.Entity]:
    """Describe the digitisation: object, photographer, date, camera and technique."""
    event = _node(_identifier("digitisation"), "dig:D2_Digitization_Process", f"Photographs of {scene.name}")
    event |= {"dig:L1_digitized": {"@id": _identifier("object")}, "dig:L20_has_created": {"@id": "capture/"}}
    nodes = [event]
    if scene.about_value("creator"):
        event["crm:P14_carried_out_by"] = {"@id": _identifier("creator")}
        nodes.append(_actor("creator", scene.about_value("creator")))
    if scene.about_value("date"):
        event["crm:P4_has_time-span"] = _time_span(scene.about_value("date"))
    if scene.technique:
        event["crm:P32_used_general_technique"] = {"@type": "crm:E55_Type", "label": scene.technique}
    if scene.camera:
        event["dig:L12_happened_on_device"] = {"@id": _identifier("camera")}
        nodes.append(_node(_identifier("camera"), "dig:D8_Digital_Device", scene.camera))
    if scene.about_value("notes"):
        event["crm:P3_has_note"] = scene.about_value("notes")
    return nodes


def _capture(scene: packed.PackedScene) -> list[packed.Entity]:
    """Describe the sealed photographs and the rights in them."""
    capture = _node("capture/", "dig:D9_Data_Object", "Sealed capture")
    capture["crm:P1_is_identified_by"] = _appellation_node("crm:E42_Identifier", f"sha256:{scene.digest}")
    if scene.scale:
        capture["crm:P3_has_note"] = scene.scale
    rights = scene.about_value("rights")
    if not rights:
        return [capture]
    place = rights if packed.is_address(rights) else _identifier("rights")
    capture["crm:P104_is_subject_to"] = {"@id": place}
    return [capture, _node(place, "crm:E30_Right", rights)]


def _stage(stage: packed.PackedStage) -> list[packed.Entity]:
    """Describe the run of a stage, its settings and its result."""
    run = _node(_identifier(f"run-{stage.name}"), "dig:D10_Software_Execution", f"{stage.name}: {stage.does}")
    run |= {
        "dig:L23_used_software_or_firmware": {"@id": "code/Snakefile"},
        "dig:L2_used_as_source": packed.ids(stage.sources),
        "dig:L13_used_parameters": {"@id": _identifier(f"settings-{stage.name}")},
        "dig:L11_had_output": {"@id": stage.folder},
        "dig:L31_has_starting_date-time": _moment(packed.start_time(stage)),
        "dig:L32_has_ending_date-time": _moment(packed.end_time(stage)),
    }
    settings = _node(_identifier(f"settings-{stage.name}"), "dig:D1_Digital_Object", f"settings of {stage.name}")
    settings["crm:P190_has_symbolic_content"] = canonical(stage.manifest["settings"])
    result = _node(stage.folder, "dig:D1_Digital_Object", f"{stage.name} {stage.manifest['key']}")
    digest = stage.files["artifact.json"][1]
    result["crm:P1_is_identified_by"] = _appellation_node("crm:E42_Identifier", f"sha256:{digest}")
    return [run, settings, result]


def _time_span(text: str) -> packed.Entity:
    span: packed.Entity = {"@type": "crm:E52_Time-Span", "label": text, "crm:P82_at_some_time_within": text}
    if days := packed.days_of(text):
        span["crm:P82a_begin_of_the_begin"], span["crm:P82b_end_of_the_end"] = map(_moment, days)
    return span


def _moment(text: str) -> packed.Entity:
    return {"@type": "xsd:dateTime", "@value": text}


def _actor(name: str, text: str) -> packed.Entity:
    actor = _node(_identifier(name), "crm:E39_Actor", text)
    actor["crm:P1_is_identified_by"] = _appellation_node("crm:E41_Appellation", text)
    return actor


def _appellation_node(kind: str, text: str) -> packed.Entity:
    return {"@type": kind, "crm:P190_has_symbolic_content": text}


def _node(place: str, kind: str, label: str) -> dict[str, Any]:
    return {"@id": place, "@type": kind, **({"label": label} if label else {})}


def _identifier(name: str) -> str:
    """Return an identifier of the crate's description."""
    return f"{packed.METADATA}#{name}"


class SceneRecord(NamedTuple):
    """A description of a packed scene."""

    standard: str
    text: Callable[[packed.PackedScene], str]  # ValueError where capture.yaml has a text that the format cannot hold


CRM = "CIDOC Conceptual Reference Model 7.1 with CRMdig 3.2"
RECORDS = {
    LIDO: SceneRecord("LIDO 1.1", lido_text),
    CIDOC_CRM: SceneRecord(CRM, lambda scene: packed.json_text(crm_graph(scene))),
}
"""Descriptions by the names of their files in the crate."""
IN_WORDS = f"""\
`{LIDO}` describes object and digitisation as museums exchange records (LIDO 1.1), `{CIDOC_CRM}` as a graph of the
CIDOC Conceptual Reference Model (JSON-LD).
"""
"""Paragraph of the crate's README."""
