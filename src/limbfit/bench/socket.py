"""What a socket needs beside FEBio: friction, press fit, force control, pressure; FEBio's own inputs, run as
they are.

Every case is judged by parts: a part is some columns of one of its tables in some spans of time.  What is
left is in percent of FEBio's largest force, or largest displacement, in the whole table.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..febio import FebioLog, read_log, run_feb

FORCES, PLACES = ("Fx", "Fy", "Fz"), ("x", "y", "z")
NORMALS = "FEBio's contact acts along the skin's normal, limbfit's along the body's"
STICKS = "FEBio anchors a point where the first iteration of a step puts it"
NEVER = math.inf


@dataclass(frozen=True)
class CasePart:
    """``columns`` of ``table`` in the ``spans`` of time, s (start left out), with the ``goal``, percent."""

    name: str
    columns: tuple[str, ...]
    spans: tuple[tuple[float, float], ...]
    goal: float
    table: str = ""
    note: str = ""


@dataclass(frozen=True)
class SocketCase:
    """An input of the folder ``socket``: its name and its parts."""

    name: str
    parts: tuple[CasePart, ...]
    element: str = "hex8"


SOCKET = (
    SocketCase(
        "slide",
        (
            CasePart("pressing", FORCES, ((0.0, 1.0),), 1.0, note=STICKS),
            CasePart("sticking to slipping", FORCES, ((1.0, 1.5), (3.0, 3.5)), 3.0, note=NORMALS),
            CasePart("slipping", FORCES, ((1.5, 3.0), (3.5, NEVER)), 1.0, note=NORMALS),
        ),
    ),
    SocketCase(
        "cone",
        (
            CasePart("pushed on, axial", ("Fz",), ((0.0, 2.5),), 1.0, note=NORMALS),
            CasePart("pushed on, radial", ("Fx", "Fy"), ((0.0, 2.5),), 1.0, note=NORMALS),
            CasePart("held, axial", ("Fz",), ((2.5, NEVER),), 3.0, note=STICKS),
            CasePart("held, radial", ("Fx", "Fy"), ((2.5, NEVER),), 3.0, note=STICKS),
            CasePart("meridian, pushed on", PLACES, ((0.0, 2.5),), 1.0, "cone-line", NORMALS),
            CasePart("meridian, held", PLACES, ((2.5, NEVER),), 3.0, "cone-line", STICKS),
        ),
    ),
    SocketCase(
        "cone-load",
        (
            CasePart("loaded by a force", ("z",), ((5.5, 6.5),), 1.0, note=STICKS),
            CasePart("creep under it", ("z",), ((6.5, 8.5),), 1.0, note=STICKS),
            CasePart("let go", ("z",), ((8.5, NEVER),), 3.0, note=STICKS),
            CasePart("meridian under force", PLACES, ((5.5, NEVER),), 3.0, "cone-load-line", STICKS),
        ),
    ),
    SocketCase("tube", (CasePart("meridian", PLACES, ((0.0, NEVER),), 1.0, note="rounding"),)),
)


def compare_socket(case: SocketCase, folder: Path) -> Iterator[dict[str, Any]]:
    """A row for each part of a case, of FEBio's input run by limbfit and the tables of both.

    Raises
    ------
    InputError
        Where a file of the case is missing.
    """
    file = folder / "socket" / f"{case.name}.feb"
    if not file.is_file():
        raise InputError(
            "is missing", file=file, remedy="give the folder of FEBio's results with --reference"
        )
    with tempfile.TemporaryDirectory() as out:
        run = run_feb(file, out)
        for part in case.parts:
            name = f"{part.table or case.name}.txt"
            found, febio = read_log(Path(out) / name), read_log(file.with_name(name))
            row = {"case": f"{case.name}: {part.name}", "element": case.element, "goal_percent": part.goal}
            yield row | _build_comparison_row(
                part, found, febio, "" if run.result.completed else run.result.reason
            )


def _build_comparison_row(part: CasePart, found: FebioLog, febio: FebioLog, reason: str) -> dict[str, Any]:
    forces = part.columns[0] in FORCES
    columns, whole = (
        [febio.names.index(name) for name in names if name in febio.names]
        for names in (part.columns, FORCES if forces else PLACES)
    )
    theirs = febio.values[..., columns]
    rest = 0.0 if forces else theirs[0]
    largest = float(np.abs(febio.values - (0.0 if forces else febio.values[0]))[..., whole].max())
    count = min(len(found.times), len(febio.times))
    times = febio.times[:count]
    inside = np.any([(times > a * (1 + 1e-9)) & (times <= b * (1 + 1e-9)) for a, b in part.spans], axis=0)
    if reason or not np.allclose(found.times[:count], times, rtol=1e-6):
        reason = reason or "other steps than FEBio's"
        return {"max_difference_percent": None, "note": f"not solved to the end: {reason}"}
    mine = found.values[:count][inside][..., [found.names.index(name) for name in part.columns]]
    theirs_inside = theirs[:count][inside]
    unit = "force_N" if forces else "displacement_mm"
    return {
        "max_difference_percent": float(100.0 * np.abs(mine - theirs_inside).max() / largest),
        f"peak_{unit}": float(np.abs(mine - rest).max()),
        f"febio_peak_{unit}": float(np.abs(theirs_inside - rest).max()),
        "steps": int(inside.sum()),
        "note": part.note,
    }
