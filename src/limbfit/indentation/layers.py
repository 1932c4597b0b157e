"""How much thinner the layers under the indenter become, as ultrasound through it would see them.

On the axis of the indenter the interfaces between tissues are followed as material points (`mesh.gauges`).
Their displacement is that of the steps, and so are its derivatives, exact as those of the force are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Result
from ..fe.interpolation import interpolate
from ..mesh import Gauge, Mesh, gauges_along, read_vtu
from .sites import SiteModel

Array = NDArray[np.float64]


def layer_gauges(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    """The gauges of the model's ``layers``, in their order, on the indenter's axis.

    Raises
    ------
    ProblemError
        For a layer that is not there.
    """
    found = {one.region: one for one in gauges_along(mesh, np.array(model.position), np.array(model.axis))}
    for layer in model.layers:
        if layer not in found:
            known = ", ".join(found)
            raise ProblemError(
                f"site {model.site or model.name}: no {layer} lies under the indenter's axis, only {known}",
                remedy="take its column out of the record's ultrasound file",
            )
    return tuple(found[layer] for layer in model.layers)


def layers_under(model: SiteModel) -> tuple[str, ...]:
    """The tissues on the axis of a site's indenter, outermost first, as its stored mesh has them."""
    found = gauges_along(read_vtu(model.mesh), np.array(model.position), np.array(model.axis))
    return tuple(one.region for one in found)


def compressions(result: Result, model: SiteModel, times_s: Array) -> tuple[Array, Array | None]:
    """What each of the model's layers has lost of its thickness since touch-down at times (n,), mm: (t, n).

    And its derivatives (t, n, p) with respect to the solver's parameters, where the states have some. The
    result must hold all of its states (``store="all"``). Tissue that the indenter has left comes back by and
    by, so compressions go on where the force has ended.
    """
    axis, states = np.array(model.axis), result.states
    gauges = layer_gauges(model, result.problem.mesh)
    steps = slice(len(states) + 1)
    at = np.clip(np.append(model.waits_s, times_s), result.times[0], result.times[-1])

    def between(values: list[Array]) -> Array:
        """Values (t, ...) of the states at the wanted times less those at touch-down, (t, n, ...)."""
        column = np.array([np.zeros_like(values[0]), *values])
        kinks = result.problem.history.kinks
        everywhere = np.ones(len(column))
        found = np.moveaxis(interpolate(result.times[steps], everywhere, kinks, column, at), 0, 1)
        return found[:, 1:] - found[:, :1]

    def read(field: Array) -> Array:
        """What all gauges say of a nodal field (nodes, 3, ...)."""
        return np.array([g.weights @ np.tensordot(axis, field[g.nodes], (0, 1)) for g in gauges])

    if not states:
        return np.zeros((len(gauges), len(times_s))), None
    lost = between([read(state.u) for state in states])
    if states[0].sensitivity is None:
        return lost, None
    return lost, between([read(np.asarray(state.sensitivity)) for state in states])
