"""With what a simulation and its steps begin: what holds points along bodies, what it is judged by, where the
indenter starts, first guesses.

Where tissue has moved before (pins hold it, it is tensed, or strained at rest), the indenter stays clear of
it until `Problem.touch_down_s`; then it is advanced until it just touches, and its displacement counts from
there. That place follows the parameters, and so its derivative enters all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array
from ..bodies import count_body_rows
from ..contact.contact import find_touching_offset
from ..contact.friction import LAWS_OF_STICKING, Anchors, StickyContact
from ..memory import Memory
from ..motion import Drives
from ..problem import Problem
from ..result import Result
from ..system import Evaluation, System
from .coupling import Coupling


def measure_indenter_travel(system: System, modulus: float) -> float:
    """The travel against which penetration is judged, mm.

    It is the largest travel of a body that is driven by displacement, or the depth of the tissue at rest in
    what a body grows to.

    Where only forces drive bodies it is that of a flat punch on a half-space of the tissue's shear
    ``modulus``, ``F / (4 mu w)``, and no more than half a width.
    """
    bodies = system.problem.rigid_bodies
    if not bodies:
        return float(np.abs(system.problem.history.driver).max())
    grown = [-one.surface.gaps_at_rest(one.start.grown(1.0)).min() for one in system.bodies.all
             if one.stated.motion.grows]  # fmt: skip
    if max(grown, default=0.0) > 0.0:
        return float(max(grown))
    sizes = [np.abs(np.nan_to_num(body.motion.values[:, :3])) for body in bodies]
    ways = [np.where(body.motion.free[:3], 0.0, size).max() for body, size in zip(bodies, sizes)]
    if max(ways) > 0.0:
        return float(max(ways))
    widths = [body.shape.width for body in bodies]
    pushed = [float(size.max()) / (4.0 * modulus * width) for size, width in zip(sizes, widths)]
    return max(min(way, width / 2) for way, width in zip(pushed, widths)) or max(widths) / 2


def build_grips(
    system: System, parameters: int, u: Array, drives: Drives
) -> tuple[StickyContact | None, ...]:
    """What holds the points of each body at first, where it is at rest; None where nothing ever does."""
    grips: list[StickyContact | None] = []
    for body, tool in zip(system.bodies.all, system.bodies.tools(u, drives), strict=True):
        friction = body.stated.friction
        if friction in ("frictionless", 0.0):
            grips.append(None)
        elif isinstance(friction, str):
            grips.append(Anchors.begin(body.surface, parameters))
        else:
            law = LAWS_OF_STICKING[body.stated.sticking]
            grip = law.begin(float(friction), body.surface, parameters, body.stated.holding)
            grips.append(grip.start(tool))
    return tuple(grips)


def compute_tangent_at_rest(system: System) -> Array:
    """Entries of the tangent of the undeformed body, before contact, with its problem's materials."""
    problem = system.problem
    laws = problem.build_laws()
    start = problem.history.displacement_at(0.0)
    increment = Memory.rest(system, laws).build_increment(
        system, laws, 1.0, 1.0, start, 0.0, problem.drives(0.0)
    )
    return system.evaluate(np.zeros((system.rows, 3)), laws, increment).tangent


CLEARANCE_WIDTHS = 3.0  # widths of the indenter that it is off the tissue until it touches


