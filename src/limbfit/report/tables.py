"""Tables of stored rows, told by their columns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from .formats import NOTHING, format_fixed
from .page import Cell, Row, Table


def to_numeric(text: Any, share: float | None = None) -> Cell:
    """A cell that holds a number."""
    return Cell(str(text), number=True, share=share)


def make_row(first: Any, *others: Any, marked: Any = False) -> Row:
    """A row from its values: the first is its heading, cells stay as they are, others become text."""
    cells = [one if isinstance(one, Cell) else Cell(str(one)) for one in (first, *others)]
    cells[0] = replace(cells[0], header=not isinstance(first, Cell))
    return Row(tuple(cells), bool(marked))


Path = str | tuple[str, ...]  # a key of a row, or the keys that lead to a value within it
# A head with what stands below it: the path of a text; the path and the decimals of a number; or a function
# of the row that returns a cell or its text.
Column = tuple[str, Path] | tuple[str, Path, int] | tuple[str, Callable[[Any], Any]]


def make_table(
    name: str,
    caption: str,
    columns: Sequence[Column],
    rows: Iterable[Any],
    *,
    marked: str | Callable[[Any], Any] | None = None,
    foot: Iterable[Row] = (),
    folded: bool = False,
) -> Table:
    """A table of stored rows by columns, the first of which holds the headings of the rows.

    ``marked`` tells which rows stand out: by a key, or by a function of the row.
    """
    body = []
    for row in rows:
        stands_out = _read_cell(row, marked) is True if isinstance(marked, str) else marked and marked(row)
        body.append(make_row(*(_read_cell(row, *column[1:]) for column in columns), marked=stands_out))
    return Table(name, caption, tuple(column[0] for column in columns), tuple(body), tuple(foot), folded)


def _read_cell(row: Any, what: Path | Callable[[Any], Any], decimals: int | None = None) -> Any:
    if callable(what):
        return what(row)
    for key in (what,) if isinstance(what, str) else what:
        row = row.get(key) if isinstance(row, Mapping) else getattr(row, key, None)
    if decimals is not None:
        return to_numeric(format_fixed(row, decimals))
    return NOTHING if row is None or row == "" else row
