"""The one engine of all pages: what a page is made of, as plain data, and its HTML.

The same content gives the same bytes.

Texts that are given as `str` are escaped. Markup in a text is a `markupsafe.Markup`, whose `format` escapes what is put
into it.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar

from nishiki.report.numbers import figure
from nishiki.report.pictures import PagePicture, Ruler

Cell = str | float | None
"""Content of a table's cell: text as it is, a number to three significant digits, None as a dash."""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    head : sequence of str
        Names of the columns; empty: the table has none.
    rows : sequence of sequences of Cell
        The cells.
    align : str
        A letter for each column: l (text), w (text of several lines), r (number).
    caption : str
        What stands above the table.
    groups : sequence of (str, int)
        Headings above those of the columns, each with the number of columns that it spans.
    marked : collection of int
        Numbers of the rows that are tinted.
    last_is_sum : bool
        Whether the last row sums up the others.
    """

    kind: ClassVar[str] = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    align: str
    caption: str = ""
    groups: Sequence[tuple[str, int]] = ()
    marked: Collection[int] = ()
    last_is_sum: bool = False


@dataclass(frozen=True)
class Figure:
    """A picture, drawing or film with its caption. A map of one value is shown as a sentence instead.

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
    """Texts that stand out from the others; listed: as a list; warning: coloured as such."""

    kind: ClassVar[str] = "note"
    texts: Sequence[str]
    listed: bool = False
    warning: bool = False


@dataclass(frozen=True)
class Heading:
    """A heading inside a section, with what stands beside it in small letters."""

    kind: ClassVar[str] = "heading"
    text: str
    aside: str = ""


@dataclass(frozen=True)
class Fold:
    """Blocks that are shown at a click on their title. code : beside the title; mark : said last, in colour."""

    kind: ClassVar[str] = "fold"
    title: str
    summary: str
    blocks: Sequence[Block]
    code: str = ""
    mark: str = ""


@dataclass(frozen=True)
class Frame:
    """Another page inside this one, loaded at a click; `address` as seen from where this page is opened."""

    kind: ClassVar[str] = "frame"
    address: str
    title: str
    summary: str


@dataclass(frozen=True)
class Listing:
    """Lines as they are typed at a terminal."""

    kind: ClassVar[str] = "listing"
    text: str


Block = str | Table | Figures | Facts | Note | Heading | Fold | Frame | Listing
"""What stands in a section; a text is a paragraph."""


@dataclass(frozen=True)
class Section:
    """A part of the page under a heading. link : what the list of contents calls it; empty: its heading."""

    name: str
    heading: str
    blocks: Sequence[Block]
    link: str = ""


@dataclass(frozen=True)
class Tile:
    """A figure that matters most, its unit, and what it is."""

    value: float
    unit: str
    meaning: str


@dataclass(frozen=True)
class Page:
    """A whole page. stamp : name by which the file can be told again; footer : its last line."""

    title: str
    subtitle: str
    sections: Sequence[Section]
    version: str
    footer: str
    stamp: str = ""
    facts: Sequence[tuple[str, str]] = ()
    tiles: Sequence[Tile] = ()
    warnings: Sequence[str] = ()


def render_page(page: Page) -> str:
    """HTML of a page: one file that loads nothing from anywhere."""
    return templates().get_template("page.html.j2").render(page=page)


def templates():
    """The environment (`jinja2.Environment`) of the templates beside this module."""
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
