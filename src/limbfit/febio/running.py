"""A FEBio input solved by limbfit, with the tables that its own output section asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, ProblemError, RunError
from ..fe import Result, Step, System, solve
from .driving import contacts_of_bodies
from .penalty import FaceWise
from .problem import penalised, step_control, to_problem
from .reading.model import read_feb
from .tables import Tables


@dataclass(frozen=True)
class FebRun:
    """What came of a FEBio input: the simulation, the files written, and what was left out."""

    result: Result
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def run_feb(
    path: str | Path,
    output: str | Path,
    on_step: Callable[[Step, float], None] | None = None,
    keep: bool = False,
    **settings: Any,
) -> FebRun:
    """Solve a FEBio input and write its log-file tables into the folder ``output``.

    Parameters
    ----------
    on_step : called with every accepted step and the time of the last one, s.
    keep : refuse to write over files that are there.
    settings : fields of `StepControl` that replace what the input says (``times``, ``threads``, ..).

    Raises
    ------
    ProblemError
        Where the input cannot be read or holds what limbfit does not know; with its line.
    RunError
        Where the tables cannot be written.
    """
    folder, model = Path(output), read_feb(path)
    try:
        problem = to_problem(model)
        control = step_control(model, problem, **settings)
        system = System(problem, control.threads)
        tables = Tables(model, system, folder, Path(path).stem)
        weights = None
        if penalised(model) and "penalty" not in settings:
            laws = [contacts[0] for contacts in contacts_of_bodies(model).values()]
            weights = FaceWise(system, laws, np.asarray(control.times))
    except ProblemError as error:
        raise ProblemError(error.what, file=path, place=error.place, remedy=error.remedy) from None
    assert control.times is not None
    for table in tables.files:
        own = table.exists() and table.samefile(path)
        if own or (keep and table.exists()):
            raise InputError("is there already", file=table, remedy="give another folder with --output")
    last = control.times[-1]

    def accepted(step: Step) -> None:
        tables.add(step)
        if weights is not None:
            weights.after(step)
        if on_step is not None:
            on_step(step, last)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tables:
            result = solve(problem, control, on_step=accepted, store="peak", system=system)
    except OSError as error:
        raise RunError(f"{folder}: {error.strerror or error}") from error
    return FebRun(result, tables.files, model.notes)
