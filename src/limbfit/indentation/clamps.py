"""The pins that hold the limb while one indents it, as rigid bodies under force.

The device of the source paper (section 2.1) has 14 pins in a ring.  The one at the site indents, the two
beside it stay clear of the skin so that tissue can bulge, and the other eleven press the limb with 14 to 16 N
before the test.  There they then stay where they are; here each keeps its force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import History, Indenter, Motion, Problem, Result, RigidBody, StepControl, solve
from ..fe.contact.contact import ContactSurface, touching_offset
from ..mesh import Mesh

Array = NDArray[np.float64]
CLEAR_MM = 5.0  # of the skin: how far off the test pin waits
APPROACH_S = 1.0  # its way back to the skin
CLAMPING_STEPS, SETTLING_STEPS = 8, 4


@dataclass(frozen=True)
class Clamps:
    """The clamping pins.

    Parameters
    ----------
    force_N : of each pin.
    pins : in the ring, the test pin among them, evenly spaced.
    clear : on either side of the test pin, off the skin.
    width_mm : of their square heads.
    clamping_s, settling_s : how long the force rises, and how long it then acts before the test.
    """

    force_N: float = 15.0
    pins: int = 14
    clear: int = 1
    width_mm: float = 20.0
    clamping_s: float = 2.0
    settling_s: float = 5.0

    @property
    def begun_s(self) -> float:
        """When the test pin starts towards the skin, s."""
        return self.clamping_s + self.settling_s


@dataclass(frozen=True)
class Clamped:
    """An indentation of a clamped limb.

    ``problem`` with the pins as bodies, its history begins ``started_s`` before the skin is touched.
    ``moved_mm``: how far clamping moves the skin at the site along the indenter's axis, positive inwards;
    ``sunk_mm (k,)`` how far each pin went in.
    """

    problem: Problem
    started_s: float
    moved_mm: float
    sunk_mm: Array


def clamping_pins(mesh: Mesh, indenter: Indenter, along: Array, clamps: Clamps) -> tuple[Indenter, ...]:
    """The clamping pins, each where it just touches the skin; those that would miss it are left out.

    Parameters
    ----------
    mesh : with the face set ``skin``.
    indenter : the test pin, at its site.
    along : (3,) the limb's axis; the ring lies across it, in the plane of the test pin.

    Raises
    ------
    ProblemError
        Where the test pin points along the limb, or no pin meets the skin.
    """
    inwards = indenter.frame[2]
    normal = np.asarray(along, dtype=float) - (along @ inwards) * inwards
    if np.linalg.norm(normal) < 0.3 * np.linalg.norm(along):
        raise ProblemError("the indenter points along the limb, where no ring of pins holds it")
    normal /= np.linalg.norm(normal)
    skin = mesh.face_sets["skin"]
    middles = mesh.points[skin[:, :3]].mean(axis=1)
    section = middles[np.abs((middles - indenter.centre) @ normal) < clamps.width_mm / 2.0]
    radius = 0.5 * np.ptp((section - indenter.centre) @ inwards)
    centre = np.asarray(indenter.centre) + radius * inwards
    found = []
    for k in range(clamps.clear + 1, clamps.pins - clamps.clear):
        turn = 2.0 * np.pi * k / clamps.pins
        axis = np.cos(turn) * inwards + np.sin(turn) * np.cross(normal, inwards)
        pin = Indenter("square", clamps.width_mm, centre=centre - 3.0 * radius * axis, axis=axis, edge=normal)
        across = (section - centre) @ np.cross(normal, axis)
        ahead = section[(np.abs(across) < clamps.width_mm / 2.0) & ((section - centre) @ axis < 0.0)]
        if len(ahead):
            found.append(pin)
    if not found:
        raise ProblemError("no clamping pin meets the skin")
    return tuple(found)


def clamped(problem: Problem, along: Array, clamps: Clamps, control: StepControl) -> Clamped:
    """An indentation by displacement as it is in a limb that pins hold.

    The limb is clamped first, with the test pin off the skin.  Where the skin then is, the indentation
    begins: its history is that of ``problem`` from there.

    Parameters
    ----------
    problem : the site with an indenter that starts in touch, driven by displacement.
    along : (3,) the limb's axis.
    control : its penalty and tolerance are those of both simulations.

    Raises
    ------
    ProblemError
        Where the pins do not meet the limb, or the limb cannot be clamped.
    """
    indenter = problem.indenter
    if indenter is None or problem.history.forced or problem.start != "touching":
        raise ProblemError("clamps stand beside an indenter that is driven by displacement from touch-down")
    pins = clamping_pins(problem.mesh, indenter, along, clamps)
    history = problem.history
    end = clamps.begun_s + APPROACH_S + float(history.times[-1])
    bodies = tuple(_body(problem, pin, clamps, end, f"clamp {i}") for i, pin in enumerate(pins, 1))
    held = _hold(replace(problem, indenter=None, bodies=bodies), clamps, control)
    state = held.states[-1]
    faces, rule = np.asarray(problem.contact_faces), problem.contact_rule
    before, after = (
        touching_offset(ContactSurface.build(problem.formulation, points, faces, rule), indenter)
        for points in (problem.mesh.points, problem.mesh.points + state.u)
    )
    start = min(before, after) - CLEAR_MM
    way = after - start
    times = np.concatenate([[0.0], clamps.begun_s + np.append(0.0, APPROACH_S + history.times)])
    advance = np.concatenate([[0.0, 0.0], way + np.asarray(history.displacement)])
    beside = replace(
        problem,
        indenter=indenter.moved(start),
        start="as-given",
        history=History(times, advance),
        bodies=bodies,
    )
    sunk = held.coordinates[-1][:, 2]
    return Clamped(beside, clamps.begun_s + APPROACH_S, after - before, sunk)


def _body(problem: Problem, pin: Indenter, clamps: Clamps, end: float, name: str) -> RigidBody:
    """A pin that just touches the skin, pressed by its force until the end, s."""
    mesh, skin = problem.mesh, problem.mesh.face_sets["skin"]
    local = (mesh.points[skin[:, :3]].mean(axis=1) - pin.centre) @ pin.frame.T
    reach = 0.5 * clamps.width_mm + 8.0
    near = (np.abs(local[:, :2]) < reach).all(axis=1) & (local[:, 2] > 0.0)
    near &= local[:, 2] < local[near, 2].min() + clamps.width_mm
    surface = ContactSurface.build(problem.formulation, mesh.points, skin[near], problem.contact_rule)
    times = [0.0, clamps.clamping_s, end]
    motion = Motion.of(times, force={"z": [0.0, clamps.force_N, clamps.force_N]})
    return RigidBody(pin.moved(touching_offset(surface, pin)), skin[near], motion, name=name)


def _hold(problem: Problem, clamps: Clamps, control: StepControl) -> Result:
    """The limb under its pins alone, to when the test begins."""
    end = clamps.begun_s
    still = replace(problem, history=History(np.array([0.0, end]), np.zeros(2)))
    rise = clamps.clamping_s * np.arange(1, CLAMPING_STEPS + 1) / CLAMPING_STEPS
    rest = clamps.clamping_s + clamps.settling_s * (np.arange(1, SETTLING_STEPS + 1) / SETTLING_STEPS) ** 2
    result = solve(still, replace(control, times=(*rise, *rest)), store="all")
    if not result.completed:
        raise ProblemError(f"the limb cannot be clamped with {clamps.force_N:g} N: {result.reason}")
    return result
