"""What a report page is made of: sections of paragraphs, notes, figures and tables, as plain data.

Everything here is text that has not been escaped yet, but for ``Figure.markup``, which the drawing modules
make themselves (inline SVG in which names were already escaped).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar


@dataclass(frozen=True)
class Prose:
    """A paragraph."""

    kind: ClassVar[str] = "prose"
    text: str


@dataclass(frozen=True)
class Note:
    """A sentence that says that something is missing or needs care."""

    kind: ClassVar[str] = "note"
    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    kind: ClassVar[str] = "bullets"
    items: tuple[str, ...]


@dataclass(frozen=True)
class Figure:
    """A drawing: ``markup`` is finished inline SVG; ``caption`` says what to see."""

    kind: ClassVar[str] = "figure"
    name: str
    markup: str
    caption: str


@dataclass(frozen=True)
class InteractiveFigure:
    """A figure that a script makes: ``what`` names how, ``content`` is its data, ``label`` what it shows."""

    kind: ClassVar[str] = "interactive"
    name: str
    what: str
    label: str
    caption: str
    content: Mapping[str, Any]


@dataclass(frozen=True)
class Cell:
    """A table cell. ``share`` in [0, 1] draws a bar behind it, ``shade`` in [-1, 1] a diverging colour."""

    text: str
    number: bool = False
    header: bool = False
    share: float | None = None
    shade: float | None = None


@dataclass(frozen=True)
class Row:
    """A table row; ``marked`` rows stand out (sites that were fitted)."""

    cells: tuple[Cell, ...]
    marked: bool = False


@dataclass(frozen=True)
class Table:
    """A table with a header row; units stand in the headers. ``folded`` tables open on a click."""

    kind: ClassVar[str] = "table"
    name: str
    caption: str
    head: tuple[str, ...]
    rows: tuple[Row, ...]
    foot: tuple[Row, ...] = ()
    folded: bool = False


Block = Prose | Note | Bullets | Figure | InteractiveFigure | Table


@dataclass(frozen=True)
class KeyNumber:
    """A number for the top of the page, with its unit and one line that says what it is."""

    value: str
    unit: str
    label: str


@dataclass(frozen=True)
class Section:
    """A titled part of the page; ``name`` is its anchor."""

    name: str
    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Page:
    """The whole report."""

    title: str
    subtitle: str
    key_numbers: tuple[KeyNumber, ...]
    summary: tuple[Block, ...]
    sections: tuple[Section, ...]
    footer: str


def make_bullets(sentences: Iterable[str]) -> Bullets | None:
    """A list of the sentences; None where there are none."""
    items = tuple(sentences)
    return Bullets(items) if items else None