@dataclass(frozen=True)
class IndenterStart:
    """How far the indenter begins beyond where it would touch the tissue at rest.

    ``waits``: True if it is still clear of the tissue. ``offset``: mm along its axis. ``slope``: (p,)
    derivative of the offset with respect to the parameters; None where it has none.
    """

    waits: bool = False
    offset: float = 0.0
    slope: Array | None = None

    @classmethod
    def from_problem(cls, problem: Problem) -> IndenterStart:
        """The start of a simulation of a problem."""
        meets = problem.touch_down_s > 0.0 or (problem.prestretch is not None and problem.start == "touching")
        if problem.indenter is None or not meets:
            return cls()
        return cls(True, -CLEARANCE_WIDTHS * problem.indenter.width)

    def touch_down(self, system: System, u: Array, drives: Drives, du: Array | None) -> IndenterStart:
        """The start once it touches the tissue at ``u (r, 3)``, whose derivative is ``du (r, 3, p)``."""
        body = system.bodies.first_body
        surface = replace(body.surface, points=body.surface.points + u[: system.nodes])
        offset = find_touching_offset(surface, body.start)
        if du is None:
            return IndenterStart(False, offset)
        moved = IndenterStart(False, offset).shift_drives(drives)
        tool = system.bodies.tools(u, moved)[0]
        gaps, normals, _ = tool.body.local_distance(tool.local_points)
        at = np.unravel_index(gaps.argmin(), gaps.shape)
        normal = normals[at]
        return IndenterStart(False, offset, normal @ tool.relative_motion(du)[at] / normal[2])

    def shift_drives(self, drives: Drives) -> Drives:
        """What drives the bodies, with the indenter moved by the offset."""
        if not self.offset:
            return drives
        values = drives.values.copy()
        values[0, 2] += self.offset
        return replace(drives, values=values)

    def differentiate_contact_forces(
        self, system: System, at: Evaluation, coupling: Coupling
    ) -> Array | None:
        """Derivative (c, 3, p) of the forces on the contact points through the offset alone, N."""
        if self.slope is None or at.touch is None:
            return None
        points, axis = system.bodies.first_body.points, system.bodies.first_body.frame[2]
        out = np.zeros((system.bodies.count, 3, len(self.slope)))
        stiff = (at.touch.blocks + coupling.blocks)[points]
        out[points] = -(stiff @ axis)[..., None] * self.slope
        return out

    def subtract_touch(self, system: System, du: Array | None) -> Array | None:
        """Derivatives (r, 3, p) of displacements, relative to where the indenter touched."""
        if du is None or self.slope is None:
            return du
        return du - system.bodies.first_body.frame[2][:, None] * self.slope


SAME_S = 1e-9  # s: times of two simulations that differ by less are the same


def compute_extrapolation(travels: Sequence[float], travel: float) -> Array:
    """Weights (k,) of the last states' fields, at ``travels (k,)`` of the indenter, that predict the field at
    ``travel`` mm.

    Quadratic in the travel while it goes on steadily; linear where it has just turned or leaps.
    """
    d = np.asarray(travels, dtype=float)
    weights = np.zeros(len(d))
    weights[-1] = 1.0
    moved = np.diff(d)
    if len(d) < 2 or moved[-1] == 0.0:
        return weights
    slope = float(np.clip((travel - d[-1]) / moved[-1], -2.0, 8.0))
    step = slope * moved[-1]
    weights[-2:] += -slope, slope
    if len(d) > 2 and 0.0 < slope <= 2.0 and moved[0] * moved[1] > 0.0:
        bend = step * (step + moved[1]) / (d[2] - d[0])
        weights += bend * np.array([1.0 / moved[0], -1.0 / moved[0] - 1.0 / moved[1], 1.0 / moved[1]])
    return weights


@dataclass(frozen=True)
class WarmStart:
    """The displacements ``u`` (r, 3), rows of bodies included, of another simulation at ``times`` (k,) s."""

    times: Array
    u: tuple[Array, ...]

    @classmethod
    def from_result(cls, problem: Problem, result: Result | None) -> WarmStart:
        """The states of a result on the same mesh, moved to the new parameters along their sensitivities."""
        rows = count_body_rows(problem.rigid_bodies)
        shapes = [(state.u.shape, len(state.coordinates)) for state in result.states[:1]] if result else []
        if result is None or shapes != [(problem.mesh.points.shape, rows)]:
            return cls(np.zeros(0), ())
        times = np.array([state.time for state in result.states])
        if all(state.sensitivity is None for state in result.states):  # of whatever law and parameters
            return cls(times, tuple(state.rows for state in result.states))
        new, old = problem.parameters, result.problem.parameters
        with np.errstate(all="ignore"):  # moduli act by their ratio
            change = np.where(new * old > 0.0, old * np.log(new / old), new - old)
        moved = [
            state.rows if state.sensitivity is None else state.rows + state.slopes @ change
            for state in result.states
        ]
        return cls(times, tuple(moved))

    def interpolate(self, t: float) -> Array | None:
        """Displacement (n, 3) at a time, linear between the states; None outside of them."""
        if not len(self.times) or not self.times[0] - SAME_S <= t <= self.times[-1] + SAME_S:
            return None
        after = min(int(np.searchsorted(self.times, t - SAME_S)), len(self.times) - 1)
        before = max(after - 1, 0)
        if after == before or abs(self.times[after] - t) <= SAME_S:
            return self.u[after]
        share = (t - self.times[before]) / (self.times[after] - self.times[before])
        return self.u[before] + share * (self.u[after] - self.u[before])
