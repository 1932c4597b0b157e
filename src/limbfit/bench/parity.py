"""Parity with FEBio 4.11: the same mesh, element and steps; the largest difference in percent.

The cases that FEBio has solved are data here, with everything that is set for each of them. Those of a socket
(friction, press fit, force control, pressure) are FEBio's own inputs, run as they are.
"""

import tempfile
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..fe import Indenter, Problem, StepControl, System, iterate, solve
from ..fe.observables import compute_element_fields
from ..febio import FebioLog, read_feb, read_log, run_feb, to_problem

Tell = Callable[[int, int, str], None]  # done, of how many, what
Row = dict[str, Any]
FOLDER = Path("shared") / "reference"
GIVE_FOLDER = "give the folder of FEBio's results with --reference"
KPA = 1e-3  # MPa
GOAL = 1.0  # percent
FORCES, PLACES = ("Fx", "Fy", "Fz"), ("x", "y", "z")
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


@dataclass(frozen=True)
class CasePart:
    """``columns`` of ``table`` in the ``spans`` of time, s (start left out), with the ``goal``, percent.

    A difference is in percent of FEBio's largest force, or largest displacement, in the whole table.
    """

    name: str
    columns: Sequence[str]
    spans: Sequence[Sequence[float]]
    goal: float
    table: str = ""
    note: str = ""


@dataclass(frozen=True)
class SocketCase:
    """An input of the folder ``socket``, of hexahedra: its name and its parts."""

    name: str
    parts: tuple[CasePart, ...]


_CASES = tomllib.loads(Path(__file__).with_name("cases.toml").read_text(encoding="utf-8"))
CUBES, PUNCHED = (tuple(ReferenceCase(**row) for row in _CASES[kind]) for kind in ("cubes", "punched"))
ALL_CASES = CUBES + PUNCHED
SOCKET = tuple(
    SocketCase(name, tuple(CasePart(**part) for part in parts)) for name, parts in _CASES["socket"].items()
)


def bench_febio_parity(
    reference: Path | None = None,
    *,
    tell: Tell,
    cases: Sequence[ReferenceCase | SocketCase] = (*ALL_CASES, *SOCKET),
) -> list[Row]:
    """Rows ``case, element, max_difference_percent, goal_percent, ..``, one per case, or per part of one.

    The difference is the largest over the whole curve, in percent of FEBio's largest value. ``reference`` is
    the folder of FEBio's results; None: ``shared/reference``, here or above. Raises `InputError` where it, or
    a case in it, is missing.
    """
    folder = reference or find_reference(Path.cwd())
    rows: list[Row] = []
    for i, case in enumerate(cases):
        tell(i, len(cases), case.name)
        if isinstance(case, SocketCase):
            rows += compare_socket(case, folder)
            continue
        row = {"case": case.name.split("/")[-1], "element": case.element, "goal_percent": GOAL}
        compare = compare_stress if case in CUBES else compare_force
        rows.append(row | compare(case, folder))
    tell(len(cases), len(cases), "done")
    return rows


def compare_stress(case: ReferenceCase, folder: Path) -> Row:
    """Axial Cauchy stress and volume ratio of a cube of one element."""
    problem, control, log = load_case(case, folder)
    system, laws = System(problem), problem.build_laws()
    fields = [compute_element_fields(system, laws, step.state) for step in iterate(problem, control)]
    stress, J = np.array([f.cauchy[0, 2] for f in fields]), np.array([f.J[0] for f in fields])
    if len(fields) < len(control.times or ()):
        return _build_unfinished_row(f"stopped after {len(fields)} steps")
    peak = np.abs(log.column("sz")).max()
    return {
        "max_difference_percent": float(100.0 * np.abs(stress - log.column("sz")[1:]).max() / peak),
        "max_difference_J": float(np.abs(J - log.column("J")[1:]).max()),
        "peak_stress_kPa": float(np.abs(stress).max() / KPA),
        "febio_peak_stress_kPa": float(peak / KPA),
        "steps": len(fields),
        "note": case.note,
    }


def compare_force(case: ReferenceCase, folder: Path) -> Row:
    """Force of the indenter over the whole curve."""
    problem, control, log = load_case(case, folder)
    assert problem.indenter is not None
    axis = problem.indenter.frame[2]
    parts = [log.column(name) * axis["xyz".index(name[1])] for name in log.names if name in FORCES]
    force = np.abs(np.sum(parts, axis=0))  # of the model on the tissue along the indenter's axis
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


def compare_socket(case: SocketCase, folder: Path) -> Iterator[dict[str, Any]]:
    """A row for each part of a case, both tables compared; `InputError` where a file of it is missing."""
    file = folder / "socket" / f"{case.name}.feb"
    if not file.is_file():
        raise InputError("is missing", file=file, remedy=GIVE_FOLDER)
    with tempfile.TemporaryDirectory() as out:
        run = run_feb(file, out)
        for part in case.parts:
            name = f"{part.table or case.name}.txt"
            log, febio = read_log(Path(out) / name), read_log(file.with_name(name))
            row = {"case": f"{case.name}: {part.name}", "element": "hex8", "goal_percent": part.goal}
            reason = "" if run.result.completed else run.result.reason
            yield row | _build_comparison_row(part, log, febio, reason)


def _build_comparison_row(part: CasePart, log: FebioLog, febio: FebioLog, reason: str) -> dict[str, Any]:
    forces = part.columns[0] in FORCES
    columns, whole = (
        [febio.names.index(name) for name in names if name in febio.names]
        for names in (part.columns, FORCES if forces else PLACES)
    )
    theirs = febio.values[..., columns]
    rest = 0.0 if forces else theirs[0]
    largest = float(np.abs(febio.values - (0.0 if forces else febio.values[0]))[..., whole].max())
    count = min(len(log.times), len(febio.times))
    times = febio.times[:count]
    inside = np.any([(times > a * (1 + 1e-9)) & (times <= b * (1 + 1e-9)) for a, b in part.spans], axis=0)
    if reason or not np.allclose(log.times[:count], times, rtol=1e-6):
        return _build_unfinished_row(reason or "other steps than FEBio's")
    mine = log.values[:count][inside][..., [log.names.index(name) for name in part.columns]]
    theirs_inside = theirs[:count][inside]
    unit = "force_N" if forces else "displacement_mm"
    return {
        "max_difference_percent": float(100.0 * np.abs(mine - theirs_inside).max() / largest),
        f"peak_{unit}": float(np.abs(mine - rest).max()),
        f"febio_peak_{unit}": float(np.abs(theirs_inside - rest).max()),
        "steps": int(inside.sum()),
        "note": part.note,
    }


def _build_unfinished_row(reason: str) -> Row:
    return {"max_difference_percent": None, "note": f"not solved to the end: {reason}"}


def find_reference(start: Path) -> Path:
    """``shared/reference`` in or beside ``start``, or any folder above; `InputError` where there is none."""
    start = start.resolve()
    for folder in (start, *start.parents):
        if (folder / FOLDER).is_dir():
            return folder / FOLDER
    raise InputError(f"no folder {FOLDER} here or above", file=start, remedy=GIVE_FOLDER)


def load_case(case: ReferenceCase, folder: Path) -> tuple[Problem, StepControl, FebioLog]:
    """The problem on FEBio's mesh, its time steps and results; `InputError` for a missing or damaged file."""
    model = read_feb(folder / f"{case.name}.feb")
    log = read_log(folder / f"{case.name}.txt")
    problem = to_problem(model, PUNCH if model.rigid else None, **case.problem)
    return problem, StepControl(times=tuple(log.times[1:]), stress="linear", **case.control), log
