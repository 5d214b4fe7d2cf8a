"""Render all pages with one engine: their content as plain data, and its HTML; equal content gives equal bytes.

Texts that are given as `str` are escaped. Markup in a text is a `markupsafe.Markup`, whose `format` escapes what is put
into it.
"""

import base64
import json
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from nishiki.artifacts.artifact import Artifact
from nishiki.report.pictures import PagePicture, Ruler
from nishiki.report.svg import figure

MOST_PICTURES = 8  # of one kind on a page
LONGEST_TABLE = 20
"""Number of rows from which a table is folded."""
Cell = str | float | None
"""Content of a table's cell: text as it is, a number to three significant digits, None as a dash."""


@dataclass(frozen=True)
class Table:
    """A table."""

    kind: ClassVar[str] = "table"
    head: Sequence[str]  # names of the columns; empty: the table has none
    rows: Sequence[Sequence[Cell]]  # the cells
    align: str  # a letter for each column: l (text), w (text of several lines), r (number)
    caption: str = ""  # what stands above the table
    # sequence of (str, int): headings above those of the columns, each with the number of columns that it spans
    groups: Sequence[tuple[str, int]] = ()
    marked: Collection[int] = ()  # numbers of the rows that are tinted
    last_is_sum: bool = False  # whether the last row sums up the others


@dataclass(frozen=True)
class Figure:
    """A picture, drawing or film with its caption.

    picture, svg, video : one of them, video as data URI; ruler : scale bar below the picture; swatch : #rrggbb before
    the heading.
    """

    heading: str
    caption: str = ""
    picture: PagePicture | None = None
    svg: str = ""
    video: str = ""
    ruler: Ruler | None = None
    swatch: str = ""


@dataclass(frozen=True)
class Figures:
    """Figures beside each other, `columns` in a row (1 to 5) on a wide screen."""

    kind: ClassVar[str] = "figures"
    items: Sequence[Figure]
    columns: int = 2


@dataclass(frozen=True)
class Facts:
    """Pairs of a label and a text."""

    kind: ClassVar[str] = "facts"
    rows: Sequence[tuple[str, str]]


@dataclass(frozen=True)
class Note:
    """Highlighted texts; listed: as a list; warning: coloured as such."""

    kind: ClassVar[str] = "note"
    texts: Sequence[str]
    listed: bool = False
    warning: bool = False


@dataclass(frozen=True)
class Heading:
    """A heading inside a section; beside it a text in small letters."""

    kind: ClassVar[str] = "heading"
    text: str
    aside: str = ""


@dataclass(frozen=True)
class Fold:
    """Blocks that open at a click on their title. code : beside the title; mark : last text, in colour."""

    kind: ClassVar[str] = "fold"
    title: str
    summary: str
    blocks: "Sequence[Block]"
    code: str = ""
    mark: str = ""


@dataclass(frozen=True)
class EmbeddedPage:
    """Another page inside this one, loaded at a click; `address` relative to this page."""

    kind: ClassVar[str] = "frame"
    address: str
    title: str
    summary: str


@dataclass(frozen=True)
class CommandLines:
    """Lines to type at a terminal."""

    kind: ClassVar[str] = "listing"
    text: str


Block = str | Table | Figures | Facts | Note | Heading | Fold | EmbeddedPage | CommandLines
"""Content of a section; a text is a paragraph."""


@dataclass(frozen=True)
class PageSection:
    """A part of the page under a heading. link : its name in the table of contents; empty: its heading."""

    name: str
    heading: str
    blocks: Sequence[Block]
    link: str = ""


@dataclass(frozen=True)
class Metric:
    """One of the most important figures, its unit, and its meaning."""

    value: float
    unit: str
    meaning: str


@dataclass(frozen=True)
class Page:
    """A whole page."""

    title: str
    subtitle: str
    sections: Sequence[PageSection]
    version: str
    footer: str  # its last line
    stamp: str = ""  # name by which the file can be told again
    facts: Sequence[tuple[str, str]] = ()
    tiles: Sequence[Metric] = ()
    verdict: Sequence[tuple[str, str]] = ()  # what is good, what is doubtful, what would improve it most
    warnings: Sequence[str] = ()


