"""What a simulation returns: the force over time, its sensitivities, states and statistics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .contact.grip import StickyContact
from .doubts import SimulationWarning
from .history import Memory
from .interpolation import interpolate
from .motion import Drives
from .problem import Problem

Array = NDArray[np.float64]


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
    drives: Drives = field(default_factory=Drives.none)
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

    @property
    def reaction(self) -> Array:
        """(3,) force of the indenter along x, y and z of its frame, N."""
        return self.reactions[0, :3] if len(self.reactions) else np.zeros(3)


@dataclass(frozen=True)
class Result:
    """A simulation, complete or not.

    Parameters
    ----------
    times, displacement, force : (n,) s, mm, N (positive when pushing); the first is rest.
    force_sensitivity : (n, p) derivative of the force with respect to each parameter (mm, N, s, MPa).
    parameter_names : (region, parameter) per column.
    penetration, contact_area : (n,) mm, mm^2 (reference).
    reactions : (n, b, 6) forces, N, and moments about the pivot, N mm, of every rigid body in its frame.
    coordinates : (n, b, 6) its moves, mm, and its rotation vector, rad.
    displacement_sensitivity : (n, p) derivative of the displacement, where a force drives the indenter.
    states : kept steps.
    completed, reason : False and why where the end of the history was not reached.
    doubts : what is doubtful about it, by kind; ``warnings`` are their texts.
    statistics : steps, ``sunk_steps`` (deeper in the skin than allowed), ``unbalanced_steps`` (accepted at
        more than the tolerance), ``unsettled_steps`` (whose friction had not settled), ``penalty_per_mm``
        (the largest), newton_iterations, factorisations, multigrids (made, one for each matrix), solves,
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
        """What is doubtful about it, in words."""
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
        return np.array([self._imbalance(i) for i in range(len(self.times))])

    def _imbalance(self, i: int) -> Array:
        drives, out = self.problem.drives(float(self.times[i])), np.zeros(self.reactions.shape[1])
        for j, body in enumerate(self.problem.rigid_bodies):
            stated = np.where(drives.forced[j], drives.values[j], 0.0)
            off = np.where(drives.forced[j], self.reactions[i, j] - stated, 0.0)
            force = float(
                np.linalg.norm(np.where(drives.forced[j, :3], stated[:3], self.reactions[i, j, :3]))
            )
            moment = max(float(np.linalg.norm(stated[3:])), 0.5 * body.shape.width * force)
            for part, size in ((off[:3], force), (off[3:], moment)):
                missed = float(np.linalg.norm(part))
                out[j] = max(out[j], missed / size if missed > 0.0 and size > 0.0 else 0.0)
        return out

    @property
    def peak_force(self) -> float:
        """Largest force, N."""
        return float(self.force.max())

    @property
    def deepest(self) -> State | None:
        """The kept state with stresses: where loading ends, or as far as the simulation came."""
        return next((state for state in self.states if state.memory is not None), None)

    def _interpolate(self, values: Array, t: Array) -> Array:
        return interpolate(self.times, self.force, self.problem.history.kinks, values, t)

    def _inside(self, t: Array) -> Array:
        return np.clip(t, self.times[0], self.times[-1])

    def force_at(self, t: Array) -> Array:
        """Force (k,) at times ``t (k,)``, N; interpolated between steps, never negative."""
        at = self._inside(np.asarray(t, dtype=float))
        return self._interpolate(self.force, at)

    def displacement_at(self, t: Array) -> Array:
        """Displacement (k,) at times ``t (k,)``, mm, between steps as `force_at`."""
        return self._interpolate(self.displacement, self._inside(np.asarray(t, dtype=float)))

    def sensitivity_at(self, t: Array) -> Array:
        """Derivative (k, p) of `force_at` with respect to the parameters."""
        return self._slope_at(self.force_sensitivity, t)

    def response_at(self, t: Array) -> Array:
        """What answers to the drive at times ``t (k,)``: force, N, or displacement, mm, under a force."""
        return self.displacement_at(t) if self.problem.history.forced else self.force_at(t)

    def response_sensitivity_at(self, t: Array) -> Array:
        """Derivative (k, p) of `response_at` with respect to the parameters."""
        forced = self.problem.history.forced
        return self._slope_at(self.displacement_sensitivity if forced else self.force_sensitivity, t)

    def _slope_at(self, slopes: Array | None, t: Array) -> Array:
        if slopes is None:
            raise ValueError("the simulation ran without sensitivities")
        return self._interpolate(slopes, self._inside(np.asarray(t, dtype=float)))
