"""The displacement as a broken line: straight pieces between few corners."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ..errors import TraceError
from .numerics import Array, bins, noise_level

_MAX_KNOTS = 12


@dataclass(frozen=True)
class BrokenLine:
    """A continuous piecewise straight displacement: corner ``times`` s and ``values`` mm."""

    times: Array
    values: Array
    tolerance: float

    def __call__(self, at: Array) -> Array:
        return np.interp(at, self.times, self.values)

    @property
    def _top(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.values >= self.values.max() - self.tolerance)

    @property
    def peak_s(self) -> float:
        """When the way in ends."""
        return float(self.times[self._top[0]])

    @property
    def unload_s(self) -> float:
        """When the way out begins, or the record ends."""
        return float(self.times[self._top[-1]])

    @property
    def unloads(self) -> bool:
        return bool(self._top[-1] < len(self.times) - 1)

    @property
    def start_s(self) -> float:
        """When the indenter starts to move."""
        return float(self.times[max(int(np.argmax(self.values > self.values[0] + self.tolerance)) - 1, 0)])

    def time_at(self, displacement: float, back: bool = False) -> float:
        """When the line passes a displacement on the way in, or ``back`` out (the end where it never
        does)."""
        way = self.times >= self.unload_s if back else self.times <= self.peak_s
        t, u = self.times[way], self.values[way]
        if back:
            first = int(np.argmax(u <= displacement)) if (u <= displacement).any() else len(u)
            t, u = t[: first + 1][::-1], u[: first + 1][::-1]
        else:
            last = int(np.flatnonzero(u <= displacement)[-1]) if (u <= displacement).any() else 0
            t, u = t[last:], u[last:]
        return float(np.interp(displacement, np.maximum.accumulate(u), t))


def broken_line(time: Array, displacement: Array, peak_s: float | None = None) -> BrokenLine:
    """Fit as few straight pieces as describe the displacement to 0.3 % of the travel (or its noise).

    Corners are added where the misfit is largest and all of them moved to their least-squares place;
    with ``peak_s`` the end of the way in is put there.

    Raises
    ------
    TraceError
        Where the way in cannot end at ``peak_s``.
    """
    t, u, _ = bins(time, displacement, 5000)
    at, coarse, n = bins(t, u, 300)
    travel = float(np.ptp(coarse))
    tolerance = max(0.003 * travel, 4 * noise_level(u) / np.sqrt(float(n.mean())))
    knots = np.array([time[0], time[-1]])
    while True:
        knots, values = _place_knots(t, u, knots)
        miss = np.abs(coarse - np.interp(at, knots, values))
        # Averages over a corner are blunt: no misfit, and no place for another corner.
        miss[np.searchsorted(at, knots[1:-1]).clip(1, len(at) - 1)[:, None] - [0, 1]] = 0.0
        if miss.max() <= tolerance or len(knots) >= _MAX_KNOTS:
            line = BrokenLine(knots, values, tolerance)
            return line if peak_s is None else _turning_at(peak_s, line, t, u)
        knots = np.sort(np.append(knots, at[np.argmax(miss)]))


def _turning_at(peak_s: float, line: BrokenLine, t: Array, u: Array) -> BrokenLine:
    """The line whose way in ends at a stated time, its other corners where they were."""
    turn = int(np.flatnonzero(line.times == line.peak_s)[0])
    low = float(line.times[max(turn - 1, 0)])
    high = float(line.times[min(turn + 1, len(line.times) - 1)])
    knots = line.times.copy()
    knots[turn] = peak_s
    if low < peak_s < high:
        moved = BrokenLine(knots, _values(t, u, knots)[0], line.tolerance)
        if moved.peak_s == peak_s:
            return moved
    raise TraceError(
        f"the way in cannot end at {peak_s:g} s",
        place="peak_s",
        remedy=f"the record turns at {line.peak_s:.3f} s; stay near it, between {low:.3f} and {high:.3f} s",
    )


def _values(t: Array, u: Array, knots: Array) -> tuple[Array, Array]:
    """Least-squares values of a continuous broken line with corners at ``knots``, and its misfit."""
    hats = np.stack([np.interp(t, knots, row) for row in np.eye(len(knots))], axis=1)
    fit = np.asarray(np.linalg.lstsq(hats, u, rcond=None)[0], dtype=np.float64)
    return fit, hats @ fit - u


def _place_knots(t: Array, u: Array, knots: Array) -> tuple[Array, Array]:
    """Least-squares corner times and values of a continuous broken line through (t, u)."""

    def values(inner: Array) -> tuple[Array, Array]:
        return _values(t, u, np.r_[knots[0], inner, knots[-1]])

    inner = knots[1:-1]
    if inner.size:
        margin = 0.02 * np.diff(knots)
        middle = (knots[:-1] + knots[1:]) / 2
        lower = np.r_[knots[0] + margin[0], middle[1:-1] + margin[1:-1]]
        upper = np.r_[middle[1:-1] - margin[1:-1], knots[-1] - margin[-1]]
        inner = least_squares(lambda x: values(x)[1], inner, bounds=(lower, upper), x_scale=np.ptp(knots)).x
    return np.r_[knots[0], inner, knots[-1]], values(inner)[0]
