"""How much of the stated active stress acts, over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Activation:
    """The share of full activation over time, piecewise linear; the last one holds on.

    Parameters
    ----------
    times : (n,) s, from 0.
    shares : (n,) of the active stress of every `Contractile` tissue; 0 at rest, not negative.

    Raises
    ------
    ProblemError
        Where times do not grow from 0, or a share is negative or not finite.
    """

    times: Sequence[float] | Array
    shares: Sequence[float] | Array

    def __post_init__(self) -> None:
        times, shares = np.asarray(self.times, dtype=float), np.asarray(self.shares, dtype=float)
        if times.ndim != 1 or times.shape != shares.shape or len(times) < 2:
            raise ProblemError("an activation needs two or more times and as many shares")
        if not np.isfinite(times).all() or times[0] != 0.0 or not (np.diff(times) > 0).all():
            raise ProblemError("the times of an activation do not grow from 0")
        if not (np.isfinite(shares).all() and (shares >= 0.0).all()):
            raise ProblemError("a share of an activation is negative or not finite")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "shares", shares)

    def at(self, t: float) -> float:
        """The share at time ``t``, s."""
        return float(np.interp(t, np.asarray(self.times), np.asarray(self.shares)))

    def later(self, seconds: float) -> Activation:
        """The same after so many seconds at its first share."""
        times, shares = np.asarray(self.times), np.asarray(self.shares)
        return Activation(np.append(0.0, times + seconds), np.append(shares[0], shares))

    def moving_s(self, t: float) -> float:
        """How long the share has changed up to time ``t``, s."""
        times, steps = np.asarray(self.times), np.diff(self.times)
        return float((np.clip(t - times[:-1], 0.0, steps) * (np.diff(self.shares) != 0.0)).sum())