def render_page(page: Page) -> str:
    """Render a page as HTML: one file that loads nothing from anywhere."""
    return templates().get_template("page.html.j2").render(page=page)


def templates():
    """Return the environment (`jinja2.Environment`) of the templates beside this module."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("nishiki.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure"] = figure
    return environment


FILMS = {".mp4": "video/mp4", ".webp": "image/webp", ".png": "image/png"}


def contents(artifact: Artifact | None, name: str | None) -> bytes | None:
    """Return a file that the artifact lists; None where there is none."""
    if artifact is None or name is None or name not in artifact.manifest["files"]:
        return None
    return artifact.path(name).read_bytes()


def read_json(artifact: Artifact | None, name: str) -> dict[str, Any] | None:
    """Return a JSON file that the artifact lists; None where there is none."""
    data = contents(artifact, name)
    return None if data is None else json.loads(data)


def film(artifact: Artifact, file: str, heading: str, caption: str, largest_mb: float) -> Block:
    """Return a film of the artifact; a sentence that names it where it is too large or of an unsupported kind."""
    data = artifact.path(file).read_bytes()
    kind = next((mime for ending, mime in FILMS.items() if file.endswith(ending)), None)
    if kind is None or len(data) > largest_mb * 1e6:
        return f"{heading} is too large for this page: {artifact.stage}/{artifact.key}/{file}. {caption}"
    source = f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
    return Figures([Figure(heading, caption, video=source)])


def film_and_notes(render: Artifact, heading: str, largest_mb: float) -> list[Block]:
    """Return the one film of an artifact, if there is any, and the stage's notes."""
    video = render.diagnostics.get("video") or {}
    caption = f"{figure(video.get('frames'))} frames."
    films = [film(render, video["file"], heading, caption, largest_mb)] if video else []
    return [*films, *(Note([note]) for note in render.diagnostics.get("notes") or [])]


STATES = {"finished": "finished", "unfinished": "not finished", "failed": "failed", "refused": "cannot be planned"}
"""States of a scene, and their names on the page."""


@dataclass(frozen=True)
class SceneCard:
    """Data of a scene on the page."""

    scene: str  # its name in the scene table
    state: str  # one of STATES
    detail: str = ""  # what comes next of an unfinished scene, why another one failed; empty for a finished one
    title: str = ""  # title, about: as on the page of the scene; empty where it has none yet
    about: str = ""
    page: str = ""  # page, viewer, thumbnail: files relative to the folder of the results; empty where there is none
    viewer: str = ""
    thumbnail: str = ""
    figures: Sequence[Metric] = ()  # the figures that matter most


def campaign_page(title: str, cards: Sequence[SceneCard], version: str) -> str:
    """Render the page as HTML. Scenes that need attention come first, then the others in the order given."""
    order = {"failed": 0, "refused": 0, "unfinished": 1, "finished": 2}
    cards = sorted(cards, key=lambda card: order[card.state])
    counts = {state: sum(card.state == state for card in cards) for state in STATES}
    meanings = dict.fromkeys(tile.meaning for card in cards for tile in card.figures)
    template = templates().get_template("campaign.html.j2")
    return template.render(
        title=title,
        cards=[_plain(card) for card in cards],
        counts=counts,
        states=STATES,
        meanings=list(meanings),
        version=version,
    )


def _plain(card: SceneCard) -> dict[str, Any]:
    """Return a card for the page's script. A figure's meaning is cut at its first comma or semicolon."""
    figures = [
        {
            "value": tile.value,
            "text": f"{figure(tile.value)} {tile.unit}".strip(),
            "short": re.split("[,;] ", tile.meaning)[0],
            "meaning": tile.meaning,
        }
        for tile in card.figures
    ]
    return {**vars(card), "called": STATES[card.state], "figures": figures}
