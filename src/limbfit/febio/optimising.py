"""The control file of FEBio's parameter optimisation for one indentation (``febio4 -s control model.feb``).

FEBio knows neither a modulus that enters two terms nor a bulk modulus that moves with it: they are
parameters of their own, tied by linear constraints. Its objective is one component of a force: the model is
written in the indenter's frame, where the force is along z.

Source: FEBio User Manual 4.0, chapter 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError, RunError
from ..fe import Indenter, Problem
from .faceting import INDENTER

Array = NDArray[np.float64]
NAMES = ("c", "m", "gamma", "tau")
MOST = 64  # parameters, in FEBio


@dataclass(frozen=True)
class Range:
    """Start and bounds of the parameters ``c`` (MPa), ``m``, ``gamma``, ``tau`` (s) of a tissue, by name."""

    start: Mapping[str, float]
    lower: Mapping[str, float]
    upper: Mapping[str, float]
    kappa_ratio: float


def in_indenter_frame(problem: Problem) -> Problem:
    """The same problem in the frame of its indenter, which goes along z."""
    indenter = problem.indenter
    if indenter is None:
        raise ProblemError("there is no indenter")
    frame, centre = indenter.frame, np.asarray(indenter.centre, dtype=float)
    mesh = problem.mesh.with_points((problem.mesh.points - centre) @ frame.T)
    turned: Indenter = replace(indenter, centre=np.zeros(3), axis=[0.0, 0.0, 1.0], edge=[1.0, 0.0, 0.0])
    bodies = []
    for body in problem.bodies:
        shape = body.shape
        place = (np.asarray(shape.centre, dtype=float) - centre) @ frame.T
        there = shape.placed(place, frame @ shape.frame[2], frame @ shape.frame[0])
        bodies.append(replace(body, shape=there, pivot=(body.origin - centre) @ frame.T))
    return replace(problem, mesh=mesh, indenter=turned, bodies=tuple(bodies))


def write_optimisation(
    path: str | Path, tissues: Mapping[str, Range], times: Array, force: Array, *, iterations: int = 25
) -> None:
    """Write the control file that fits the tissues to the force (n,) N at ``times (n,)`` s.

    Raises
    ------
    ProblemError
        For more tissues than FEBio can fit at once.
    RunError
        Where the file cannot be written.
    """
    if 7 * len(tissues) > MOST:
        raise ProblemError(
            f"FEBio fits {MOST} parameters at most, 7 for each tissue, not {len(tissues)} tissues"
        )
    try:
        with Path(path).open("w", encoding="utf-8") as stream:
            stream.writelines(f"{line}\n" for line in _lines(tissues, times, force, iterations))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error


def _lines(tissues: Mapping[str, Range], times: Array, force: Array, iterations: int) -> Iterator[str]:
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield "<!-- limbfit: parameters of the tissues from one record; mm, N, s, MPa -->"
    yield '<febio_optimize version="2.0">'
    yield '<Options type="constrained levmar"><obj_tol>1e-6</obj_tol><f_diff_scale>0.001</f_diff_scale>'
    yield f"<max_iter>{iterations}</max_iter><log_level>LOG_NEVER</log_level></Options>"
    yield "<Parameters>"
    for name, tissue in tissues.items():
        for path, start, lower, upper in _parameters(tissue):
            values = f"{start!r},{lower!r},{upper!r},{abs(start)!r}"
            yield f"<param name=\"fem.material('{name}').{path}\">{values}</param>"
    yield "</Parameters><Constraints>"
    for i, tissue in enumerate(tissues.values()):
        for ties in _ties(tissue):
            row = np.zeros(7 * len(tissues) + 1)
            row[7 * i : 7 * i + 7] = ties
            yield f"<constraint>{','.join(f'{value:.17g}' for value in row)}</constraint>"
    yield '</Constraints><Objective type="data-fit">'
    yield '<fnc type="filter_positive_only"><source type="parameter">'
    yield f'<param name="fem.rigidbody(\'{INDENTER}\').Fz"/><ordinate name="fem.time"/>'
    yield "</source></fnc><data>"
    for t, f in zip(times, force, strict=True):
        yield f"<pt>{float(t)!r},{max(float(f), 0.0)!r}</pt>"
    yield "</data></Objective></febio_optimize>"


def _parameters(tissue: Range) -> Iterator[tuple[str, float, float, float]]:
    """FEBio's name of a parameter, its start and bounds; the order is that of the constraints."""
    paths: Sequence[tuple[str, str, float]] = (
        ("elastic.c1", "c", 1.0),
        ("elastic.c2", "c", 1.0),
        ("k", "c", tissue.kappa_ratio),
        ("elastic.m1", "m", 1.0),
        ("elastic.m2", "m", -1.0),
        ("g1", "gamma", 1.0),
        ("t1", "tau", 1.0),
    )
    for path, name, scale in paths:
        low, high = sorted((scale * tissue.lower[name], scale * tissue.upper[name]))
        yield path, scale * tissue.start[name], low, high


def _ties(tissue: Range) -> tuple[tuple[float, ...], ...]:
    """c1 = c2, k = ratio c1 and m1 = -m2."""
    return (
        (1.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        (tissue.kappa_ratio, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0),
    )
