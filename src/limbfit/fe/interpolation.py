"""The force between steps: a spline over each phase, in the root of time where steps are dense at its start.

After a turn steps are dense, for the force relaxes there; a spline in time through steps so uneven swings.
Phases end in kinks, and so does contact: where it is lost, the spline of the steps before goes on to zero;
where it is found again, that of the steps after comes from there.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

Array = NDArray[np.float64]


def interpolate(times: Array, force: Array, kinks: Array, values: Array, at: Array) -> Array:
    """Values (k, ...) at times ``at (k,)`` of what is ``values (n, ...)`` at the steps, s.

    Zero where the ``force (n,)`` between the steps is not positive; for a given force linear in the values.
    ``kinks``: times where phases begin or end, s.
    """
    out = np.zeros((len(at), *values.shape[1:]))
    for first, last in _find_stretches(times, force, kinks):
        x, pushes = times[first : last + 1], force[first : last + 1]
        inside = np.flatnonzero((at >= x[0]) & (at <= x[-1]))
        if not len(inside):
            continue
        start = float(kinks[kinks <= x[0] + 1e-9 * times[-1]].max(initial=times[0]))
        power = _choose_power(times[times > start + 1e-9 * times[-1]] - start)
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


def _choose_power(since: Array) -> int:
    """The power of the spline's variable that the time since a kink is: 2 where steps grow fast after it.

    A whole number: the force is smooth in time, and so remains smooth in the variable.
    """
    return 2 if len(since) > 1 and since[1] > 3.0 * since[0] else 1


def _build_spline(x: Array, y: Array) -> BSpline:
    return make_interp_spline(x, y, k=min(3, len(x) - 1))
