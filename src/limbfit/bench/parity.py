"""Parity with FEBio: the same mesh, the same element, the same steps; the largest difference in percent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..fe import System, iterate, solve
from ..fe.kernel.laws import Laws
from ..fe.observables import compute_element_fields
from .reference import CUBES, PUNCHED, ReferenceCase, Tell, find_reference, load_case, read_pushing_force
from .socket import SOCKET, SocketCase, compare_socket

KPA = 1e-3  # MPa
Row = dict[str, Any]
ALL_CASES = CUBES + PUNCHED
GOAL = 1.0  # percent


def bench_febio_parity(
    reference: Path | None = None,
    *,
    tell: Tell,
    cases: Sequence[ReferenceCase | SocketCase] = (*ALL_CASES, *SOCKET),
) -> list[Row]:
    """Rows ``case, element, max_difference_percent, goal_percent, ..``, one per case, or per part of one.

    The difference is the largest over the whole curve, in percent of FEBio's largest value.

    Parameters
    ----------
    reference : folder of FEBio's results; None: ``shared/reference``, here or above.

    Raises
    ------
    InputError
        Where the reference folder or a case in it is missing.
    """
    folder = reference or find_reference(Path.cwd())
    rows: list[Row] = []
    for i, case in enumerate(cases):
        tell(i, len(cases), case.name)
        if isinstance(case, SocketCase):
            rows += compare_socket(case, folder)
            continue
        row = {"case": case.name.split("/")[-1], "element": case.element, "goal_percent": GOAL}
        rows.append(row | _compare(case, folder))
    tell(len(cases), len(cases), "done")
    return rows


def _compare(case: ReferenceCase, folder: Path) -> Row:
    return compare_stress(case, folder) if case in CUBES else compare_force(case, folder)


def compare_stress(case: ReferenceCase, folder: Path) -> Row:
    """Axial Cauchy stress and volume ratio of a cube of one element."""
    problem, control, log = load_case(case, folder)
    system = System(problem)
    laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
    found = [compute_element_fields(system, laws, step.state) for step in iterate(problem, control)]
    stress, J = np.array([f.cauchy[0, 2] for f in found]), np.array([f.J[0] for f in found])
    if len(found) < len(control.times or ()):
        return _build_unfinished_row(f"stopped after {len(found)} steps")
    peak = np.abs(log.column("sz")).max()
    return {
        "max_difference_percent": float(100.0 * np.abs(stress - log.column("sz")[1:]).max() / peak),
        "max_difference_J": float(np.abs(J - log.column("J")[1:]).max()),
        "peak_stress_kPa": float(np.abs(stress).max() / KPA),
        "febio_peak_stress_kPa": float(peak / KPA),
        "steps": len(found),
        "note": case.note,
    }


def compare_force(case: ReferenceCase, folder: Path) -> Row:
    """Force of the indenter over the whole curve."""
    problem, control, log = load_case(case, folder)
    force = read_pushing_force(problem, log)
    result = solve(problem, control, store="none")
    if not result.completed:
        return _build_unfinished_row(result.reason)
    difference = np.interp(log.times, result.times, result.force) - force
    return {
        "max_difference_percent": float(100.0 * np.abs(difference).max() / force.max()),
        "peak_force_N": case.symmetry * result.peak_force,
        "febio_peak_force_N": float(case.symmetry * force.max()),
        "penetration_mm": float(result.penetration.max()),
        "steps": result.statistics["steps"],
        "unknowns": result.statistics["unknowns"],
        "seconds": result.statistics["seconds"]["total"],
        "formulation": result.statistics["element"],
        "contact_rule": problem.contact_rule,
        "penalty_per_mm": control.penalty,
        "note": case.note,
    }


def _build_unfinished_row(reason: str) -> Row:
    return {"max_difference_percent": None, "note": f"not solved to the end: {reason}"}
