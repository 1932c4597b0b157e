"""What is observed of a limb beside the force: layers that become thinner, skin that moves, waves.

Ultrasound through the indenter shows the interfaces between tissues on its axis, cameras show the skin around
it. Both are followed as material points (`mesh.gauges`, `find_skin_points`), whose displacements and exact
derivatives come from the steps.

Speeds of shear waves follow from the displacements and their derivatives. A pulse moves tissue along the
beam, and the wave that it sets off runs across it. It is a small, sudden motion on top of the present strain
(Ogden, Non-linear elastic deformations, 1984, 6.4): with motion ``a`` across the way ``n``

    rho v^2 = (1/J) [(1 + sum_l g_l) g : dSe/dE : g + N . (Se + sum_l g_l H_l) N],   A = F^T a,  N = F^T n,

and ``g`` the symmetric part of ``A N``. Relaxation has no time in it, and the pressure drops out, since the
motion is across the way. At rest it is the instantaneous modulus. Real tissue also has relaxation that is
quicker than an indentation shows: the model's speed knows no more of it than its shortest time. Derivatives
of speeds are differences of the closed form above along both, within 1e-6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from ..fe import Indenter, Material, Result
from ..fe.kernel.laws import EvaluationPoints, Laws, evaluate_elastic_at
from ..fe.memory import Memory
from ..fe.result import interpolate
from ..mesh import Gauge, Mesh, find_gauges_along, locate, read_vtu
from ..mesh.cells import linear_simplex, quadratic_simplex
from ..shapes.triangles import build_tree, closest_point
from ..study import Vector
from .sites import SiteModel, WavePlace, read_indenter, to_vector3

OFF_SKIN_MM = 5.0  # a point farther from the skin than this is not on it
RINGS_MM, DIRECTIONS = (3.0, 8.0, 15.0), 8
MAX_OFFSET_SHARE = 0.25  # of a ring's radius: where the skin ends its nearest point is elsewhere
DENSITY = 1000.0  # kg/m^3, as elastography takes it for all soft tissue
# A speed is the mean over a disc across the beam, around its place and in the tissue alone: about what
# elastography reads. Under a ball the means of seven points differ by up to 13 % between meshes with edges of
# 1.2 to 2.1 mm, those of this disc by 1 %.
DISC_RADIUS_MM, DISC_HALF_MM = 2.0, 1.0
_RINGS, _LAYERS = 2, 4
_ON_TISSUE_MM = 0.1  # a point of the disc may be moved by so much into the tissue
OFF_TISSUE_MM = 3.0  # farther from a tissue than that a place is not in it
_DERIVATIVE_STEP = 1e-4  # of a parameter
_MIN_MODULUS = 1e-12  # MPa: a tissue that carries no wave


def _build_layer_gauges(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    """The gauges of the model's ``layers``, in their order."""
    if not model.layers:
        return ()
    found = {
        one.region: one for one in find_gauges_along(mesh, np.array(model.position), np.array(model.axis))
    }
    for layer in model.layers:
        if layer not in found:
            known = ", ".join(found)
            raise ProblemError(
                f"site {model.site or model.name}: no {layer} lies under the indenter's axis, only {known}",
                remedy="take its column out of the record's ultrasound file",
            )
    return tuple(found[layer] for layer in model.layers)


def _build_skin_gauges(model: SiteModel, mesh: Mesh) -> tuple[Gauge, ...]:
    """The gauges of the model's ``skin_points``: of each point one along each of the ``skin_axes``."""
    if not model.skin_points:
        return ()
    found = find_skin_points(mesh, np.array(model.skin_points))
    worst = int(np.argmax(found.off_mm))
    if found.off_mm[worst] > OFF_SKIN_MM:
        place = ", ".join(f"{value:.1f}" for value in model.skin_points[worst])
        raise ProblemError(
            f"site {model.site or model.name}: the point ({place}) is {found.off_mm[worst]:.1f} mm off the "
            "simulated skin",
            remedy="take it out of the record's surface file, or raise calibration.search_radius_mm",
        )
    return found.gauges(np.array(model.skin_axes))


