"""Stored results to ``report.html``."""

from __future__ import annotations

from pathlib import Path

from .html import render
from .sections import make_page
from .store import load_store

REPORT_NAME = "report.html"


def build_report(results: Path, out: Path) -> Path:
    """Write the report of the results below ``results`` into the folder ``out``; the path of the file.

    Only stored artefacts are read, nothing is solved. Parts that are not stored yet are left out with a
    sentence that says so.

    Raises
    ------
    InputError
        When there is no such results folder, or a stored file is not readable.
    """
    text = render(make_page(load_store(Path(results))))
    file = Path(out) / REPORT_NAME
    file.parent.mkdir(parents=True, exist_ok=True)
    draft = file.with_suffix(".part")
    draft.write_text(text, encoding="utf-8")
    draft.replace(file)
    return file
