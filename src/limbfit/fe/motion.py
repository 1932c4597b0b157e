"""Rigid bodies beside the indenter, and how they are driven: by displacement or by force, each coordinate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from .contact.rigid import RigidShape

HARDNESS_GROWING = 0.05  # of a surface that grows: its points move along it by tenths of a mm in a step
# A body's coordinates: its move along the axes of its frame at the start, mm, and its rotation vector about
# them, rad.  Conjugate to them are the force, N, and the moment about the pivot, N mm.
COORDINATES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")


@dataclass(frozen=True)
class Motion:
    """What drives a rigid body over time, piecewise linear.

    Parameters
    ----------
    times : (n,) s, from 0.  A time that occurs twice ends one motion and begins the next: there a
        coordinate may change from displacement to force, or back.
    values : (n, 6) of the `COORDINATES`: mm and rad; of those driven by force, the force, N, or the moment,
        N mm.  Where a coordinate changes to force (`then`), nan stands for the force that holds it then.
    forced : (6,), or (n - 1, 6) for each interval: which coordinates are driven by force; the others are
        held at their values.
    growth : (n,) how far the shape has grown, from 0, its ``clear`` one, to 1, its final one; 1 throughout
        where not given.  Always prescribed.
    """

    times: Array
    values: Array
    forced: Sequence[bool] | Mask = (False,) * 6
    growth: Array | Sequence[float] | None = None

    def __post_init__(self) -> None:
        times, values = np.array(self.times, dtype=float), np.array(self.values, dtype=float)
        if times.ndim != 1 or len(times) < 2 or values.shape != (len(times), 6):
            raise ProblemError("a motion needs two or more times and six values for each")
        steps = np.diff(times)
        begun = np.append(True, steps == 0.0)  # the first row, and those after a time that stands twice
        if not (np.isfinite(times).all() and np.isfinite(values[~begun]).all()) or np.isinf(values).any():
            raise ProblemError("a motion holds values that are not finite")
        twice = np.flatnonzero(steps == 0.0)
        if times[0] != 0.0 or (steps < 0.0).any() or 0 in twice or (np.diff(twice) == 1).any():
            raise ProblemError("the times of a motion do not grow from 0")
        forced = np.asarray(self.forced, dtype=bool)
        if forced.shape not in ((6,), (len(times) - 1, 6)):
            raise ProblemError("a motion says of six coordinates whether they are forced")
        growth = np.ones(len(times)) if self.growth is None else np.array(self.growth, dtype=float)
        if growth.shape != times.shape:
            raise ProblemError("the growth of a motion is not one share for each time")
        if not ((growth >= 0.0) & (growth <= 1.0)).all():
            raise ProblemError("the growth of a motion is not between 0 and 1")
        forced = np.broadcast_to(forced, (len(times) - 1, 6))
        if (np.isnan(values[:-1]) & ~forced).any() or np.isnan(values[-1]).any():
            raise ProblemError("a motion leaves open where a coordinate is held", remedy="state its value")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "growth", growth)
        object.__setattr__(self, "forced", forced)

    @classmethod
    def of(
        cls, times: Sequence[float] | Array, *, force: dict[str, Sequence[float] | float] | None = None,
        growth: Sequence[float] | Array | None = None, **moves: Sequence[float] | float,
    ) -> Motion:  # fmt: skip
        """From the coordinates by name, ``z=[0, 2, 2]``; those driven by ``force={"z": [0, 15, 15]}``.

        A coordinate that is not named is held at 0.
        """
        values, forced = np.zeros((len(np.asarray(times)), 6)), [False] * 6
        driven = force or {}
        for name, given in (*moves.items(), *driven.items()):
            if name not in COORDINATES:
                raise ProblemError(f"no coordinate {name!r}", remedy=f"use one of {', '.join(COORDINATES)}")
            if name in moves and name in driven:
                raise ProblemError(f"the coordinate {name!r} is driven by displacement and by force")
            try:
                values[:, COORDINATES.index(name)] = given
            except ValueError:
                raise ProblemError(f"the values of {name!r} are not one for each time") from None
            forced[COORDINATES.index(name)] = name in driven
        return cls(np.asarray(times, dtype=float), values, tuple(forced), growth)

    def then(self, after: Motion) -> Motion:
        """This motion, and when it ends another, whose times begin at 0 anew."""
        return Motion(
            np.concatenate([self.times, self.times[-1] + after.times]),
            np.concatenate([self.values, after.values]),
            np.concatenate([self.forced, after.forced[:1], after.forced]),
            np.concatenate([np.asarray(self.growth), np.asarray(after.growth)]),
        )

    def delay(self, seconds: float) -> Motion:
        """The same motion, begun so many seconds later; until then it stays at its first values."""
        if not seconds:
            return self
        times, forced = np.append(0.0, np.asarray(self.times) + seconds), np.asarray(self.forced)
        values, growth = np.vstack([self.values[:1], self.values]), np.asarray(self.growth)
        return Motion(times, values, np.vstack([forced[:1], forced]), np.append(growth[0], growth))

    def take_over_forces(self, t: float, reaction: Array) -> Motion:
        """The motion with the ``reaction (6,)`` as the forces that begin at time ``t`` and were open."""
        here = np.isclose(self.times, t, rtol=1e-9, atol=0.0)[:, None] & np.isnan(self.values)
        return replace(self, values=np.where(here, reaction, self.values)) if here.any() else self

    def remaining_share(self, since: float, t: float) -> float:
        """Share that is left at time ``t`` of forces that were taken over at time ``since``.

        They go over into the next values.  Nothing where ``since`` is not a number.
        """
        if np.isnan(since):
            return 0.0
        i = int(np.searchsorted(self.times, since * (1.0 + 1e-9), side="right")) - 1
        start, end = self.times[i : i + 2]
        return float(np.clip((end - t) / (end - start), 0.0, 1.0))

    @property
    def free(self) -> Mask:
        """(6,) which coordinates a force drives at some time."""
        return np.asarray(self.forced).max(axis=0).astype(bool)

    @property
    def grows(self) -> bool:
        """True if its shape is ever another than the final one."""
        return bool((np.asarray(self.growth) != 1.0).any())

    def at(self, t: float) -> tuple[Array, Mask, float]:
        """The values (6,) at time ``t``, which of them are forces, and the growth; at the end of an interval,
        its own."""
        i = min(max(int(np.searchsorted(self.times, t)) - 1, 0), len(self.times) - 2)
        share = np.clip((t - self.times[i]) / (self.times[i + 1] - self.times[i]), 0.0, 1.0)
        start, end = self._driven_values[i : i + 2]
        found = (1.0 - share) * start + share * end
        return found[:6], np.asarray(self.forced)[i], float(found[6])

    def moving_s(self, t: float) -> float:
        """For how long anything has changed up to time ``t``, s."""
        return measure_moving_time(self.times, self._driven_values, t)

    @property
    def _driven_values(self) -> Array:
        """(n, 7) the values, and the growth."""
        return np.column_stack([self.values, np.asarray(self.growth)])

    @property
    def turns(self) -> Array:
        """Times between the ends at which a rate, or what drives a coordinate, changes, s."""
        steps = np.diff(self.times)
        kept = steps > 0.0
        rates = np.diff(np.nan_to_num(self._driven_values), axis=0)[kept] / steps[kept, None]
        forced = np.asarray(self.forced)[kept]
        size = np.abs(rates).max(axis=0, initial=0.0)
        changed = (np.abs(np.diff(rates, axis=0)) > 1e-9 * size).any(axis=1)
        changed |= (forced[1:] != forced[:-1]).any(axis=1)
        return self.times[:-1][kept][1:][changed]


@dataclass(frozen=True)
class Drives:
    """What drives the rigid bodies at one time: ``values (b, 6)``, which of them are forces, and how far the
    shapes have grown, ``growth (b,)``."""

    values: Array
    forced: Mask
    growth: Array

    @classmethod
    def from_motions(cls, motions: Sequence[Motion], t: float) -> Drives:
        found = [motion.at(t) for motion in motions]
        values, forced = np.array([v for v, _, _ in found]), np.array([f for _, f, _ in found], dtype=bool)
        return cls(values.reshape(-1, 6), forced.reshape(-1, 6), np.array([g for _, _, g in found]))

    @classmethod
    def make_empty(cls) -> Drives:
        """Those of no body."""
        return cls.from_motions((), 0.0)


@dataclass(frozen=True)
class RigidBody:
    """A rigid body that touches the tissue.

    Parameters
    ----------
    shape : what it is and where it starts.
    faces : (f, k) outward boundary faces that it may touch.
    motion : what drives it.
    friction, sticking : as in `Problem`.
    hardness : stiffness that holds a point along the body until it slips by Coulomb's law, over that of the
        contact; where not given 0.05 for shapes that grow, 1 for others.  The softer, the wider is what
        sticking goes over into slipping in, the coefficient times the penetration over the hardness, and the
        quicker is the solution.
    pivot : (3,) mm, the point about which it turns; the shape's centre where not given.
    name : for messages and results.
    """

    shape: RigidShape
    faces: Indices
    motion: Motion
    friction: str | float = "frictionless"
    pivot: Sequence[float] | Array | None = None
    name: str = ""
    hardness: float | None = None
    sticking: str = "anchored"

    def __post_init__(self) -> None:
        if self.hardness is not None and not 0.0 < self.hardness <= 1.0:
            raise ProblemError(f"a hardness of {self.hardness} is not between 0 and 1")
        if self.pivot is not None:
            pivot = np.asarray(self.pivot, dtype=float)
            if pivot.shape != (3,) or not np.isfinite(pivot).all():
                raise ProblemError("the pivot of a rigid body is not three finite numbers")

    @property
    def holding(self) -> float:
        """The hardness, or its default for the shape."""
        if self.hardness is not None:
            return self.hardness
        return HARDNESS_GROWING if self.shape.grows else 1.0

    @property
    def origin(self) -> Array:
        """(3,) the pivot, mm."""
        return np.asarray(self.shape.centre if self.pivot is None else self.pivot, dtype=float)


def read_course(what: str, of: str, times: ArrayLike, values: ArrayLike) -> tuple[Array, Array]:
    """Times (n,) s and values (n,) that are piecewise linear between them. Raises `ProblemError` where there
    are not as many of both, two or more, some are not finite, or times do not grow from 0.

    They are copies: what a caller does to its arrays later must not change a problem.
    """
    t, v = np.array(times, dtype=float), np.array(values, dtype=float)
    if t.ndim != 1 or t.shape != v.shape or len(t) < 2:
        raise ProblemError(f"{what} needs two or more times and as many {of}")
    if not (np.isfinite(t).all() and np.isfinite(v).all()):
        raise ProblemError(f"{what} holds {of} or times that are not finite")
    if t[0] != 0.0 or not (np.diff(t) > 0).all():
        raise ProblemError(f"the times of {what} do not grow from 0: {', '.join(f'{x:g}' for x in t[:4])}")
    return t, v


def measure_moving_time(times: Array, values: Array, t: float) -> float:
    """For how long ``values (n, ...)``, linear between ``times (n,)`` s, have changed up to time ``t``, s."""
    moving = (np.diff(values, axis=0) != 0.0).reshape(len(times) - 1, -1).any(axis=1)
    return float((np.clip(t - times[:-1], 0.0, np.diff(times)) * moving).sum())


@dataclass(frozen=True)
class Activation:
    """The share of full activation over time, piecewise linear; the last one holds on.

    Raises `ProblemError` where times do not grow from 0, or a share is negative or not finite.

    Parameters
    ----------
    times : (n,) s, from 0.
    shares : (n,) of the active stress of every `ContractileMaterial` tissue; 0 at rest, not negative.
    """

    times: Sequence[float] | Array
    shares: Sequence[float] | Array

    def __post_init__(self) -> None:
        times, shares = read_course("an activation", "shares", self.times, self.shares)
        if not (shares >= 0.0).all():
            raise ProblemError("a share of an activation is negative or not finite")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "shares", shares)

    def at(self, t: float) -> float:
        """The share at time ``t``, s."""
        return float(np.interp(t, np.asarray(self.times), np.asarray(self.shares)))

    def delay(self, seconds: float) -> Activation:
        """The same after so many seconds at its first share."""
        times, shares = np.asarray(self.times), np.asarray(self.shares)
        return Activation(np.append(0.0, times + seconds), np.append(shares[0], shares))

    def moving_s(self, t: float) -> float:
        """For how long the share has changed up to time ``t``, s."""
        return measure_moving_time(np.asarray(self.times), np.asarray(self.shares), t)
