"""A limb under a stated field of pressure: the deformed surface is the shape of a socket."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import ProblemError
from ..fe import History, Pressure, Problem, Result, Step, StepControl, solve
from ..fe.materials import Material
from ..mesh import Mesh
from .model import ELEMENT, OUTER, choose_threads, grade_ramp_and_hold

PRESSURE_LEVELS = 32  # of pressure, up to the largest: what a face has is rounded to them
RAMP_STEPS, HOLD_STEPS = 6, 4  # while the pressure comes on, and is held


def build_pressed_problem(
    mesh: Mesh, materials: Mapping[str, Material], pressure_kPa: Array, on_s: float, hold_s: float
) -> Problem:
    """A limb whose outer surface bears a pressure that follows it; bones and proximal cut are held.

    Parameters
    ----------
    mesh : LPS mm, with the face set ``skin`` and node sets ``fixed_*``.
    materials : by region.
    pressure_kPa : (f,) of the faces of that set, 0 or more; rounded to `PRESSURE_LEVELS`
        parts of the largest.
    on_s, hold_s : how long the pressure comes on and then stays.

    Raises
    ------
    ProblemError
        Where no face bears any.
    """
    top = float(pressure_kPa.max())
    if not top > 0.0:
        raise ProblemError("no pressure is stated anywhere on the limb", remedy="state one below the brim")
    faces, levels = mesh.face_sets[OUTER], np.round(PRESSURE_LEVELS * pressure_kPa / top)
    times = [0.0, on_s, on_s + hold_s] if hold_s > 0.0 else [0.0, on_s]
    pressures = []
    for level in np.unique(levels[levels > 0.0]):
        value = 1e-3 * top * level / PRESSURE_LEVELS
        pressures.append(Pressure(faces[levels == level], times, [0.0, *(value for _ in times[1:])]))
    return Problem(
        mesh=mesh,
        materials=materials,
        fixed=mesh.held,
        contact_faces=np.zeros((0, mesh.kind.faces.shape[1]), dtype=np.int64),
        indenter=None,
        history=History(np.array([0.0, times[-1]]), np.zeros(2)),
        pressures=tuple(pressures),
        element=ELEMENT,
    )


def press_limb(problem: Problem, on_step: Callable[[Step], None] | None = None) -> Result:
    """Simulate a problem of `build_pressed_problem`; the last state is kept."""
    _, on, *hold = map(float, problem.pressures[0].times)
    times = grade_ramp_and_hold(0.0, on, hold[-1] if hold else on, RAMP_STEPS, HOLD_STEPS)
    control = StepControl(times=tuple(times), threads=choose_threads())
    return solve(problem, control, on_step=on_step, store="all")


def extract_outer_surface(mesh: Mesh, displacement: Array | None = None) -> Surface:
    """The limb's outer surface, open at the proximal cut, LPS mm, moved by a displacement (n, 3) of nodes.

    The faces of quadratic cells are each four triangles.
    """
    faces = mesh.face_sets[OUTER]
    if faces.shape[1] == 6:
        corners = [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)]
        faces = np.vstack([faces[:, list(corner)] for corner in corners])
    nodes, local = np.unique(faces, return_inverse=True)
    points = mesh.points if displacement is None else mesh.points + displacement
    return Surface(points[nodes], local.reshape(-1, 3))
