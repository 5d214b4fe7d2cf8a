"""The records of a crate for museums: LIDO 1.1 and the CIDOC CRM, by their structure, their vocabulary and readers."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as XML

import pytest
import rdflib
from museum_vocabularies import KINDS_OF, LITERAL, PROPERTIES, kinds, lido_faults
from npm_packages import npm_folder
from rdflib.namespace import RDF, RDFS
from refusals import expect_facts, refused

from nishiki.archive.crate import _rights_id, capture_method
from nishiki.artifacts.packed import METADATA, TECHNIQUES, PackedScene, PackedStage, is_address, json_text
from nishiki.capture.folder import CaptureFile
from nishiki.capture.goniometer import GoniometerFile
from nishiki.capture.turntable import TurntableFile
from nishiki.optional_formats.museums import CONTEXT, crm_graph, lido_text

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:rdflib")  # of its own parsers
LIDO = {"lido": "http://www.lido-schema.org"}
CRATE = "http://crate.example/"
ABOUT = {
    "title": "Höhe & <Tiefe>",
    "creator": "山田 花子",
    "date": "2026-01-31",
    "object_id": "inv. 12",
    "rights": "https://creativecommons.org/licenses/by/4.0/",
    "notes": "ein Hinweis",
}
OBJECT = {
    "object_kind": "painting",
    "object_maker": "Atelier Ōkami",
    "object_made": "1642",
    "object_holder": "Museum of Works",
    "object_place": "Kyōto",
}
METHOD = {"geometry": "plane", "camera": "Camera of Works, 50 Mpx", "pixel_pitch_mm": 0.05}


def packed_stage(name, upstream):
    above = {other: {"key": f"{other}key"} for other in upstream}
    manifest = {"stage": name, "key": f"{name}key", "settings": {"method": "äbc"}, "upstream": above}
    run = {"finished": "2026-02-01T10:00:30+00:00", "seconds": 30.0}
    return PackedStage(manifest, run, True, f"does {name}", {"artifact.json": (10, "ab" * 32)}, name)


STAGES = [packed_stage("ingest", ["capture"]), packed_stage("normals", ["ingest"]), packed_stage("height", ["normals"])]
STAGES.append(packed_stage("report", ["ingest", "normals", "height"]))


def digitised(about=None, method=None):
    said = {**ABOUT, **(about or {})}
    return PackedScene("scene", "0.1.0", [], Path("capture"), "cd" * 32, said, {}, {}, METHOD | (method or {}), STAGES)


def nothing_said():
    return replace(digitised(), about=dict.fromkeys(ABOUT), method={"geometry": "plane"})


def record(scene):
    return XML.fromstring(lido_text(scene))


def texts(root, name):
    return [element.text for element in root.iterfind(f".//lido:{name}", LIDO)]


@pytest.mark.parametrize(
    "scene",
    [digitised(OBJECT), digitised(), nothing_said(), digitised({"rights": "© Museum", "date": "2026-01-31 to 02-02"})],
    ids=["all", "no object", "nothing", "words"],
)
def test_a_lido_record_has_the_structure_of_its_schema(scene):
    assert lido_faults(record(scene)) == []


def test_the_schema_of_the_tests_finds_faults():
    root = record(digitised())
    event = root.find(".//lido:event", LIDO)
    event.append(event[0])
    del root.find(".//lido:recordID", LIDO).attrib[f"{{{LIDO['lido']}}}type"]
    assert [fault.partition(":")[0] for fault in lido_faults(root)] == ["event", "recordID"]


def test_a_lido_record_says_what_is_known():
    root = record(digitised())
    assert texts(root, "titleSet/lido:appellationValue") == [ABOUT["title"]]
    assert texts(root, "workID") == ["inv. 12"]
    assert texts(root, "event/lido:eventType/lido:term") == ["Digitization"]
    assert texts(root, "event//lido:nameActorSet/lido:appellationValue") == [ABOUT["creator"]]
    assert texts(root, "eventMethod/lido:term") == [TECHNIQUES["plane"]]
    assert texts(root, "displayObject") == [f"Camera: {METHOD['camera']}"]
    assert texts(root, "earliestDate") == texts(root, "latestDate") == ["2026-01-31"] * 2
    assert texts(root, "descriptiveNoteValue") == ["ein Hinweis"]
    assert texts(root, "rightsType/lido:conceptID") == [ABOUT["rights"]] * 2
    assert texts(root, "resourceID") == ["sha256:" + "cd" * 32, "./"]
    assert texts(root, "resourceDescription")[0].count("0.05") == 1
    expect_facts(texts(root, "resourceDescription")[1], "ingest", "normals", "height", "report")


def test_a_lido_record_says_who_made_and_who_keeps_the_object():
    root = record(digitised(OBJECT))
    assert texts(root, "objectWorkType/lido:term") == ["painting"]
    assert texts(root, "repositoryName//lido:appellationValue") == ["Museum of Works"]
    assert texts(root, "recordSource//lido:appellationValue") == ["Museum of Works"]
    assert texts(root, "repositoryLocation//lido:appellationValue") == ["Kyōto"]
    assert texts(root, "workID") == ["inv. 12"]
    assert texts(root, "event/lido:eventType/lido:term") == ["Production", "Digitization"]
    production = root.find(".//lido:event", LIDO)
    assert texts(production, "nameActorSet/lido:appellationValue") == ["Atelier Ōkami"]
    assert texts(production, "displayDate") == ["1642"]
    assert texts(production, "earliestDate") == []


def test_a_query_finds_maker_and_keeper_of_the_object():
    query = """
        PREFIX crm: <http://www.cidoc-crm.org/cidoc-crm/>
        PREFIX dig: <http://www.ics.forth.gr/isl/CRMdig/>
        SELECT ?kind ?maker ?when ?keeper ?place WHERE {
          ?photographing dig:L1_digitized ?object . ?making crm:P108_has_produced ?object ;
            crm:P14_carried_out_by/rdfs:label ?maker ; crm:P4_has_time-span/crm:P82_at_some_time_within ?when .
          ?object crm:P2_has_type/rdfs:label ?kind ; crm:P50_has_current_keeper/rdfs:label ?keeper ;
            crm:P55_has_current_location/rdfs:label ?place .
        }"""
    (row,) = set(graph(digitised(OBJECT)).query(query))
    assert tuple(map(str, row)) == tuple(OBJECT.values())


def test_nothing_is_invented_where_capture_yaml_is_silent():
    root = record(nothing_said())
    assert texts(root, "titleSet/lido:appellationValue") == ["scene"]
    assert texts(root, "sourceAppellation") != []
    assert len(texts(root, "objectWorkType/lido:term")) == 1
    for name in ("workID", "actor", "eventDate", "displayObject", "rightsResource", "resourceDateTaken"):
        assert texts(root, name) == []
    kinds_present = {str(each) for each in graph(nothing_said()).objects(None, RDF.type)}
    words = ("Actor", "Right", "Device", "Time-Span", "Production", "Place", "Human-Made")
    assert not any(word in kind for kind in kinds_present for word in words)


def test_a_date_in_words_stays_words():
    root = record(digitised({"date": "2026-01-31 to 02-02"}))
    assert texts(root, "displayDate") == ["2026-01-31 to 02-02"] * 2
    assert texts(root, "earliestDate") == []
    assert "P82a" not in json_text(crm_graph(digitised({"date": "2026-01-31 to 02-02"})))


@pytest.mark.parametrize("text", ["20260131", "2026-W05-6", "2026-01-31 10:00", "2026-01-31T10:00:00+02:00"])
def test_a_day_is_written_in_one_way_however_it_was_stated(text):
    root = record(digitised({"date": text}))
    assert texts(root, "displayDate") == [text] * 2
    assert texts(root, "earliestDate") == texts(root, "latestDate") == ["2026-01-31"] * 2


@pytest.mark.parametrize(
    ("rights", "address"),
    [("http://a.example/b", True), ("https://a.example/<b>", False), ("https://a.example (others)", False)],
)
def test_rights_are_an_address_in_every_record_or_in_none(rights, address):
    assert is_address(rights) == address
    scene = digitised({"rights": rights})
    assert texts(record(scene), "rightsType/lido:conceptID") == [rights] * 2 * address
    assert ((rdflib.URIRef(rights), RDF.type, rdflib.URIRef(CONTEXT["crm"] + "E30_Right")) in graph(scene)) == address
    assert _rights_id(rights) == (rights if address else "#rights")


def test_a_text_that_xml_cannot_hold_is_an_error():
    with refused(ValueError, "capture.yaml"):
        lido_text(digitised({"notes": "a\x07b"}))


def test_every_geometry_has_its_technique():
    geometries = {
        choice
        for model in (CaptureFile, TurntableFile, GoniometerFile)
        for choice in model.model_fields["geometry"].annotation.__args__
    }
    assert set(TECHNIQUES) == geometries


def test_the_method_is_read_from_capture_yaml_of_each_geometry():
    plane = CaptureFile(format=1, lights={"file": "lights.lp"}, pixel_pitch_mm=0.2, camera={"model": "A"})
    assert capture_method(plane) == {"geometry": "plane", "camera": "A", "pixel_pitch_mm": 0.2}
    table = TurntableFile(format=1, geometry="turntable")
    assert capture_method(table) == {"geometry": "turntable", "camera": None, "pixel_pitch_mm": None}
    cloth = GoniometerFile(format=1, geometry="goniometer", goniometer={"pixel_pitch_mm": 0.02})
    assert capture_method(cloth) == {"geometry": "goniometer", "camera": None, "pixel_pitch_mm": 0.02}


def graph(scene):
    return rdflib.Graph().parse(data=json_text(crm_graph(scene)), format="json-ld", publicID=CRATE + "cidoc-crm.jsonld")


def short(node):
    return next(
        (str(node).replace(place, f"{name}:") for name, place in CONTEXT.items() if str(node).startswith(place)), ""
    )


@pytest.mark.parametrize("scene", [digitised(OBJECT), digitised(), nothing_said()], ids=["all", "no object", "nothing"])
def test_the_graph_uses_classes_and_properties_as_they_are_defined(scene):
    found = graph(scene)
    kind = {node: short(name) for node, name in found.subject_objects(RDF.type)}
    assert set(kind.values()) <= set(KINDS_OF)
    links = [each for each in found if each[1] not in (RDF.type, RDFS.label)]
    assert len(links) > 30
    for subject, name, value in links:
        domain, values = PROPERTIES[short(name)]
        assert domain in kinds(kind[subject]), (subject, name)
        assert isinstance(value, rdflib.Literal) if values == LITERAL else values in kinds(kind[value]), (name, value)


def test_a_query_follows_a_result_to_the_object_the_photographer_and_the_day():
    query = """
        PREFIX crm: <http://www.cidoc-crm.org/cidoc-crm/>
        PREFIX dig: <http://www.ics.forth.gr/isl/CRMdig/>
        SELECT ?number ?name ?begin ?camera WHERE {
          ?result (^dig:L11_had_output/dig:L2_used_as_source)+ ?capture .
          ?photographing dig:L20_has_created ?capture ; dig:L1_digitized ?object ; crm:P14_carried_out_by ?person ;
            crm:P4_has_time-span/crm:P82a_begin_of_the_begin ?begin ; dig:L12_happened_on_device/rdfs:label ?camera .
          ?object crm:P48_has_preferred_identifier/crm:P190_has_symbolic_content ?number .
          ?person crm:P1_is_identified_by/crm:P190_has_symbolic_content ?name .
        }"""
    result = rdflib.URIRef(CRATE + "artifacts/height/heightkey/")
    (row,) = set(graph(digitised()).query(query, initBindings={"result": result}))
    begin = rdflib.Literal("2026-01-31T00:00:00", datatype=rdflib.XSD.dateTime)
    assert tuple(row) == (
        *map(rdflib.Literal, (ABOUT["object_id"], ABOUT["creator"])),
        begin,
        rdflib.Literal(METHOD["camera"]),
    )


def test_both_descriptions_of_a_crate_mean_the_same_things():
    names = {str(node) for node in graph(digitised()).subjects() if isinstance(node, rdflib.URIRef)}
    assert {CRATE, CRATE + "capture/", CRATE + "artifacts/normals/normalskey/", CRATE + "code/Snakefile"} <= names
    assert {f"{CRATE}{METADATA}#{name}" for name in ("object", "creator", "run-height", "settings-height")} <= names


def test_the_table_of_the_tests_is_what_the_vocabularies_say():
    """Against the RDFS of CIDOC CRM and CRMdig, as the npm packages @vocabulary/crm and @vocabulary/dig carry them."""
    files = {name: f"@vocabulary/{name}/{name}.nq" for name in ("crm", "dig")}
    folder = npm_folder(*files.values())
    if folder is None:
        pytest.skip("the npm packages @vocabulary/crm and @vocabulary/dig are not installed (set NODE_PATH)")
    known = rdflib.Dataset(default_union=True)
    for file in files.values():
        known.parse(data=(folder / file).read_text(encoding="utf-8"), format="nquads")
    for name, (domain, values) in PROPERTIES.items():
        node = rdflib.URIRef(CONTEXT[name[:3]] + name[4:])
        assert {short(each) for each in known.objects(node, RDFS.domain)} == {domain}
        ranges = {short(each) or LITERAL for each in known.objects(node, RDFS.range)}
        assert ranges & {values, "xsd:dateTime" if values == LITERAL else values}
    for name, above in KINDS_OF.items():
        node = rdflib.URIRef(CONTEXT[name[:3]] + name[4:])
        stated = {
            short(each).replace("E22_Man-", "E22_Human-") for each in known.transitive_objects(node, RDFS.subClassOf)
        }
        assert set(above) <= stated, name