def choose_points_around(mesh: Mesh, indenter: Indenter) -> Array:
    """Points (k, 3) of the skin in rings around an indenter, as cameras beside it would follow them.

    `RINGS_MM` beyond its edge in `DIRECTIONS` directions, as far as there is skin.
    """
    turns = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    edge = indenter.width / 2.0 * (1.0 if indenter.body.is_round else np.sqrt(2.0))
    radii = edge + np.array(RINGS_MM)
    flat = np.stack([np.outer(radii, np.cos(turns)), np.outer(radii, np.sin(turns))], axis=-1).reshape(-1, 2)
    found = find_skin_points(mesh, np.asarray(indenter.centre) + flat @ indenter.frame[:2])
    local = (found.points - indenter.centre) @ indenter.frame.T
    there = np.linalg.norm(local[:, :2] - flat, axis=1) < MAX_OFFSET_SHARE * np.linalg.norm(flat, axis=1)
    return found.points[there]


def is_under(indenter: Indenter, points: Array) -> Mask:
    """Which points (k, 3) the indenter hides from cameras, as far as it goes along its axis."""
    local = (points - np.asarray(indenter.centre)) @ indenter.frame.T
    local[:, 2] = -0.5 * min(indenter.width, indenter.length)
    return np.asarray(indenter.local_distance(local)[0] <= 0.0)


def find_layers_under(model: SiteModel) -> tuple[str, ...]:
    """The tissues on the axis of a site's indenter, outermost first, as its stored mesh has them."""
    found = find_gauges_along(read_vtu(model.mesh), np.array(model.position), np.array(model.axis))
    return tuple(one.region for one in found)


def place_waves_under(
    model: SiteModel, mesh: Mesh, wanted: Sequence[tuple[str, float | None]] | None = None
) -> tuple[WavePlace, ...]:
    """Places of shear waves under the middle of a site's indenter.

    Tissue moves along the indenter's axis, and the waves run along its edge.

    ``wanted``: tissues, each so deep below the skin, mm, or in its own middle; by default the middle of every
    tissue. Raises `ProblemError` for a tissue that is not there, or not so deep.
    """
    way, _, axis = read_indenter(model.indenter, model.position, model.axis, model.edge).frame
    position, top, spans = np.array(model.position), 0.0, {}
    for gauge in find_gauges_along(mesh, position, axis):
        spans[gauge.region] = (top, top + gauge.thickness_mm)
        top += gauge.thickness_mm
    found = []
    for tissue, depth in [(name, None) for name in spans] if wanted is None else wanted:
        if tissue not in spans:
            raise ProblemError(
                f"no {tissue} lies under the indenter's axis, only {', '.join(spans)}",
                remedy="take its column out of the record's file of shear waves",
            )
        first, last = spans[tissue]
        if depth is not None and not first <= depth <= last:
            raise ProblemError(
                f"{tissue} lies {first:.1f} to {last:.1f} mm deep, and not at {depth:g} mm",
                remedy="name the column after the tissue that is there, or leave the depth out",
            )
        point = position + (0.5 * (first + last) if depth is None else depth) * axis
        found.append(WavePlace(tissue, *map(to_vector3, (point, axis, way))))
    return tuple(found)


def find_nearby_skin_points(model: SiteModel) -> tuple[Vector, ...]:
    """`choose_points_around` a site's indenter on its stored mesh."""
    indenter = read_indenter(model.indenter, model.position, model.axis, model.edge)
    return tuple(map(to_vector3, choose_points_around(read_vtu(model.mesh), indenter)))


