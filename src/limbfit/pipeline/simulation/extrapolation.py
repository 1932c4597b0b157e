"""What forces tend to as meshes and steps in time get finer, and the orders that are taken for it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

# Of the force of an indenter on a limb, against the edge (docs/convergence.md); None: it does not change in
# one direction there, so a difference tells how large the error may be and nothing can be extrapolated.
MESH_ORDERS: Mapping[str, float | None] = {"tet4": 1.3, "tet10": 1.0, "tet10p0": None}
MEASURED_ORDERS = (0.3, 6.0)  # in which an order that three meshes show is believed
_MAX_ERROR_FACTOR = 5.0  # times a difference: two edges that are nearly the same tell no limit


def estimate_coarse_error(order: float | None, ratio: float) -> float:
    """Error of the coarser of two over their difference (Richardson), where edges or steps have this ratio.

    ``limit - coarser`` is this times ``finer - coarser``; where there is no order, the difference itself.
    """
    return 1.0 if order is None else min(1.0 / (1.0 - ratio**-order), _MAX_ERROR_FACTOR)


def estimate_fine_error(order: float | None, ratio: float) -> float:
    """The same of the finer of the two."""
    return 1.0 if order is None else min(1.0 / max(ratio**order - 1.0, 1e-9), _MAX_ERROR_FACTOR)


@dataclass(frozen=True)
class Extrapolation:
    """What a quantity tends to as meshes get finer, and the order at which it does.

    ``measured``: the order follows from three meshes; otherwise it is assumed and the limit rests on the two
    finest ones. ``order`` is None where nothing is extrapolated: the limit is then the finest mesh's value.
    """

    limit: float
    order: float | None
    measured: bool

    def error_percent(self, value: float) -> float:
        """How far a value is from the limit, in percent of it."""
        return 100.0 * (value / self.limit - 1.0)


def extrapolate_richardson(
    edges: Sequence[float], values: Sequence[float], assumed: float | None
) -> Extrapolation:
    """``value = limit + a edge^order`` through the three finest meshes (Richardson; Roache 1998).

    Where the values do not change in one direction, or at no order of `MEASURED_ORDERS`, it is ``assumed``.

    Parameters
    ----------
    edges : (k,) edge lengths of two or more meshes, in any order.
    values : (k,) what was computed on them.
    assumed : the element's own of `MESH_ORDERS`; with None nothing is extrapolated.
    """
    if len(edges) < 2:
        raise ValueError("two meshes or more are needed")
    order = np.argsort(edges)
    h, f = np.asarray(edges, dtype=float)[order][:3], np.asarray(values, dtype=float)[order][:3]
    if assumed is None:
        return Extrapolation(float(f[0]), None, False)

    def mismatch(p: float) -> float:
        return float((f[2] - f[1]) * (h[1] ** p - h[0] ** p) - (f[1] - f[0]) * (h[2] ** p - h[1] ** p))

    low, high = MEASURED_ORDERS
    measured = len(h) == 3 and (f[2] - f[1]) * (f[1] - f[0]) > 0.0 and mismatch(low) * mismatch(high) < 0.0
    p = float(brentq(mismatch, low, high)) if measured else assumed
    share = h[0] ** p / (h[1] ** p - h[0] ** p)
    return Extrapolation(float(f[0] - share * (f[1] - f[0])), p, bool(measured))
