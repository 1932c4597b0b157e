"""Stored results to ``report.html``."""

from __future__ import annotations

from pathlib import Path

from .files import write_files
from .html import render
from .sections.methods import method_markdown
from .sections.sections import make_page
from .store import load_store

REPORT_NAME, METHODS_NAME = "report.html", "methods.md"


def build_report(results: Path, out: Path) -> Path:
    """Write the report of the results below ``results`` into the folder ``out``; the path of the file.

    Beside it: ``methods.md``, its tables in ``tables`` and its drawings in ``figures``.

    Only stored artefacts are read, nothing is solved. Parts that are not stored yet are left out with a
    sentence that says so.

    Raises
    ------
    InputError
        When there is no such results folder, or a stored file is not readable.
    """
    store = load_store(Path(results))
    page = make_page(store)
    file = Path(out) / REPORT_NAME
    file.parent.mkdir(parents=True, exist_ok=True)
    write_files(page, file.parent)
    (file.parent / METHODS_NAME).write_text(method_markdown(store), encoding="utf-8")
    draft = file.with_suffix(".part")
    draft.write_text(render(page), encoding="utf-8")
    draft.replace(file)
    return file
