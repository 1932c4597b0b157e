"""The displacement as a broken line: straight pieces between few corners."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from ..arrays import Array
from ..errors import TraceError
from ..phases import MotionPhase, choose_tolerance_mm, find_phases, find_way_in
from .numerics import average_in_bins, build_linear_interpolation, estimate_noise_level, find_resolution

_MAX_CORNERS = 41
# Of a step in which the displacement comes: half of one is rounded, and corners are off too.
_STEP_SHARE = 0.7


@dataclass(frozen=True)
class BrokenLine:
    """A continuous piecewise straight displacement: corner ``times`` s and ``values`` mm."""

    times: Array
    values: Array
    tolerance: float

    def __call__(self, at: Array) -> Array:
        return np.interp(at, self.times, self.values)

    @cached_property
    def phases(self) -> tuple[MotionPhase, ...]:
        """What the indenter does, from the first sample to the last."""
        return find_phases(
            self.times, self.values, tolerance=max(choose_tolerance_mm(self.values), self.tolerance)
        )

    @property
    def peak_s(self) -> float:
        """When the (first) way in ends."""
        last = find_way_in(self.phases)
        return float(self.times[-1]) if last is None else last.end_s

    @property
    def start_s(self) -> float:
        """When the indenter starts to move in."""
        return next((phase.start_s for phase in self.phases if phase.kind == "load"), float(self.times[0]))

    def compute_path_mm(self, at: Array) -> Array:
        """The way that the indenter has gone, in and out, since the first corner, at times (n,) s; mm."""
        return np.interp(at, self.times, np.r_[0.0, np.cumsum(np.abs(np.diff(self.values)))])

    def measure_path_mm(self, start_s: float, end_s: float) -> float:
        """The way that the indenter goes, in and out, between two times, mm."""
        return float(np.ptp(self.compute_path_mm(np.array([start_s, end_s]))))

    def find_return_s(self, displacement: float) -> float:
        """When the line comes back to a displacement for the last time (the end where it stays beyond)."""
        last = int(np.flatnonzero(self.values > displacement)[-1])
        after = min(last + 1, len(self.times) - 1)
        return float(np.interp(-displacement, -self.values[[last, after]], self.times[[last, after]]))


def fit_broken_line(
    time: Array,
    displacement: Array,
    peak_s: float | None = None,
    quantity: str = "displacement",
    unit: str = "mm",
) -> BrokenLine:
    """Fit as few straight pieces as describe the displacement to 0.3 % of the travel (or its noise, or the
    steps that it comes in).

    So is a force that is stated instead: ``quantity`` and ``unit`` are for messages.

    Corners are added where the misfit is largest and all of them moved to their least-squares place;
    with ``peak_s`` the end of the way in is put there.

    Raises `TraceError` if forty pieces do not describe it, it never advances, or the way in cannot end at
    ``peak_s``.
    """
    t, u, _ = average_in_bins(time, displacement, 5000)
    at, coarse, n = average_in_bins(t, u, 300)
    travel = float(np.ptp(coarse))
    noise = 4 * estimate_noise_level(u) / np.sqrt(float(n.mean()))
    tolerance = max(0.003 * travel, noise, _STEP_SHARE * find_resolution(displacement))
    knots = np.array([time[0], time[-1]])
    while True:
        knots, values = _place_knots(t, u, knots)
        miss = np.abs(coarse - np.interp(at, knots, values))
        # Averages over a corner are blunt: no misfit, and no place for another corner.
        miss[np.searchsorted(at, knots[1:-1]).clip(1, len(at) - 1)[:, None] - [0, 1]] = 0.0
        if miss.max() <= tolerance:
            break
        if len(knots) >= _MAX_CORNERS:
            worst = float(at[np.argmax(miss)])
            raise TraceError(
                f"the {quantity} wanders: {len(knots) - 1} straight pieces leave {miss.max():.2g} {unit} at "
                f"{worst:.2f} s",
                place=quantity,
                remedy="a record is made of ramps and holds, in any number of cycles up to ten: "
                "cut out the part that is",
            )
        knots = np.sort(np.append(knots, at[np.argmax(miss)]))
    line = BrokenLine(knots, values, tolerance)
    if find_way_in(line.phases) is None:
        raise TraceError(f"the {quantity} never advances", place=quantity, remedy="check the column")
    return line if peak_s is None else _fit_line_turning_at(peak_s, line, t, u)


def _fit_line_turning_at(peak_s: float, line: BrokenLine, t: Array, u: Array) -> BrokenLine:
    """The line whose way in ends at a stated time, its other corners where they were."""
    turn = int(np.flatnonzero(line.times == line.peak_s)[0])
    low = float(line.times[max(turn - 1, 0)])
    high = float(line.times[min(turn + 1, len(line.times) - 1)])
    knots = line.times.copy()
    knots[turn] = peak_s
    if low < peak_s < high:
        line_at_peak = BrokenLine(knots, _fit_values(t, u, knots)[0], line.tolerance)
        if line_at_peak.peak_s == peak_s:
            return line_at_peak
    remedy = f"the record turns at {line.peak_s:.3f} s; stay near it, between {low:.3f} and {high:.3f} s"
    raise TraceError(f"the way in cannot end at {peak_s:g} s", place="peak_s", remedy=remedy)


def _fit_values(t: Array, u: Array, knots: Array) -> tuple[Array, Array]:
    """Least-squares values of a continuous broken line with corners at ``knots``, and its hats."""
    hats = build_linear_interpolation(t, knots)
    return _project_on_hats(hats, u), hats


def _project_on_hats(hats: Array, u: Array) -> Array:
    """Coefficients (k, ...) of hats (n, k) that come nearest to ``u`` (n, ...).

    Hats overlap with their neighbours only, so the normal equations are well conditioned; the little on their
    diagonal is for corners so near to each other that no sample lies between them.
    """
    normal = hats.T @ hats
    normal[np.diag_indices_from(normal)] += 1e-12 * np.trace(normal)
    return np.asarray(np.linalg.solve(normal, hats.T @ u), dtype=np.float64)


def _place_knots(t: Array, u: Array, knots: Array) -> tuple[Array, Array]:
    """Least-squares corner times and values of a continuous broken line through (t, u)."""

    def join_ends(inner: Array) -> Array:
        return np.r_[knots[0], inner, knots[-1]]

    def misfit(inner: Array) -> Array:
        values, hats = _fit_values(t, u, join_ends(inner))
        return hats @ values - u

    def slopes(inner: Array) -> Array:
        """A corner that moves takes its hat along, at the speed on either side; the values follow (variable
        projection, Kaufman 1975)."""
        corners = join_ends(inner)
        values, hats = _fit_values(t, u, corners)
        piece = np.clip(np.searchsorted(corners, t) - 1, 0, len(corners) - 2)
        speed = (np.diff(values) / np.diff(corners))[piece]
        line_at_peak = -speed[:, None] * hats[:, 1:-1]
        return np.asarray(line_at_peak - hats @ _project_on_hats(hats, line_at_peak))

    inner = knots[1:-1]
    if inner.size:
        margin = 0.02 * np.diff(knots)
        middle = (knots[:-1] + knots[1:]) / 2
        lower = np.r_[knots[0] + margin[0], middle[1:-1] + margin[1:-1]]
        upper = np.r_[middle[1:-1] - margin[1:-1], knots[-1] - margin[-1]]
        found = least_squares(misfit, inner, jac=slopes, bounds=(lower, upper), x_scale=np.ptp(knots))
        inner = found.x
    return join_ends(inner), _fit_values(t, u, join_ends(inner))[0]
