"""Stored results to one HTML file, with styles and scripts inside; beside it methods, tables and figures."""

import csv
import json
import re
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ..web import build_inline_script, compute_integrity, read_asset
from .drawing.plots import make_standalone
from .page import Cell, Figure, Page, Row, Table
from .sections.contents import make_page
from .sections.methods import write_method_markdown
from .store import load_store
from .words import TEMPLATES, make_environment

REPORT_NAME, METHODS_NAME = "report.html", "methods.md"
SCRIPTS = (
    *("vendor/three.min.js", "vendor/uPlot.min.js", "arrays.js", "colours.js", "overlay.js"),
    *("camera.js", "volume.js", "viewer.js", "chart.js"),
)
STYLES = ("vendor/uPlot.min.css", "web.css")
_NUMBER = re.compile(r"[+-]?\d[\d ]*(\.\d+)?(e[+-]?\d+)?$")


def build_report(results: Path, out: Path) -> Path:
    """Write the report of the results below ``results`` into the folder ``out``; the path of the file.

    Beside it: ``methods.md``, its tables in ``tables`` and its drawings in ``figures``.

    Only stored artefacts are read, nothing is solved. Parts that are not stored yet are left out with a
    sentence that says so. Raises `InputError` when there is no such results folder, or a stored file is not
    readable.
    """
    store, out = load_store(Path(results)), Path(out)
    file = write_page(make_page(store), out)
    (out / METHODS_NAME).write_text(write_method_markdown(store), encoding="utf-8")
    return file


def write_page(page: Page, out: Path) -> Path:
    """Write a page as one HTML file into the folder ``out``, with its tables and drawings beside it."""
    _write_parts(page, out)
    file = out / REPORT_NAME
    draft = file.with_suffix(".part")
    draft.write_text(_render(page), encoding="utf-8")
    draft.replace(file)
    return file


def _write_parts(page: Page, folder: Path) -> None:
    """``tables/<name>.csv`` and ``.json``, ``figures/<name>.svg``, for every table and drawing of a page.

    Numbers are those of the page, as rounded there; what the page marks (fitted sites, the study's own) is in
    the last column. A figure that is a photograph is left out.
    """
    tables, figures = folder / "tables", folder / "figures"
    for place in (tables, figures):
        place.mkdir(parents=True, exist_ok=True)
    for block in (*page.summary, *(block for section in page.sections for block in section.blocks)):
        if isinstance(block, Table):
            with (tables / f"{block.name}.csv").open("w", encoding="utf-8", newline="") as out:
                writer = csv.writer(out, lineterminator="\n")
                writer.writerow([*block.head, "marked"])
                for row in (*block.rows, *block.foot):
                    writer.writerow([*map(_to_value, row.cells), "yes" if row.marked else "no"])
            content = {
                "name": block.name,
                "caption": block.caption,
                "columns": list(block.head),
                "rows": [_to_json(row) for row in block.rows],
                "foot": [_to_json(row) for row in block.foot],
            }
            text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
            (tables / f"{block.name}.json").write_text(text, encoding="utf-8")
        elif isinstance(block, Figure) and block.markup.startswith("<svg") and "<image" not in block.markup:
            (figures / f"{block.name}.svg").write_text(make_standalone(block.markup), encoding="utf-8")


def _to_json(row: Row) -> dict[str, Any]:
    return {"cells": [_to_value(cell) for cell in row.cells], "marked": row.marked}


def _to_value(cell: Cell) -> str | float | int | None:
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


def _render(page: Page) -> str:
    """The page as HTML text: one file, no requests, every text escaped.

    Its policy lets one script run, told by its digest, and lets nothing be loaded or sent.
    """
    environment = make_environment(autoescape=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}

    def source(name: str) -> str:
        return TEMPLATES.get_source(environment, name)[0]

    moves = any(block.kind == "interactive" for section in page.sections for block in section.blocks)
    script = f"(() => {{\n{build_inline_script(*SCRIPTS)}\n{source('report.js')}}})();" if moves else ""
    style = "\n".join([source("report.css"), *(read_asset(name) for name in STYLES if moves)])
    return environment.get_template("report.html.j2").render(
        page=page,
        css=Markup(style),
        script=Markup(script),
        script_source=compute_integrity(script) if moves else "",
    )
