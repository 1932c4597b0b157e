"""Many studies in one go, on one executor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

from ...errors import InputError, LimbfitError
from ...execution import make_executor, share_executor
from ...study import load_study
from ..engine.context import Listener, Progress, ignore_progress
from .run import STAGE_NAMES, run_study

_FIGURES = ("mean_error_fitted_percent", "mean_error_heldout_percent", "report")


def run_batch(
    paths: Sequence[str | Path],
    *,
    until: str | None = None,
    workers: int = 0,
    listener: Listener = ignore_progress,
) -> Iterator[dict[str, Any]]:
    """Run studies one after the other on the same workers; a study that fails does not stop the others.

    Parameters
    ----------
    paths : of studies, each a ``study.toml`` or its folder.
    until : name of the last stage to do; default all.
    workers : how many simulate side by side; 0: one per core.
    listener : is told of progress.

    Yields
    ------
    dict
        For each study as it ends: ``study`` (its path as given), ``state`` (``done`` or ``failed``),
        ``seconds``, ``error`` (one line, where it failed), and its mean errors and report.

    Raises
    ------
    InputError
        For a stage that there is not.
    """
    if until is not None and until not in STAGE_NAMES:
        raise InputError(f"no stage is named {until!r}", remedy="stages are " + ", ".join(STAGE_NAMES))
    with make_executor(workers) as executor, share_executor(executor):
        for i, path in enumerate(paths):
            start = perf_counter()
            listener(Progress("batch", i, len(paths), str(path)))
            row: dict[str, Any] = {"study": str(path), "state": "done", "error": None}
            try:
                summary = run_study(load_study(path), until=until, listener=listener)
                row |= {key: summary.get(key) for key in _FIGURES}
            except LimbfitError as error:
                row |= {"state": "failed", "error": str(error)}
            except Exception as error:  # one study's bad luck must not cost the others
                row |= {"state": "failed", "error": f"internal error: {type(error).__name__}: {error}"}
            yield row | {"seconds": round(perf_counter() - start, 1)}
        listener(Progress("batch", len(paths), len(paths), "done"))
