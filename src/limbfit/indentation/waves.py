"""How fast shear waves are at places of a limb that is being indented: ultrasound elastography.

A pulse moves tissue along the beam, and the wave that it sets off runs across it. It is a small, sudden
motion on top of the present strain (Ogden, Non-linear elastic deformations, 1984, 6.4): with motion ``a``
across the way ``n``

    rho v^2 = (1/J) [(1 + sum_l g_l) g : dSe/dE : g + N . (Se + sum_l g_l H_l) N],   A = F^T a,  N = F^T n,

and ``g`` the symmetric part of ``A N``. Relaxation has no time in it, and the pressure drops out, since the
motion is across the way. At rest it is the instantaneous modulus. Real tissue also has relaxation that is
quicker than an indentation shows: the model's speed knows no more of it than its shortest time.

Speeds follow from the displacements and their derivatives. Derivatives of speeds are differences of the
closed form above along both, within 1e-6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from ..fe import Material, Result
from ..fe.kernel.laws import EvaluationPoints, Laws, evaluate_elastic_at
from ..fe.memory import Memory
from ..mesh import Mesh, locate
from ..study import Vector

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


@dataclass(frozen=True)
class WavePlace:
    """Where a shear wave's speed is wanted: a material point of ``tissue``, its place at rest, LPS mm.

    ``motion`` and ``way``: unit vectors along which the tissue moves and the wave runs, across each other.
    """

    tissue: str
    point: Vector
    motion: Vector
    way: Vector


def to_vector3(values: Array) -> Vector:
    """Three numbers as a model or a study holds them."""
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class _Regions:
    """The points of several places: of number ``place`` (m,) each; ``A`` and ``N`` see `WavePlace`."""

    points: EvaluationPoints
    nodes: Indices
    place: Indices
    motion: Array
    way: Array

    @classmethod
    def of(cls, result: Result, places: Sequence[WavePlace]) -> _Regions:
        mesh, system = result.problem.mesh, result.system
        cells, local = zip(*(_locate_points(mesh, place) for place in places), strict=True)
        number = np.repeat(np.arange(len(places)), [len(own) for own in cells])
        points = EvaluationPoints.at(
            mesh,
            result.problem.formulation,
            np.concatenate(cells),
            np.concatenate(local),
            system.fibres,
            system.prestretch,
        )
        nodes, renumbered = np.unique(points.cells, return_inverse=True)
        points = replace(points, cells=renumbered.reshape(points.cells.shape).astype(np.int32))
        motion, way = (np.array([getattr(one, name) for one in places])[number] for name in ("motion", "way"))
        return cls(points, nodes.astype(np.int64), number, motion, way)

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
    radius, angle = DISC_RADIUS_MM * np.concatenate(rings), np.concatenate(angles)
    found = []
    for layer in range(_LAYERS):
        turned = angle + np.pi * layer / (6 * _LAYERS)
        height = DISC_HALF_MM * ((2 * layer + 1) / _LAYERS - 1)
        found.append(
            np.column_stack([radius * np.cos(turned), radius * np.sin(turned), np.full(len(radius), height)])
        )
    return np.concatenate([np.zeros((1, 3)), *found])


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
    regions = _Regions.of(result, places)
    times = np.array([0.0, *(state.time for state in states)])
    seconds, turned = np.diff(times, prepend=0.0), _find_turns(result, times)

    def after(materials: Mapping[str, Material], by: int = 0, step: float = 0.0) -> Array:
        """The speeds where parameter number ``by`` is larger by ``step``."""
        laws = Laws.build([materials[name] for name in problem.mesh.region_names])
        moved = [np.zeros((len(regions.nodes), 3))]
        for state in states:
            u = state.u[regions.nodes]
            if step:
                assert state.sensitivity is not None
                u = u + step * state.sensitivity[regions.nodes, :, by].astype(np.float64)
            moved.append(u)
        return regions.speeds(laws, moved, seconds, turned)

    speeds = after(problem.materials)
    if not states or states[0].sensitivity is None:
        return speeds, None
    slopes = []
    for p, ((region, name), value) in enumerate(
        zip(problem.parameter_names, problem.parameters, strict=True)
    ):
        step = _DERIVATIVE_STEP * (abs(value) or 1.0)
        own = problem.materials[region]
        less, more = (
            after({**problem.materials, region: own.with_parameters({name: value + change})}, p, change)
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
