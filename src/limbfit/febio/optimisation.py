"""The control file of FEBio's parameter optimisation for one indentation (``febio4 -s control model.feb``).

FEBio has neither a modulus that enters two terms nor a bulk modulus that moves with it: they are parameters
of their own, tied by linear constraints. Its objective is one component of a force, so the model is written
in the indenter's frame, where the force is along z.

Source: FEBio User Manual 4.0, chapter 6.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import ProblemError
from ..fe import Indenter, Problem
from .bodies import INDENTER
from .writing import write_template

MAX_PARAMETERS = 64  # parameters, in FEBio


@dataclass(frozen=True)
class ParameterRange:
    """Start and bounds of the parameters of `OgdenQLV` (MPa, s) of a tissue, by name and in their order."""

    start: Mapping[str, float]
    lower: Mapping[str, float]
    upper: Mapping[str, float]
    kappa_ratio: float

    @property
    def count(self) -> int:
        """The number of FEBio's parameters: c and m twice each, k, and those of relaxation."""
        return 3 + len(self.start)


def check_optimisable(problem: Problem) -> None:
    """Raise `ProblemError` if a given force, or what comes before the indentation, rules out FEBio's fit."""
    if problem.history.forced:
        what = 'FEBio\'s fit compares forces, which are given where a record has control = "force"'
        raise ProblemError(what, remedy="identify with limbfit")
    if problem.touch_down_s or problem.prestretch is not None or problem.bodies:
        raise ProblemError(
            "FEBio's fit cannot follow where a clamped, tensed or pre-strained limb is touched: it moves "
            "with the parameters",
            remedy="identify with limbfit, or leave these out of the study",
        )


def turn_to_indenter_frame(problem: Problem) -> Problem:
    """Return the same problem in the frame of its indenter, which goes along z."""
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
        there = shape.place(place, frame @ shape.frame[2], frame @ shape.frame[0])
        bodies.append(replace(body, shape=there, pivot=(body.origin - centre) @ frame.T))
    fibres = None if problem.fibres is None else np.asarray(problem.fibres, dtype=float) @ frame.T
    G = None if problem.prestretch is None else frame @ np.asarray(problem.prestretch, dtype=float) @ frame.T
    return replace(problem, mesh=mesh, indenter=turned, bodies=tuple(bodies), fibres=fibres, prestretch=G)


def write_optimisation(
    path: str | Path,
    tissues: Mapping[str, ParameterRange],
    times: Array,
    force: Array,
    *,
    iterations: int = 25,
) -> None:
    """Write the control file that fits the tissues to the force (n,) N at ``times (n,)`` s. Raises
    `ProblemError` for more tissues than FEBio can fit at once, and `RunError` if the file cannot be written.
    """
    count = sum(tissue.count for tissue in tissues.values())
    if count > MAX_PARAMETERS:
        raise ProblemError(
            f"FEBio fits at most {MAX_PARAMETERS} parameters, but {len(tissues)} tissues have {count} there"
        )
    ties = []
    first = 0
    for tissue in tissues.values():
        ratio = tissue.kappa_ratio
        # c1 = c2, k = ratio c1 and m1 = -m2
        for factors in ((1.0, -1.0, 0.0, 0.0, 0.0), (ratio, 0.0, -1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0, 1.0)):
            row = np.zeros(count + 1)
            row[first : first + len(factors)] = factors
            ties.append(",".join(f"{value:.17g}" for value in row))
        first += tissue.count
    write_template(
        path,
        "optimise.feb.j2",
        iterations=iterations,
        parameters=[one for name, tissue in tissues.items() for one in _list_parameters(name, tissue)],
        ties=ties,
        indenter=INDENTER,
        points=np.column_stack([times, np.maximum(force, 0.0)]),
    )


def _list_parameters(tissue_name: str, tissue: ParameterRange) -> Iterator[tuple[str, tuple[float, ...]]]:
    """List FEBio's name of each parameter with start, bounds and scale, in the order of the constraints."""
    paths: Sequence[tuple[str, str, float]] = (
        ("elastic.c1", "c", 1.0),
        ("elastic.c2", "c", 1.0),
        ("k", "c", tissue.kappa_ratio),
        ("elastic.m1", "m", 1.0),
        ("elastic.m2", "m", -1.0),
        *((f"{'gt'[i % 2]}{i // 2 + 1}", name, 1.0) for i, name in enumerate(list(tissue.start)[2:])),
    )
    for path, name, scale in paths:
        low, high = sorted((scale * tissue.lower[name], scale * tissue.upper[name]))
        start = scale * tissue.start[name]
        yield f"material('{tissue_name}').{path}", (start, low, high, abs(start))
