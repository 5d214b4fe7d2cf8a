"""Pages under test: a parser that finds unclosed elements and broken links, and artifacts with any content."""

import html.parser
import json
from pathlib import Path

from nishiki.artifacts.artifact import Artifact, ArtifactWriter

KEY = "a" * 12


class PageParser(html.parser.HTMLParser):
    """Every element is closed in order; collects identifiers, links and sources."""

    VOID = frozenset({"meta", "img", "br", "link", "circle", "path", "line", "rect", "hr", "stop"})

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.links, self.sources = [], set(), [], []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.ids |= {values["id"]} if "id" in values else set()
        self.links += [values["href"]] if "href" in values else []
        self.sources += [values["src"]] if "src" in values else []
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def parsed(text: str) -> PageParser:
    """A page whose elements are closed, whose links lead to its own parts, and which loads nothing."""
    parser = PageParser()
    parser.feed(text)
    assert parser.open == []
    assert all(link.startswith("#") and link[1:] in parser.ids for link in parser.links)
    assert all(source.startswith("data:") for source in parser.sources)
    return parser


def make_artifact(root: Path, settings, fill, *, stamp: dict, stage: str = "", key: str = KEY) -> Artifact:
    """An artifact whose files `fill(writer)` makes; what it returns becomes the diagnostics."""
    stage = stage or settings.STAGE
    with ArtifactWriter(root / stage / key) as writer:
        manifest = {
            **stamp,
            "stage": stage,
            "key": key,
            "diagnostics": fill(writer) or {},
            "settings": json.loads(settings.model_dump_json()) if settings else {},
            "upstream": {},
            "code": "c0de",
            "libraries": {"numpy": "2"},
        }
        return writer.finish(manifest, {})
