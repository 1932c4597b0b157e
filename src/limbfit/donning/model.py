"""A limb in its socket, or under a stated pressure, as a problem for the solver, and when that steps.

The deformed surface of a limb under pressure is the shape of a socket.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import ProblemError
from ..execution import count_usable_cores
from ..fe import History, Pressure, Problem, Result, RigidBody, SmoothSurface, Step, StepControl, solve
from ..fe.materials import Material
from ..fe.motion import COORDINATES, Motion
from ..mesh import Mesh
from ..socket import Socket

ELEMENT = "tet10p0"
OUTER = "skin"  # the face set that the socket may touch, the liner's where there is one
# Steps while the socket comes on, is held, is loaded and is held again; tissue relaxes fastest at first.
RAMP_STEPS, HOLD_STEPS, LOAD_STEPS = 8, 6, 6
HOLD_POWER = 2.0  # power of the step's number that the time in a hold goes with
# The stiffness of contact, MPa/mm: where pressures are the largest, 0.2 MPa, the wall is met to 0.1 mm.
CONTACT_STIFFNESS = 2.0
PRESSURE_LEVELS = 32  # of pressure, up to the largest: what a face has is rounded to them
PRESSING_STEPS, PRESSED_STEPS = 6, 4  # while the pressure comes on, and is held
MAX_THREADS = 4  # of one simulation; more wait for memory


@dataclass(frozen=True)
class Load:
    """A load on the socket: ``force (3,)`` N and ``moment (3,)`` N mm about ``point (3,)``, LPS.

    It comes on within ``ramp_s`` from what was there before, and stays for ``hold_s``.
    """

    name: str
    force: Array
    moment: Array
    point: Array
    ramp_s: float = 1.0
    hold_s: float = 2.0


@dataclass(frozen=True)
class SocketFit:
    """How a socket is put on a limb, and its loads afterwards.

    Parameters
    ----------
    pivot : (3,) LPS mm, the point whose motion is reported, such as the knee centre.
    proximal, anterior : (3,) unit vectors at right angles.
    friction : Coulomb's coefficient, or ``frictionless`` or ``sticky``.
    donning_s, hold_s : how long it grows, or slides on, and then rests.
    travel_mm : the distance over which it slides on in its final shape, from distal; None: it grows in place.
    """

    pivot: Array
    proximal: Array
    anterior: Array
    friction: float | str = 0.5
    donning_s: float = 2.0
    hold_s: float = 10.0
    travel_mm: float | None = None
    loads: Sequence[Load] = ()

    @property
    def frame(self) -> Array:
        """(3, 3) rows: the axes of the socket's coordinates, anterior first, proximal last."""
        return np.array([self.anterior, np.cross(self.proximal, self.anterior), self.proximal])

    @property
    def ends(self) -> tuple[tuple[str, float, float], ...]:
        """Name, end of coming on and end of the hold, s, of donning and of every load."""
        ends, start = [], 0.0
        loads = ((load.name, load.ramp_s, load.hold_s) for load in self.loads)
        for name, ramp, hold in (("donning", self.donning_s, self.hold_s), *loads):
            ends.append((name, start + ramp, start + ramp + hold))
            start += ramp + hold
        return tuple(ends)

    def find_held(self, time_s: float) -> list[str]:
        """Name of what has been held until a time, donning or a load; none at any other time."""
        return [name for name, _, off in self.ends if np.isclose(time_s, off, rtol=1e-9, atol=0.0)]


