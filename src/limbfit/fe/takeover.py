"""How the forces that bodies take over from what held them depend on the parameters.

Where a displacement drives a coordinate that a force drives next, and that force is left open, it begins as
what held the coordinate.  A stiffer limb held the donned socket by more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .bodies import Bodies
from .motion import RigidBody
from .result import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Takeover:
    """When each body's forces were taken over last, ``since (b,)`` s, not a number where never, and their
    derivatives ``slopes (r - n, 3, p)`` in the rows of `System`, N over mm."""

    since: Array
    slopes: Array

    @classmethod
    def never(cls, bodies: Sequence[RigidBody], slopes: Array) -> Takeover:
        """Of bodies that took nothing over; ``slopes`` are zeros."""
        return cls(np.full(len(bodies), np.nan), slopes)

    def after(self, took: Sequence[bool], bodies: Bodies, state: State, modulus: float) -> Takeover:
        """When some bodies ``took (b,)`` over what held them in a state with derivatives; ``modulus`` is that
        of the contact's stiffness, MPa."""
        assert state.bodies is not None
        since, slopes = self.since.copy(), self.slopes.copy()
        found = bodies.holding_slopes(state.drives, state.penalty * modulus, state.bodies)
        for i, rows in enumerate(bodies.own_rows):
            if took[i]:
                since[i], slopes[rows] = state.time, found[rows]
        return replace(self, since=since, slopes=slopes)

    def left(self, stated: Sequence[RigidBody], bodies: Bodies, t: float) -> Array:
        """Derivatives (r - n, 3, p) of the forces that are left at time ``t`` of those taken over."""
        shares = np.zeros(len(self.slopes))
        for body, since, rows in zip(stated, self.since, bodies.own_rows, strict=True):
            shares[rows] = body.motion.lasting(since, t)
        return np.asarray(self.slopes * shares[:, None, None])