def observe_result(result: Result, model: SiteModel, times_s: Array) -> tuple[Array, Array | None]:
    """What is observed at times (n,) s from touch-down, in the order of `Simulation.observed`: (g, n).

    Lengths, mm, count from touch-down. The second array holds the derivatives (g, n, p) with respect to the
    solver's parameters; None where the states have none. The result must hold all of its states
    (``store="all"``). Tissue that the indenter has left recovers gradually, so readings continue after the
    force has ended.
    """
    states, mesh = result.states, result.problem.mesh
    gauges = (*_build_layer_gauges(model, mesh), *_build_skin_gauges(model, mesh))
    if not states:
        return np.zeros((model.gauges, len(times_s))), None

    def read_gauges(fields: list[Array]) -> Array:
        """What the gauges read of nodal fields in all states, (g, s + 1, ...); nothing at rest before."""
        found = np.array([[gauge.read(field) for field in fields] for gauge in gauges])
        return np.concatenate([np.zeros_like(found[:, :1]), found], axis=1)

    at = np.clip(np.append(model.waits_s, times_s), result.times[0], result.times[-1])

    def interpolate_states(of_states: Array, is_length: bool) -> Array:
        """What is (g, s, ...) in the states at the wanted times, (g, n, ...); lengths since touch-down."""
        kinks, steps = result.problem.kinks, result.times[: of_states.shape[1]]
        column = np.moveaxis(of_states, 1, 0)
        found = np.moveaxis(interpolate(steps, np.ones(len(steps)), kinks, column, at), 0, 1)
        return np.asarray(found[:, 1:] - found[:, :1] if is_length else found[:, 1:])

    values, slopes = list[Array](), list[Array]()
    if gauges:
        values.append(interpolate_states(read_gauges([state.u for state in states]), True))
        if states[0].sensitivity is not None:
            fields = [np.asarray(state.sensitivity) for state in states]
            slopes.append(interpolate_states(read_gauges(fields), True))
    if model.waves:
        for rows, speeds in zip((values, slopes), compute_wave_speeds(result, model.waves), strict=True):
            rows += [] if speeds is None else [interpolate_states(speeds, False)]
    return np.concatenate(values), np.concatenate(slopes) if slopes else None


@dataclass(frozen=True)
class SkinPoints:
    """Points (k, 3) mm of the skin at rest, and what interpolates nodal values there.

    ``off_mm`` (k,) is how far each is from the point that was asked for. A nodal field is ``weights`` (k, j)
    times its values at ``nodes`` (k, j).
    """

    points: Array
    off_mm: Array
    nodes: Indices
    weights: Array

    def gauges(self, axes: Array) -> tuple[Gauge, ...]:
        """The moves along unit vectors (d, 3): d gauges of the first point, then those of the second."""
        rows = zip(self.nodes, self.weights, strict=True)
        return tuple(Gauge(nodes, weights, axis) for nodes, weights in rows for axis in axes)


def find_skin_points(mesh: Mesh, points: Array) -> SkinPoints:
    """The points of a mesh's face set ``skin`` nearest to ``points`` (k, 3), mm; see `find_nearest_points`.
    Raises `ProblemError` for a mesh without skin.
    """
    faces = mesh.face_sets.get("skin", np.empty((0, 3), dtype=np.int64))
    if not len(faces):
        raise ProblemError("the mesh has no face set 'skin'", remedy="mesh the site anew")
    return find_nearest_points(mesh.points, faces, points)


