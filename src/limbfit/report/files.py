"""What a report holds as files of their own: tables as CSV and JSON, drawings as SVG."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

from .drawing.ink import standalone
from .page import Block, Cell, Figure, Page, Row, Table

_NUMBER = re.compile(r"[+-]?\d[\d ]*(\.\d+)?(e[+-]?\d+)?$")


def write_files(page: Page, folder: Path) -> None:
    """``tables/<name>.csv`` and ``.json``, ``figures/<name>.svg``, for every table and drawing of a page.

    Numbers are those of the page, as rounded there; a figure that is a photograph is left out.
    """
    blocks = [*page.summary, *(block for section in page.sections for block in section.blocks)]
    tables = folder / "tables"
    figures = folder / "figures"
    for place in (tables, figures):
        place.mkdir(parents=True, exist_ok=True)
    for block in blocks:
        if isinstance(block, Table):
            (tables / f"{block.name}.csv").write_text(as_csv(block), encoding="utf-8")
            (tables / f"{block.name}.json").write_text(as_json(block), encoding="utf-8")
        elif _is_drawing(block):
            assert isinstance(block, Figure)
            (figures / f"{block.name}.svg").write_text(standalone(block.markup), encoding="utf-8")


def _is_drawing(block: Block) -> bool:
    return isinstance(block, Figure) and block.markup.startswith("<svg") and "<image" not in block.markup


def as_csv(table: Table) -> str:
    """The table with its head; what the page marks (fitted sites, the study's own) in a last column."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*table.head, "marked"])
    for row in (*table.rows, *table.foot):
        writer.writerow([*(_value(cell) for cell in row.cells), "yes" if row.marked else "no"])
    return out.getvalue()


def as_json(table: Table) -> str:
    """Name, caption, columns, rows and the rows below the line, as JSON."""
    content = {
        "name": table.name,
        "caption": table.caption,
        "columns": list(table.head),
        "rows": [_row(row) for row in table.rows],
        "foot": [_row(row) for row in table.foot],
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _row(row: Row) -> dict[str, object]:
    return {"cells": [_value(cell) for cell in row.cells], "marked": row.marked}


def _value(cell: Cell) -> str | float | int | None:
    """A cell's number, where it holds one alone; nothing for a dash; else its text."""
    if not cell.number:
        return cell.text
    text = cell.text.replace("−", "-").replace("\u202f", " ").strip()
    if text in ("", "–"):
        return None
    if not _NUMBER.match(text):
        return cell.text
    plain = text.replace(" ", "")
    return float(plain) if any(mark in plain for mark in ".e") else int(plain)
