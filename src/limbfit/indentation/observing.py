"""What is seen of a limb beside the force: layers that become thinner, points of the skin that move.

Ultrasound through the indenter sees the interfaces between tissues on its axis, cameras see the skin around
it. Both are followed as material points (`mesh.gauges`, `skin_points`). Their displacement is that of
the steps, and so are its derivatives, exact as those of the force are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError
from ..fe import Indenter, Result
from ..fe.interpolation import interpolate
from ..mesh import Gauge, Mesh, gauges_along, read_vtu
from ..study import Vector
from .sites import SiteModel, read_indenter
from .skin_points import skin_points

Array = NDArray[np.float64]
OFF_SKIN_MM = 5.0  # farther from the skin than that is no point of it
RINGS_MM, DIRECTIONS = (3.0, 8.0, 15.0), 8
MOST_ASIDE = 0.25  # of a ring's radius: where the skin ends its nearest point is elsewhere


def gauges_of(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    """The gauges of the model's ``layers``, in their order, then those of its ``skin_points``.

    A point has one along each of the ``skin_axes``.

    Raises
    ------
    ProblemError
        For a layer that is not there, and a point that is not on the skin.
    """
    return (*_of_layers(model, mesh), *_of_skin(model, mesh))


def _of_layers(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    if not model.layers:
        return ()
    found = {one.region: one for one in gauges_along(mesh, np.array(model.position), np.array(model.axis))}
    for layer in model.layers:
        if layer not in found:
            known = ", ".join(found)
            raise ProblemError(
                f"site {model.site or model.name}: no {layer} lies under the indenter's axis, only {known}",
                remedy="take its column out of the record's ultrasound file",
            )
    return tuple(found[layer] for layer in model.layers)


def _of_skin(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    if not model.skin_points:
        return ()
    found = skin_points(mesh, np.array(model.skin_points))
    worst = int(np.argmax(found.off_mm))
    if found.off_mm[worst] > OFF_SKIN_MM:
        place = ", ".join(f"{value:.1f}" for value in model.skin_points[worst])
        raise ProblemError(
            f"site {model.site or model.name}: the point ({place}) is {found.off_mm[worst]:.1f} mm off the "
            "simulated skin",
            remedy="take it out of the record's surface file, or raise calibration.search_radius_mm",
        )
    return found.gauges(np.array(model.skin_axes))


def points_around(mesh: Mesh, indenter: Indenter) -> Array:
    """Points (k, 3) of the skin in rings around an indenter, as cameras beside it would follow them.

    `RINGS_MM` beyond its edge in `DIRECTIONS` directions, as far as there is skin.
    """
    turns = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    edge = indenter.width / 2.0 * (1.0 if indenter.body.is_round else np.sqrt(2.0))
    radii = edge + np.array(RINGS_MM)
    flat = np.stack([np.outer(radii, np.cos(turns)), np.outer(radii, np.sin(turns))], axis=-1).reshape(-1, 2)
    found = skin_points(mesh, np.asarray(indenter.centre) + flat @ indenter.frame[:2])
    local = (found.points - indenter.centre) @ indenter.frame.T
    there = np.linalg.norm(local[:, :2] - flat, axis=1) < MOST_ASIDE * np.linalg.norm(flat, axis=1)
    return found.points[there]


def is_under(indenter: Indenter, points: Array) -> NDArray[np.bool_]:
    """Which points (k, 3) the indenter hides from cameras, as far as it goes along its axis."""
    local = (points - np.asarray(indenter.centre)) @ indenter.frame.T
    local[:, 2] = -0.5 * min(indenter.width, indenter.length)
    return np.asarray(indenter.local_distance(local)[0] <= 0.0)


def layers_under(model: SiteModel) -> tuple[str, ...]:
    """The tissues on the axis of a site's indenter, outermost first, as its stored mesh has them."""
    found = gauges_along(read_vtu(model.mesh), np.array(model.position), np.array(model.axis))
    return tuple(one.region for one in found)


def skin_beside(model: SiteModel) -> tuple[Vector, ...]:
    """`points_around` a site's indenter on its stored mesh."""
    indenter = read_indenter(model.indenter, model.position, model.axis, model.edge)
    return tuple((float(x), float(y), float(z)) for x, y, z in points_around(read_vtu(model.mesh), indenter))


def observed(result: Result, model: SiteModel, times_s: Array) -> tuple[Array, Array | None]:
    """What the model's gauges read at times (n,) s from touch-down, mm, counted from there: (g, n).

    And its derivatives (g, n, p) with respect to the solver's parameters, where the states have some. The
    result must hold all of its states (``store="all"``). Tissue that the indenter has left comes back by and
    by, so readings go on where the force has ended.
    """
    states = result.states
    gauges = gauges_of(model, result.problem.mesh)
    steps = slice(len(states) + 1)
    at = np.clip(np.append(model.waits_s, times_s), result.times[0], result.times[-1])

    def between(values: list[Array]) -> Array:
        """Values (g, ...) of the states at the wanted times less those at touch-down, (g, n, ...)."""
        column = np.array([np.zeros_like(values[0]), *values])
        kinks = result.problem.history.kinks
        everywhere = np.ones(len(column))
        found = np.moveaxis(interpolate(result.times[steps], everywhere, kinks, column, at), 0, 1)
        return found[:, 1:] - found[:, :1]

    def read(field: Array) -> Array:
        """What all gauges say of a nodal field (nodes, 3, ...)."""
        return np.array([gauge.read(field) for gauge in gauges])

    if not states:
        return np.zeros((len(gauges), len(times_s))), None
    moved = between([read(state.u) for state in states])
    if states[0].sensitivity is None:
        return moved, None
    return moved, between([read(np.asarray(state.sensitivity)) for state in states])