def find_nearest_points(nodes: Array, faces: Indices, points: Array) -> SkinPoints:
    """The points of a skin with ``nodes`` (n, 3) mm and ``faces`` (f, j) nearest to ``points`` (k, 3), mm.

    Faces count as the flat triangles of their corners, quadrilaterals as two; nodal values are interpolated
    by the face's own functions.
    """
    if faces.shape[1] == 4:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    corners = np.ascontiguousarray(nodes[faces[:, :3]])
    tree = build_tree(corners, np.arange(len(faces)))
    feet, near = np.empty((len(points), 3)), np.empty(len(points), dtype=np.int64)
    for k, point in enumerate(np.asarray(points, dtype=float)):
        near[k], _, _ = closest_point(corners, tree, point, feet[k])
    a, b, c = np.moveaxis(corners[near], 1, 0)
    sides = np.stack([b - a, c - a], axis=2)
    local = (np.linalg.pinv(sides) @ (feet - a)[:, :, None])[:, :, 0]
    shape = quadratic_simplex if faces.shape[1] == 6 else linear_simplex
    return SkinPoints(feet, np.linalg.norm(feet - points, axis=1), faces[near], shape(local)[0])


class _Regions:
    """The points of several places, each of number ``place`` (m,), with its motion and way (m, 3)."""

    def __init__(self, result: Result, places: Sequence[WavePlace]) -> None:
        mesh, system = result.problem.mesh, result.system
        cells, local = zip(*(_locate_points(mesh, place) for place in places), strict=True)
        self.place = np.repeat(np.arange(len(places)), [len(own) for own in cells])
        points = EvaluationPoints.from_cells(
            mesh,
            result.problem.formulation,
            np.concatenate(cells),
            np.concatenate(local),
            system.fibres,
            system.prestretch,
        )
        self.nodes, renumbered = np.unique(points.cells, return_inverse=True)
        self.points = replace(points, cells=renumbered.reshape(points.cells.shape).astype(np.int32))
        self.motion = np.array([place.motion for place in places])[self.place]
        self.way = np.array([place.way for place in places])[self.place]

    def speeds(self, laws: Laws, steps: Sequence[Array], seconds: Array, turned: Mask) -> Array:
        """Speeds (k, s) m/s after the ``steps``: displacements (n, 3) of the nodes, mm, since rest.

        ``seconds`` (s,) each step took; after those that are ``turned`` the next has no smooth past.
        """
        memory, gamma = Memory.rest(self.points, laws), laws.prony[..., 0]
        of, found = self.points.regions, []
        for u, dt, turn in zip(steps, seconds, turned, strict=True):
            stress, moduli, F = evaluate_elastic_at(self.points, laws, u)
            if dt > 0.0:
                memory = memory.advance(self.points, laws, stress[:, None], dt)
                memory = memory.drop_past() if turn else memory
            for l, prony in enumerate(memory.prony):
                stress = stress + gamma[of, l, None] * prony[:, 0]
            A, N = (np.einsum("mij,mi->mj", F, along) for along in (self.motion, self.way))
            g = _build_contraction(A, N)
            stiffness = (1.0 + gamma.sum(axis=1))[of] * np.einsum("mr,mrs,ms->m", g, moduli, g)
            tension = np.einsum("mr,mr->m", _build_contraction(N, N), stress)
            values = (stiffness + tension) / np.linalg.det(F)
            found.append(np.bincount(self.place, values) / np.bincount(self.place))
        return 1e3 * np.sqrt(np.maximum(np.array(found).T, _MIN_MODULUS) / DENSITY)


def _build_contraction(a: Array, b: Array) -> Array:
    """Six numbers (m, 6) whose product with those of a symmetric tensor T is ``a . T b``."""
    off = [a[:, i] * b[:, j] + a[:, j] * b[:, i] for i, j in ((0, 1), (1, 2), (2, 0))]
    return np.column_stack([a * b, *off])


