"""The last stage: the report from what is stored."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from ... import report
from ...extensions import load_extensions
from ..shared.context import Context


def run_report(context: Context, folder: Path) -> dict[str, Any]:
    """``report.html``; a phantom's ``truth.json`` beside the study is shown in it.

    It is drawn on the executor: graphics libraries can crash, and a worker that dies is an error in words.
    """
    context.tell("report", 0, 1, "drawing figures")
    truth = context.study.folder / "truth.json"
    if truth.is_file():
        shutil.copyfile(truth, context.store.folder / "truth.json")
    list(context.executor.map(_draw, [(context.store.folder, folder, context.study.extensions)]))
    return {}


def _draw(job: tuple[Path, Path, tuple[Path, ...]]) -> None:
    results, out, extensions = job
    load_extensions(extensions)  # they may have sections and words of their own
    report.build_report(results, out)
