"""Tables of stored rows, whose columns stand in ``templates/words.j2``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from .page import Cell, Row, Table
from .words import write_columns, write_words


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
) -> Table:
    """A table of stored rows; caption and columns are those of ``table <name>``, or of other ``words``.

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
    caption = write_words(f"table {words or name}", **facts)
    return Table(name, caption, head, tuple(body), tuple(foot), folded)