def build_socket_problem(
    mesh: Mesh, materials: Mapping[str, Material], socket: Socket, fit: SocketFit
) -> Problem:
    """The limb's mesh in a socket that is put on and loaded.

    Bones and the proximal cut are held, so the socket moves: its loads are those that it exerts.

    Parameters
    ----------
    mesh : LPS mm, with the face set ``skin`` and node sets ``fixed_*``.
    materials : by region.
    """
    frame = fit.frame
    local = (socket.points - fit.pivot) @ frame.T
    clear = None if fit.travel_mm is not None else (socket.clear - fit.pivot) @ frame.T
    shape = SmoothSurface.of(local, socket.faces, clear, centre=fit.pivot, axis=frame[2], edge=frame[0])
    times, growth, z = [0.0, fit.donning_s], [0.0, 1.0], [0.0, 0.0]
    if fit.travel_mm is not None:
        growth, z = [1.0, 1.0], [-fit.travel_mm, 0.0]
    if fit.hold_s > 0.0:
        times, growth, z = [*times, fit.donning_s + fit.hold_s], [*growth, 1.0], [*z, 0.0]
    motion, before = Motion.of(times, growth=growth, z=z), np.full(6, np.nan)  # what holds the donned socket
    for load in fit.loads:
        if not load.ramp_s > 0.0:
            what = f"the load {load.name!r} comes on within {load.ramp_s:g} s"
            raise ProblemError(what, remedy="give it time")
        force = np.asarray(load.force, dtype=float)
        moment = np.asarray(load.moment) + np.cross(np.asarray(load.point) - fit.pivot, force)
        after = np.concatenate([frame @ force, frame @ moment])  # about the pivot, in socket coordinates
        count = 3 if load.hold_s > 0.0 else 2
        values = dict(zip(COORDINATES, np.array([before, after, after][:count]).T, strict=True))
        times = [0.0, load.ramp_s, load.ramp_s + load.hold_s][:count]
        motion, before = motion.then(Motion.of(times, force=values)), after
    body = RigidBody(shape, mesh.face_sets[OUTER], motion, fit.friction, name="socket")
    return build_limb_problem(mesh, materials, motion.times[-1], bodies=(body,))


def build_limb_problem(mesh: Mesh, materials: Mapping[str, Material], end_s: float, **loads: Any) -> Problem:
    """A limb without an indenter, bones and proximal cut held; ``loads``: what else acts (see `Problem`)."""
    return Problem(
        mesh=mesh,
        materials=materials,
        fixed=mesh.held,
        contact_faces=np.zeros((0, mesh.kind.faces.shape[1]), dtype=np.int64),
        indenter=None,
        history=History(np.array([0.0, end_s]), np.zeros(2)),
        element=ELEMENT,
        **loads,
    )


def build_socket_steps(fit: SocketFit, modulus: float, threads: int | None = None) -> StepControl:
    """When a socket's simulation steps, and its contact stiffness; ``modulus`` as `Laws.modulus`, MPa.

    ``threads``: those that it may have, of which it takes no more than are of use; by default the machine's.
    """
    times: list[float] = []
    for i, (_, on, off) in enumerate(fit.ends):
        ramp_steps = LOAD_STEPS if i else RAMP_STEPS
        times += grade_ramp_and_hold(times[-1] if times else 0.0, on, off, ramp_steps, HOLD_STEPS)
    return StepControl(
        times=tuple(times),
        penalty=CONTACT_STIFFNESS / modulus,
        hold_penalty=True,
        threads=choose_threads(threads),
    )


def grade_ramp_and_hold(start: float, on: float, off: float, ramp_steps: int, hold_steps: int) -> list[float]:
    """Times, s, of even steps from ``start`` to ``on``, and of a hold until ``off`` that begins densely."""
    times = [start + (on - start) * k / ramp_steps for k in range(1, ramp_steps + 1)]
    if off > on:
        times += [on + (off - on) * (k / hold_steps) ** HOLD_POWER for k in range(1, hold_steps + 1)]
    return times


def choose_threads(available: int | None = None) -> int:
    """Threads of one simulation, of those that are ``available``; by default all of the machine's."""
    return min(available or count_usable_cores(), MAX_THREADS)


def build_pressed_problem(
    mesh: Mesh, materials: Mapping[str, Material], pressure_kPa: Array, on_s: float, hold_s: float
) -> Problem:
    """A limb whose outer surface bears a pressure that follows it; bones and proximal cut are held.

    Raises `ProblemError` where no face bears any.

    Parameters
    ----------
    mesh : LPS mm, with the face set ``skin`` and node sets ``fixed_*``.
    materials : by region.
    pressure_kPa : (f,) of the faces of that set, 0 or more; rounded to `PRESSURE_LEVELS`
        parts of the largest.
    on_s, hold_s : how long the pressure comes on and then stays.
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
    return build_limb_problem(mesh, materials, times[-1], pressures=tuple(pressures))


def press_limb(problem: Problem, on_step: Callable[[Step], None] | None = None) -> Result:
    """Simulate a problem of `build_pressed_problem`; the last state is kept."""
    _, on, *hold = map(float, problem.pressures[0].times)
    times = grade_ramp_and_hold(0.0, on, hold[-1] if hold else on, PRESSING_STEPS, PRESSED_STEPS)
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
