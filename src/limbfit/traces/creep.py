"""A record under a stated force: smooth curves counted from touch-down, the force as broken line.

The roles of `regularise` are exchanged: what is stated, the force, is piecewise straight, and what answers,
the displacement, is a smoothing spline for each phase of the force.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..phases import MotionPhase, find_boundaries, find_phases, spread
from .displacement import fit_broken_line
from .numerics import Array, compute_rms
from .record import Trace
from .regularise import Regularised, SmoothCurve, find_holds, select_sampled_corners
from .touchdown import TouchDown

END_SHARE = 0.05  # of the largest force: an indenter that hardly pushes may be anywhere


@dataclass(frozen=True)
class Creep(Regularised):
    """Curves from touch-down under a stated force; they end where it falls below 5 % of its largest.

    ``knots_s`` and ``knots_N`` are the corners of the force, ``knots_mm`` the displacement there; ``phases``
    are those of the force, with the displacements at their ends. ``curve`` is the displacement.
    """

    knots_N: Array

    @property
    def depth_mm(self) -> float:
        return float(self.displacement_mm.max())

    def resample(self, points: int) -> Creep:
        """The same curves at about ``points`` times (`spread`), every corner among them."""
        time = spread(self.phases, points, self.knots_s)
        return replace(
            self,
            time_s=time,
            displacement_mm=self.curve(time),
            force_N=np.interp(time, self.knots_s, self.knots_N),
        )


def regularise_creep(
    trace: Trace, touch_down: TouchDown, smoothing: float | None = None, peak_s: float | None = None
) -> Creep:
    """A record under a stated force as curves counted from touch-down.

    Parameters
    ----------
    smoothing : penalty on the squared second derivative of the displacement, s^3; by default generalised
        cross-validation chooses it for each phase.
    peak_s : when the force has first risen, as someone states it; found where it is not given.

    Raises
    ------
    TraceError
        Where the force never rises or is no ramps and holds, or no smoothing can be chosen.
    """
    since = trace.time_s - touch_down.time_s
    force = trace.force_N - touch_down.baseline_N
    line = fit_broken_line(trace.time_s, force, peak_s, quantity="force", unit="N")
    end = line.time_at(END_SHARE * float(line.values.max()), back=True) - touch_down.time_s
    corners = line.times - touch_down.time_s
    knots = np.r_[0.0, corners[(corners > 0.0) & (corners < end)], end]
    knots_N = np.maximum(line(knots + touch_down.time_s), 0.0)
    knots_N[0] = 0.0
    of_force = find_phases(knots, knots_N)
    moved = trace.displacement_mm - touch_down.displacement_mm
    parts = select_sampled_corners(find_boundaries(of_force), since)
    curve = SmoothCurve(since, moved, parts, smoothing, find_holds(parts, of_force))
    inside = (since >= 0.0) & (since <= end)
    phases = tuple(_with_displacements(phase, curve) for phase in of_force)
    time = spread(phases, 1000, knots)
    return Creep(
        time_s=time,
        displacement_mm=curve(time),
        force_N=np.interp(time, knots, knots_N),
        knots_s=knots,
        knots_mm=curve(knots),
        phases=phases,
        noise_N=compute_rms(force[inside] - np.interp(since[inside], knots, knots_N)),
        noise_mm=compute_rms(moved[inside] - curve(since[inside])),
        curve=curve,
        knots_N=knots_N,
    )


def _with_displacements(phase: MotionPhase, curve: SmoothCurve) -> MotionPhase:
    """A phase of the force with the displacements at its ends."""
    start, end = curve(np.array([phase.start_s, phase.end_s]))
    return replace(phase, start_mm=float(start), end_mm=float(end))
