"""What a simulation returns: the force over time, its sensitivities, states, statistics and warnings.

Between steps the force is a spline over each phase, in the root of time where steps are dense at its start:
there the force relaxes, and a spline in time through steps so uneven swings.  Phases end in kinks, what else
acts on the tissue turns in some, and so does contact: where it is lost, the spline of the steps before goes
on to zero; where it is found again, that of the steps after comes from there.

Warnings are about a simulation that reaches its end.  The caller decides by their kind what to do with it;
their text is for the user.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from ..arrays import Array
from ..mesh import Mesh, node_jacobians
from .contact.friction import StickyContact
from .memory import Memory
from .motion import Drives
from .problem import Problem

Kind = Literal["folded", "slipped", "sunk", "unbalanced", "unsettled", "inexact"]

RELAXATION_SHARE = 0.9  # a force below this share of the one before, in an advancing step, is no relaxation
SLOWER_SHARE = 0.75  # unless the step is slower than this share of a speed before it: what was quick relaxes
# Share of the strain energy that folded elements may hold: their stiffness lost, the force would fall by
# about as much, and less than by the error of the mesh.
FOLDED_ENERGY = 0.01


@dataclass(frozen=True)
class SimulationWarning:
    """One warning about a simulation.

    Parameters
    ----------
    kind : ``folded`` (elements that matter are inside out at a node), ``slipped`` (the force falls in
        loading), ``sunk`` (the indenter is deeper in the skin than allowed), ``unbalanced`` (equilibrium to
        less than the tolerance), ``unsettled`` (friction of another normal force than there is), ``inexact``
        (sensitivities).
    text : one sentence, with its remedy.
    count : elements (``folded``), or steps.
    depth_mm : indentation at which it first occurs; of folded elements, at which they were counted.
    share : the same over the largest indentation.
    """

    kind: Kind
    text: str
    count: int
    depth_mm: float
    share: float


@dataclass(frozen=True)
class State:
    """An accepted step: ``u (n, 3)`` mm at ``time`` s; ``sensitivity (n, 3, p)``; stresses in ``memory``.

    ``penalty`` (1/mm) is that of the contact which holds ``u`` in equilibrium.  ``coordinates (2 k, 3)``:
    moves and turns of the bodies that a force drives, mm, in the rows of `System`; ``bodies`` their
    derivatives (2 k, 3, p).  ``drives`` are what drives all bodies then, ``grips`` what holds points along
    them.
    """

    time: float
    displacement: float
    u: Array
    penalty: float
    sensitivity: Array | None = None
    memory: Memory | None = None
    coordinates: Array = field(default_factory=lambda: np.zeros((0, 3)))
    bodies: Array | None = None
    drives: Drives = field(default_factory=Drives.make_empty)
    grips: tuple[StickyContact | None, ...] = ()
    activation: float = 0.0

    @property
    def rows(self) -> Array:
        """(r, 3) displacements of the nodes, then those of the bodies, mm."""
        return np.concatenate([self.u, self.coordinates])

    @property
    def slopes(self) -> Array:
        """(r, 3, p) derivatives of the `rows`."""
        if self.sensitivity is None or self.bodies is None:
            raise ValueError("the state has no derivatives")
        return np.concatenate([self.sensitivity, self.bodies])


@dataclass(frozen=True)
class Step:
    """What `iterate` yields: one accepted step; see `Result`, of which it is a row."""

    time: float
    displacement: float
    force: float
    penetration: float
    contact_area: float
    newton_iterations: int
    force_sensitivity: Array | None
    reactions: Array
    coordinates: Array
    displacement_sensitivity: Array | None
    state: State


@dataclass(frozen=True)
class Result:
    """A simulation, complete or not.

    Parameters
    ----------
    times, displacement, force : (n,) s, mm, N (positive when pushing); the first is the equilibrium at 0 s.
    force_sensitivity : (n, p) derivative of the force with respect to each parameter (mm, N, s, MPa).
    parameter_names : (region, parameter) per column.
    penetration, contact_area : (n,) mm, mm^2 (reference).
    reactions : (n, b, 6) forces, N, and moments about the pivot, N mm, of every rigid body in its frame.
    coordinates : (n, b, 6) its moves, mm, and its rotation vector, rad.
    displacement_sensitivity : (n, p) derivative of the displacement, where a force drives the indenter.
    states : kept steps.
    completed, reason : False and why where the end of the history was not reached.
    doubts : the warnings about it, by kind; ``warnings`` are their texts.
    statistics : steps, ``sunk_steps`` (deeper in the skin than allowed), ``unbalanced_steps`` (accepted at
        more than the tolerance), ``unsettled_steps`` (whose friction had not settled), ``penalty_per_mm``
        (the largest), newton_iterations, factorisations, solves,
        linear_solver, whether its factors had to be in ``double_precision``, element, unknowns, seconds by
        part.
    """

    problem: Problem
    times: Array
    displacement: Array
    force: Array
    force_sensitivity: Array | None
    parameter_names: tuple[tuple[str, str], ...]
    penetration: Array
    contact_area: Array
    reactions: Array
    coordinates: Array
    displacement_sensitivity: Array | None
    states: tuple[State, ...]
    completed: bool
    reason: str
    statistics: Mapping[str, Any]
    doubts: tuple[SimulationWarning, ...] = ()
    system: Any = field(default=None, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """Results travel between processes without the discretisation, which is rebuilt where needed."""
        return {**self.__dict__, "system": None}

    @property
    def warnings(self) -> tuple[str, ...]:
        """The texts of the warnings about it."""
        return tuple(doubt.text for doubt in self.doubts)

    @property
    def reaction(self) -> Array:
        """(n, 3) force of the indenter along x, y and z of its frame, N; the last column is ``force``."""
        return self.reactions[:, 0, :3]

    @property
    def imbalance(self) -> Array:
        """(n, b) how far the contact of each body is from the forces and moments that are stated for it.

        The larger of two shares: of the force, N, and of the moment about the pivot, N mm, the latter over
        the stated moment or the force times half the body's width.  0 where nothing is stated.
        """
        drives = [self.problem.drives(float(t)) for t in self.times]
        forced = np.array([one.forced for one in drives])
        stated = np.where(forced, [one.values for one in drives], 0.0)
        missed = np.where(forced, self.reactions - stated, 0.0)
        force = np.linalg.norm(np.where(forced, stated, self.reactions)[..., :3], axis=-1)
        widths = np.array([body.shape.width for body in self.problem.rigid_bodies])
        moment = np.maximum(np.linalg.norm(stated[..., 3:], axis=-1), 0.5 * widths * force)
        shares = [
            np.linalg.norm(part, axis=-1) / np.where(size > 0.0, size, np.inf)
            for part, size in ((missed[..., :3], force), (missed[..., 3:], moment))
        ]
        return np.maximum(*shares)

    @property
    def peak_force(self) -> float:
        """Largest force, N."""
        return float(self.force.max())

    @property
    def deepest(self) -> State | None:
        """The kept state with stresses: where loading ends, or as far as the simulation came."""
        return next((state for state in self.states if state.memory is not None), None)

    def _interpolate(self, values: Array | None, t: ArrayLike, force: Array) -> Array:
        if values is None:
            raise ValueError("the simulation ran without sensitivities")
        at = np.clip(np.asarray(t, dtype=float), self.times[0], self.times[-1])
        found = interpolate(self.times, force, self.problem.kinks, values, at.ravel())
        return found.reshape(at.shape + values.shape[1:])

    def force_at(self, t: ArrayLike) -> Array:
        """Force (k,) at times ``t (k,)``, or at one time, N; interpolated between steps, never negative."""
        return self._interpolate(self.force, t, self.force)

    def displacement_at(self, t: ArrayLike) -> Array:
        """Displacement (k,) at times ``t (k,)``, mm, whether the indenter pushes then or not."""
        if not self.problem.history.forced:
            return self.problem.history.at(np.clip(t, self.times[0], self.times[-1]))
        return self._interpolate(self.displacement, t, np.ones_like(self.force))

    def sensitivity_at(self, t: ArrayLike) -> Array:
        """Derivative (k, p) of `force_at` with respect to the parameters."""
        return self._interpolate(self.force_sensitivity, t, self.force)

    def response_at(self, t: ArrayLike) -> Array:
        """What answers to the drive at times ``t (k,)``: force, N, or displacement, mm, under a force."""
        return self.displacement_at(t) if self.problem.history.forced else self.force_at(t)

    def response_sensitivity_at(self, t: ArrayLike) -> Array:
        """Derivative (k, p) of `response_at` with respect to the parameters."""
        if not self.problem.history.forced:
            return self.sensitivity_at(t)
        return self._interpolate(self.displacement_sensitivity, t, np.ones_like(self.force))


def interpolate(times: Array, force: Array, kinks: Array, values: Array, at: Array) -> Array:
    """Values (k, ...) at times ``at (k,)`` of what is ``values (n, ...)`` at the steps, s.

    Zero where the ``force (n,)`` between the steps is not positive; for a given force linear in the values.
    ``kinks``: as `Problem.kinks`, s.
    """
    out = np.zeros((len(at), *values.shape[1:]))
    for first, last in _find_stretches(times, force, kinks):
        x, pushes = times[first : last + 1], force[first : last + 1]
        inside = np.flatnonzero((at >= x[0]) & (at <= x[-1]))
        if not len(inside):
            continue
        start = float(kinks[kinks <= x[0] + 1e-9 * times[-1]].max(initial=times[0]))
        since = times[times > start + 1e-9 * times[-1]] - start
        # A whole number: the force is smooth in time, and so remains smooth in the variable.
        power = 2 if len(since) > 1 and since[1] > 3.0 * since[0] else 1
        x, t = ((np.maximum(s - start, 0.0)) ** (1.0 / power) for s in (x, at[inside]))
        nodes = len(x)
        if nodes > 2 and pushes[-1] <= 0.0:
            ends = [
                _build_spline(x[-1 - n : -1], pushes[-1 - n : -1])(x[-1]) for n in (3, nodes - 1) if n < nodes
            ]
            nodes -= int(max(ends) <= 0.0)  # contact ended on the way
        skip = 0
        if nodes > 2 and pushes[0] <= 0.0 and np.any(force[:first] > 0.0):
            starts = [_build_spline(x[1 : n + 1], pushes[1 : n + 1])(x[0]) for n in (2, 3) if n < nodes]
            skip = int(max(starts) <= 0.0)  # tissue that had not come back yet was met on the way
        kept = slice(skip, nodes)
        inside = inside[(pushing := _build_spline(x[kept], pushes[kept])(t) > 0.0)]
        out[inside] = _build_spline(x[kept], values[first : last + 1][kept])(t[pushing])
    return out


def _find_stretches(times: Array, force: Array, kinks: Array) -> list[tuple[int, int]]:
    """First and last step of each stretch of a phase in which the indenter pushes."""
    corners = np.searchsorted(times, kinks - 1e-9 * times[-1]).clip(0, len(times) - 1)
    found = []
    for a, b in pairwise(np.union1d(corners, [0, len(times) - 1]).tolist()):
        while a < b:
            if force[a] <= 0.0 and force[a + 1] <= 0.0:
                a += 1
                continue
            lost = np.flatnonzero(force[a + 1 : b + 1] <= 0.0)
            end = a + 1 + int(lost[0]) if len(lost) else b
            found.append((a, end))
            a = end
    return found


def _build_spline(x: Array, y: Array) -> BSpline:
    return make_interp_spline(x, y, k=min(3, len(x) - 1))


def list_texts(doubts: Sequence[SimulationWarning], *kinds: Kind) -> tuple[str, ...]:
    """The text of each kind of warning; empty where there is none of that kind."""
    said = {doubt.kind: doubt.text for doubt in doubts}
    return tuple(said.get(kind, "") for kind in kinds)


def _build_warning(
    kind: Kind, text: str, count: int, depth_mm: float, displacement: Array
) -> tuple[SimulationWarning]:
    most = float(np.abs(displacement).max(initial=0.0))
    return (SimulationWarning(kind, text, count, float(depth_mm), float(depth_mm) / most if most else 0.0),)


def find_inverted_elements(
    mesh: Mesh, u: Array, energy: Callable[[], Array], depth_mm: float, displacement: Array
) -> tuple[SimulationWarning, ...]:
    """Elements that are inside out at a node of theirs at the displacements ``u (n, 3)`` of a depth.

    The quadrature of ``tet10`` lies inside and does not see it; the element has lost part of its stiffness.
    There is no warning where they hold less than `FOLDED_ENERGY` of all ``energy (m,)``, N mm.
    """
    shape = mesh.with_points(mesh.points + u)
    inverted = (node_jacobians(shape) <= 0.0).any(axis=1)
    if not inverted.any():
        return ()
    held = energy()
    share = float(held[inverted].sum() / held.sum())
    if share < FOLDED_ENERGY:
        return ()
    count = int(inverted.sum())
    text = (
        f"{count} elements are inside out at a node at {depth_mm:.3g} mm; they hold {100 * share:.2g} % of "
        "the strain energy, and the force may be too small by about as much: use element tet10v, a rounded "
        "edge of the indenter or a finer mesh at its edge"
    )
    return _build_warning("folded", text, count, depth_mm, displacement)


def find_slip(times: Array, displacement: Array, force: Array) -> tuple[SimulationWarning, ...]:
    """A warning if the force (n,), N, falls while the indenter advances (n,), mm, as quickly as before.

    The tissue has lost its equilibrium.
    """
    advance = np.diff(displacement)
    speeds = advance / np.diff(times)
    steady = speeds > SLOWER_SHARE * np.maximum.accumulate(speeds)
    advancing = steady & (advance > 1e-2 * displacement.max())
    falls = np.flatnonzero(advancing & (force[1:] < RELAXATION_SHARE * force[:-1]))
    if not len(falls):
        return ()
    (before, after), (start, end) = force[falls[0] :][:2], displacement[falls[0] :][:2]
    text = (
        f"the force falls from {before:.3g} N to {after:.3g} N while the indenter advances from {start:.3g} "
        f"to {end:.3g} mm: tissue folds, or slips past the indenter between contact points; "
        "use a finer mesh there"
    )
    return _build_warning("slipped", text, len(falls), start, displacement)


def find_penetration(
    displacement: Array, penetration: Array, allowed_mm: float, penalty: float
) -> tuple[SimulationWarning, ...]:
    """Steps whose penetration (n,), mm, is more than is allowed, with contact of ``penalty`` (1/mm)."""
    deep = np.flatnonzero(penetration > allowed_mm)
    if not len(deep):
        return ()
    most = float(penetration.max())
    stiffer = float(f"{1.5 * penalty * most / allowed_mm:.2g}")
    text = (
        f"the indenter sinks in by up to {most:.3g} mm in {len(deep)} steps, more than the allowed "
        f"{allowed_mm:.3g} mm, and the force is a little too small: state a stiffer contact than "
        f"{penalty:.4g} per mm (solver.penalty_per_mm), such as {stiffer:g}"
    )
    return _build_warning("sunk", text, len(deep), displacement[deep[0]], displacement)


def find_inexact_steps(
    kind: Literal["unbalanced", "unsettled"],
    displacement: Array,
    steps: Sequence[tuple[float, float]],
    tolerance: float,
) -> tuple[SimulationWarning, ...]:
    """Steps, as (mm, residual over reactions), that were accepted at more than the tolerance, or whose
    friction did not settle with the normal force."""
    if not steps:
        return ()
    count, worst, first = len(steps), max(residual for _, residual in steps), f"first at {steps[0][0]:.3g} mm"
    texts = {
        "unbalanced": f"{count} steps are in equilibrium to {worst:.2g} of the reactions only, not to "
        f"{tolerance:.2g}, {first}: the force may be off by as much",
        "unsettled": f"the friction of {count} steps belongs to a normal force that is off by up to "
        f"{worst:.2g} of the reactions, {first}: use more steps",
    }
    return _build_warning(kind, texts[kind], count, steps[0][0], displacement)


def find_inexact_sensitivities(displacement: Array, count: int) -> tuple[SimulationWarning, ...]:
    """Sensitivities of unstable equilibria that could not be solved for."""
    text = f"{count} sensitivities at unstable equilibria are inexact"
    return _build_warning("inexact", text, count, 0.0, displacement) if count else ()