@cache
def sample_disc() -> Array:
    """Points (m, 3) of the disc, mm, along two ways across and its axis: the middle, then equal volumes."""
    rings, angles = [np.zeros(1)], [np.zeros(1)]
    most = 3 * _RINGS * (_RINGS + 1) + 1
    for ring in range(1, _RINGS + 1):  # of 6, 12, ... points
        inner, outer = 3 * ring * (ring - 1) + 1, 3 * ring * (ring + 1) + 1
        rings.append(np.full(6 * ring, np.sqrt((inner + outer) / (2 * most))))
        angles.append(2 * np.pi * np.arange(6 * ring) / (6 * ring))
    layer = np.repeat(np.arange(_LAYERS), most)
    radius = DISC_RADIUS_MM * np.tile(np.concatenate(rings), _LAYERS)
    turned = np.tile(np.concatenate(angles), _LAYERS) + np.pi * layer / (6 * _LAYERS)
    height = DISC_HALF_MM * ((2 * layer + 1) / _LAYERS - 1)
    points = np.column_stack([radius * np.cos(turned), radius * np.sin(turned), height])
    return np.concatenate([np.zeros((1, 3)), points])


def _locate_points(mesh: Mesh, place: WavePlace) -> tuple[Indices, Array]:
    """Cells and local coordinates of the points of a place's region that are in its tissue."""
    region = mesh.region_names.index(place.tissue)
    motion, way = np.array(place.motion), np.array(place.way)
    points = np.array(place.point) + sample_disc() @ np.stack([way, np.cross(motion, way), motion])
    cells, local, off = locate(mesh, points, region)
    if off[0] > OFF_TISSUE_MM:
        where = ", ".join(f"{value:.1f}" for value in place.point)
        raise ProblemError(
            f"the place ({where}) is {off[0]:.1f} mm off the simulated {place.tissue}",
            remedy="take it out of the record's file of shear waves, or mesh the site finer",
        )
    kept = off < _ON_TISSUE_MM
    kept[0] |= not kept.any()
    return cells[kept], local[kept]


def compute_wave_speeds(result: Result, places: Sequence[WavePlace]) -> tuple[Array, Array | None]:
    """Speeds of shear waves at places (k,) at rest and in every state of a simulation, m/s: (k, s + 1).

    And their derivatives (k, s + 1, p) with respect to the solver's parameters, where the states have some.
    The result must hold all of its states (``store="all"``).
    """
    problem, states = result.problem, result.states
    regions = _Regions(result, places)
    times = np.array([0.0, *(state.time for state in states)])
    seconds, turned = np.diff(times, prepend=0.0), _find_turns(result, times)

    def find_speeds(materials: Mapping[str, Material], by: int = 0, step: float = 0.0) -> Array:
        """The speeds where parameter number ``by`` is larger by ``step``."""
        laws = problem.with_materials(materials).build_laws()
        moved = [np.zeros((len(regions.nodes), 3))]
        for state in states:
            u = state.u[regions.nodes]
            if step:
                assert state.sensitivity is not None
                u = u + step * state.sensitivity[regions.nodes, :, by].astype(np.float64)
            moved.append(u)
        return regions.speeds(laws, moved, seconds, turned)

    speeds = find_speeds(problem.materials)
    if not states or states[0].sensitivity is None:
        return speeds, None
    slopes = []
    for p, ((region, name), value) in enumerate(
        zip(problem.parameter_names, problem.parameters, strict=True)
    ):
        step = _DERIVATIVE_STEP * (abs(value) or 1.0)
        own = problem.materials[region]
        less, more = (
            find_speeds({**problem.materials, region: own.with_parameters({name: value + change})}, p, change)
            for change in (-step, step)
        )
        slopes.append((more - less) / (2.0 * step))
    return speeds, np.stack(slopes, axis=-1)


def _find_turns(result: Result, times: Array) -> Mask:
    """At which times (s,) of its states the solver let the stress go on otherwise than before (`Memory`)."""
    at_kinks = np.isclose(times[:, None], result.problem.kinks, rtol=1e-9, atol=0.0).any(axis=1)
    pushing = result.force[: len(times)] > 0.0
    met = np.diff(pushing.astype(int), prepend=0) != 0
    touched = np.r_[0.0, times[:-1]] > result.problem.touch_down_s * (1.0 + 1e-9)
    return np.asarray(at_kinks | (met & touched))
