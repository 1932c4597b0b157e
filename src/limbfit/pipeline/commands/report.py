"""The stage ``report``: apart from what runs the stages, whose code does not decide what a report shows."""

import shutil
from pathlib import Path

from ... import report
from ...extensions import load_extensions
from ..engine.context import Context


def run_report(context: Context, folder: Path) -> None:
    """``report.html``; a phantom's ``truth.json`` beside the study is shown in it.

    It is drawn on the executor: graphics libraries can crash, and a worker that dies is an error in words.
    """
    context.tell("report", 0, 1, "drawing figures")
    truth = context.study.folder / "truth.json"
    if truth.is_file():
        shutil.copyfile(truth, context.store.folder / "truth.json")
    list(context.executor.map(_draw, [(context.store.folder, folder, context.study.extensions)]))


def _draw(job: tuple[Path, Path, tuple[Path, ...]]) -> None:
    results, out, extensions = job
    load_extensions(extensions)  # they may have sections and words of their own
    report.build_report(results, out)
