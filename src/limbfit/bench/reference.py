"""The cases that FEBio 4.11 has solved: where they lie, and how limbfit solves each of them.

Everything that is set for a case is data here, so that benchmark, tests and documentation say the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fe import Indenter, Problem, StepControl
from ..febio import FebioLog, read_feb, read_log, to_problem

Tell = Callable[[int, int, str], None]  # done, of how many, what

FOLDER = Path("shared") / "reference"
PUNCH = Indenter("square", width=20.0, edge_radius=2.0)


@dataclass(frozen=True)
class ReferenceCase:
    """A case of the reference folder.

    Parameters
    ----------
    name : file in the folder, without ending.
    element : FEBio's name of the element.
    problem, control : what differs from limbfit's defaults (fields of `Problem` and `StepControl`).
    symmetry : by how much the force of the model is to be multiplied.
    note : what explains the difference that is left.
    """

    name: str
    element: str
    problem: Mapping[str, Any] = field(default_factory=dict)
    control: Mapping[str, Any] = field(default_factory=dict)
    symmetry: int = 1
    note: str = ""


CUBES = tuple(
    ReferenceCase(
        f"cube/cube_{tissue}", "hex8", control={"tolerance": 1e-9}, note="one element, no contact: rounding"
    )
    for tissue in ("skin", "muscle", "bosboom", "lim", "lim_par")
)

# FEBio's automatic penalty is 3 times the modulus times A/V of each element: softer than limbfit's own, and
# softer for hexahedra than for the smaller tetrahedra.  ``penalty`` (1/mm) is its mean, and ``penetration``
# lets the punch sink in as far as it then does.  FEBio's default tet10 has 8 quadrature points.
_NOTE = "penalty per element and over the current area in FEBio, uniform over the reference area here"


def _build_punched_case(name: str, element: str, penalty: float, symmetry: int) -> ReferenceCase:
    problem = {"contact_rule": "gauss", "element": "tet10g8" if element == "tet10" else element}
    control = {"penalty": penalty, "penetration": 1.0}
    return ReferenceCase(name, element, problem, control, symmetry, _NOTE)


PUNCHED = (
    _build_punched_case("block/block_hex8", "hex8", 8.7, 4),
    _build_punched_case("block/block_tet4", "tet4", 26.0, 4),
    _build_punched_case("block/block_tet10", "tet10", 26.0, 4),
    _build_punched_case("residuum/posterior_tet4", "tet4", 12.5, 1),
    _build_punched_case("residuum/posterior_tet10", "tet10", 12.5, 1),
)


def find_reference(start: Path) -> Path:
    """The folder ``shared/reference`` in, or beside, ``start`` or any folder above it.

    Raises
    ------
    InputError
        Where there is none.
    """
    start = start.resolve()
    for folder in (start, *start.parents):
        if (folder / FOLDER).is_dir():
            return folder / FOLDER
    raise InputError(
        f"no folder {FOLDER} here or above",
        file=start,
        remedy="give the folder of FEBio's results with --reference",
    )


def load_case(case: ReferenceCase, folder: Path) -> tuple[Problem, StepControl, FebioLog]:
    """The problem on FEBio's mesh, FEBio's own time steps, and FEBio's results.

    Raises
    ------
    InputError
        Where a file of the case is missing or damaged.
    """
    model = read_feb(folder / f"{case.name}.feb")
    log = read_log(folder / f"{case.name}.txt")
    problem = to_problem(model, PUNCH if model.rigid else None, **case.problem)
    return problem, StepControl(times=tuple(log.times[1:]), stress="linear", **case.control), log


def read_pushing_force(problem: Problem, log: FebioLog) -> Array:
    """Force (n,) of the model on the tissue along the indenter's axis, N, from FEBio's reactions."""
    assert problem.indenter is not None
    axis = problem.indenter.frame[2]
    parts = [
        log.column(name) * axis["xyz".index(name[1])] for name in log.names if name in ("Fx", "Fy", "Fz")
    ]
    return np.abs(np.sum(parts, axis=0))
