"""The words of the report, from ``templates/words.j2``: paragraphs, captions, what pictures show, tables."""

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template, Undefined

from . import formats
from .page import Block, Bullets, Cell, Figure, Note, Prose, Row, Section, Table, make_bullets

TEMPLATES = PackageLoader("limbfit.report", "templates")
_COLUMN = re.compile(r"\| (.*?) \|([|=])(.*?)(?:\|%(.*))?")
_BAR = "\ue000"  # for a "|" in a value, until columns are apart


def make_environment(undefined: type[Undefined] = StrictUndefined, **options: Any) -> Environment:
    """Templates that read attributes of stored results and write numbers as the report does."""
    options |= {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    environment = Environment(loader=TEMPLATES, undefined=undefined, **options)
    named = ((name.partition("format_")[2], function) for name, function in vars(formats).items())
    environment.filters |= {name: function for name, function in named if name}
    environment.filters |= {"form": format, "sentence": _make_sentence}
    return environment


def write_words(name: str, **facts: Any) -> str:
    """The paragraph with this name; what it says of results is read from ``facts``."""
    return _join_lines(_read_templates()[name][0].render(facts))


def write_columns(name: str, **facts: Any) -> list[tuple[str, str, str, str]]:
    """A row of a table: of each column its head, ``=`` for a number, the text, and the share of its bar."""
    columns = []
    for line in filter(None, _read_templates()[name][1].render(facts).split("\n")):
        found = _COLUMN.fullmatch(line)
        assert found is not None, line
        head, kind, text, share = map(_join_lines, found.groups(default=""))
        columns.append((head, kind, text, share))
    return columns


def make_section(name: str, *blocks: Block | Iterable[Block | None] | None) -> Section:
    """A section of the blocks that exist; ``section <name>`` is its title, and the note without any."""
    found: list[Block] = []
    for one in blocks:
        group = (one,) if one is None or isinstance(one, Block) else one
        found += [block for block in group if block is not None]
    title, missing = (_join_lines(part.render()) for part in _read_templates()[f"section {name}"])
    return Section(name, title, tuple(found) or (Note(missing),))


def make_prose(name: str, **facts: Any) -> Prose | None:
    """The paragraph with this name as a block; None where it has nothing to say."""
    text = write_words(name, **facts)
    return Prose(text) if text else None


def make_list(name: str, **facts: Any) -> Bullets | None:
    """The list with this name, each item of which begins a line with ``- ``; None where there are none."""
    items = re.split(r"^- ", _read_templates()[name][0].render(facts), flags=re.MULTILINE)[1:]
    return make_bullets(map(_join_lines, items))


def make_picture(name: str, markup: str, *, words: str = "", **facts: Any) -> Figure:
    """A drawing with the caption ``figure <name>``, or of other ``words``."""
    return Figure(name, markup, write_words(f"figure {words or name}", **facts))


def to_numeric(text: Any) -> Cell:
    """A cell that holds a number."""
    return Cell(str(text), number=True)


def make_row(first: Any, *others: Any, marked: Any = False) -> Row:
    """A row from its values: the first is its heading, cells stay as they are, others become text."""
    cells = [one if isinstance(one, Cell) else Cell(str(one)) for one in (first, *others)]
    cells[0] = replace(cells[0], header=not isinstance(first, Cell))
    return Row(tuple(cells), bool(marked))


def make_table(
    name: str,
    rows: Iterable[Any],
    *,
    marked: str | Callable[[Any], Any] | None = None,
    foot: Iterable[Row] = (),
    folded: bool = False,
    headed: bool = True,
    words: str = "",
    **facts: Any,
) -> Table | None:
    """A table of stored rows; caption and columns are those of ``table <name>``, or of other ``words``.

    None where there is no row, and no ``foot`` either.

    ``marked`` tells which rows stand out: by an attribute that is true, or by a function of the row;
    ``headed``: the first cell is the heading of its row. Caption and columns may name ``facts``.
    """
    head: tuple[str, ...] = ()
    body = []
    for row in rows:
        columns = write_columns(f"table {words or name}", row=row, **facts)
        head = tuple(column[0] for column in columns)
        cells = [
            Cell(text, number=kind == "=", share=float(share) if share else None)
            for _, kind, text, share in columns
        ]
        stands_out = getattr(row, marked) if isinstance(marked, str) else marked and marked(row)
        body.append(Row((replace(cells[0], header=headed), *cells[1:]), bool(stands_out)))
    last = tuple(foot)
    if not body and not last:
        return None
    return Table(name, write_words(f"table {words or name}", **facts), head, tuple(body), last, folded)


@cache
def _read_templates() -> dict[str, list[Template]]:
    """By its name, which stands above it after ``##``: a paragraph, and what follows after a blank line."""
    words, columns = make_environment(), make_environment(finalize=_finish_value)
    source = TEMPLATES.get_source(words, "words.j2")[0]
    found = re.findall(r"^## (.*)\n((?:(?!## ).*\n?)*)", source, flags=re.MULTILINE)
    parts = ((name, text.partition("\n\n")) for name, text in found)
    return {name: [words.from_string(first), columns.from_string(last)] for name, (first, _, last) in parts}


def _finish_value(value: Any) -> str:
    """A value in a column: a dash for nothing, and without what would begin another column or line."""
    text = formats.NOTHING if value is None or value == "" else str(value)
    return text.replace("|", _BAR).replace("\n", " ")


def _make_sentence(clauses: str) -> str:
    """Clauses with a capital letter and a full stop; nothing where there are none."""
    text = _join_lines(clauses)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _join_lines(text: str) -> str:
    """One line: white space is free in a template, but the narrow spaces of numbers stay."""
    return re.sub(r"[ \n]+", " ", text).strip(" ").replace(_BAR, "|")
