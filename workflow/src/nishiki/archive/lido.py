"""A packed scene as a record of LIDO 1.1 (Lightweight Information Describing Objects), as museums exchange them.

The object, its digitisation as an event, and photographs and results as resources. Elements stand in the order of the
schema of the LIDO working group of CIDOC (ICOM, 2021). What capture.yaml does not say is left out, but the elements
that the schema demands: the kind of the object and the source of the record (generally its repository, in the words of
LIDO) are 'not stated' then, and a scene without a title is called by its name. https://lido-schema.org/schema/v1.1/lido-v1.1.html
"""

from xml.etree import ElementTree as XML

from nishiki.archive.crate_entities import is_address
from nishiki.archive.digitisation import Digitisation, days_of

LIDO = "lido.xml"
NAMESPACE = "http://www.lido-schema.org"
LANGUAGE = "{http://www.w3.org/XML/1998/namespace}lang"
TERMS = "http://terminology.lido-schema.org/"
URI, LOCAL, INVENTORY_NUMBER, ITEM = (f"{TERMS}lido{number}" for number in ("00099", "00100", "00113", "00141"))
"""Of the terminology of LIDO: kinds of identifiers, and the record of a single object."""
NOT_STATED = "not stated"
UNKNOWN_LANGUAGE = "und"


def lido_text(scene: Digitisation) -> str:
    """The record as XML.

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
    if scene.said("object_maker") or scene.said("object_made"):
        _production(_add(_add(events, "eventSet"), "event"), scene)
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


def _production(event: XML.Element, scene: Digitisation) -> None:
    """What happened to the object: it was made."""
    _term(_add(event, "eventType"), "Production")
    if scene.said("object_maker"):
        actor = _add(_add(_add(event, "eventActor"), "actorInRole"), "actor")
        _appellation(_add(actor, "nameActorSet"), scene.said("object_maker"))
    _date(event, "eventDate", scene.said("object_made"))


def _digitisation(event: XML.Element, scene: Digitisation) -> None:
    """What happened to the object: it was photographed."""
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
    """A new last element of a parent."""
    element = XML.SubElement(parent, _name(tag))
    if type:
        element.set(_name("type"), type)
    if language:
        element.set(LANGUAGE, language)
    element.text = text or None
    return element


def _name(tag: str) -> str:
    return f"{{{NAMESPACE}}}{tag}"
