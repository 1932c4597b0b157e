"""Skin markers from two surfaces of the same limb, with and without them (paper, section 2.1.1, figure 1).

The limb may have moved a little between the two scans, so the surface with markers is first laid onto the
other: point-to-plane iterative closest points with Tukey weights, which the markers themselves do not pull.
What then stands out by more than a threshold is clustered; each cluster that is high and small enough is a
marker. The flat proximal cap is no skin and takes part in neither step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from ..errors import SiteError
from .triangles import Surface, half_edges

Array = NDArray[np.float64]

ICP_POINTS, ICP_ROUNDS = 4000, 40
CAP_MARGIN_MM = 6.0
NORMAL_RADIUS_MM = 8.0


@dataclass(frozen=True)
class Marker:
    """A bump on the skin: ``position`` and unit outward ``direction`` (LPS mm) on the skin without markers.

    ``height`` is its greatest height in mm, ``area`` the surface of its upper half in mm2.
    """

    position: Array
    height: float
    area: float
    direction: Array


def find_markers(
    skin_with: Surface,
    skin_without: Surface,
    *,
    min_height_mm: float = 2.0,
    max_area_mm2: float = 500.0,
    register: bool = True,
) -> tuple[Marker, ...]:
    """Markers on a limb, from the distance between its surfaces with and without them.

    Parameters
    ----------
    skin_with, skin_without : closed outward surfaces of the two scans, in the same coordinates up to a small
        motion of the limb (some millimetres, some degrees).
    min_height_mm : the least height of a marker; half of it is where bumps are told apart.
    max_area_mm2 : what is larger is no marker (a cushion, a fold, a bandage).
    register : lay the first surface onto the second before comparing.

    Returns
    -------
    tuple[Marker, ...]
        Highest first; empty where nothing stands out.
    """
    base = _Skin(skin_without)
    points = skin_with.points
    if register:
        points = _registered(points, _off_cap_vertices(skin_with), base)
    height = base.height(points)
    height[base.near_cap(points)] = 0.0
    labels = _clusters(height > min_height_mm / 2, skin_with.faces)
    areas = _vertex_areas(skin_with)
    found = []
    for label in range(labels.max(initial=-1) + 1):
        members = np.flatnonzero(labels == label)
        tallest = float(height[members].max())
        members = members[height[members] > tallest / 2]  # terraces of the skin may touch a marker's foot
        area = float(areas[members].sum())
        if tallest >= min_height_mm and area <= max_area_mm2:
            position, direction = base.foot(points[members], areas[members] * height[members])
            found.append(Marker(position, tallest, area, direction))
    return tuple(sorted(found, key=lambda marker: -marker.height))


def match_markers(
    markers: Sequence[Marker], hints: Mapping[str, Array], *, max_distance_mm: float = 15.0
) -> dict[str, Marker]:
    """Give each named place its marker, one to one, with the least total distance.

    Markers that no place asks for are left over: a limb may carry more markers than the study has sites.

    Parameters
    ----------
    hints : rough position (3,) in LPS mm by site name.
    max_distance_mm : how far a marker may lie from its hint.

    Raises
    ------
    SiteError
        When a place has no marker within reach, or more than one; it names them all.
    """
    if not hints:
        return {}
    names = list(hints)
    distance = _distances(markers, np.array([np.asarray(hints[name], float) for name in names]))
    # A pair beyond reach costs more than any choice of pairs within it, so reach goes before nearness.
    cost = np.where(distance <= max_distance_mm, distance, 1e3 * (1 + max_distance_mm) * len(names))
    rows, columns = linear_sum_assignment(cost)
    pairs = {r: c for r, c in zip(rows, columns, strict=True) if distance[r, c] <= max_distance_mm}
    _check_missing(names, pairs, distance, max_distance_mm)
    _check_doubled(names, pairs, distance, max_distance_mm)
    return {names[r]: markers[c] for r, c in pairs.items()}


def _distances(markers: Sequence[Marker], hints: Array) -> Array:
    if not markers:
        return np.empty((len(hints), 0))
    positions = np.array([marker.position for marker in markers])
    return np.linalg.norm(hints[:, None] - positions, axis=-1)


def _check_missing(names: list[str], pairs: Mapping[int, int], distance: Array, reach: float) -> None:
    missing = [r for r in range(len(names)) if r not in pairs]
    if not missing:
        return
    told = [
        f"{names[r]} (nearest at {distance[r].min():.1f} mm)" if distance.shape[1] else names[r]
        for r in missing
    ]
    raise SiteError(
        f"no marker of its own within {reach:g} mm for {', '.join(told)}",
        place="sites",
        remedy="correct 'near', or give the site's 'position' on the skin",
    )


def _check_doubled(names: list[str], pairs: Mapping[int, int], distance: Array, reach: float) -> None:
    spare = np.setdiff1d(np.arange(distance.shape[1]), list(pairs.values()))
    doubled = [names[r] for r in pairs if (distance[r, spare] <= reach).any()]
    if doubled:
        raise SiteError(
            f"more than one marker within {reach:g} mm of {', '.join(doubled)}",
            place="sites",
            remedy="move 'near' closer to the right one, or give the site's 'position' on the skin",
        )


class _Skin:
    """The skin without markers, asked for heights, closest points and normals; its cap set apart."""

    def __init__(self, surface: Surface) -> None:
        self.points, self.faces = np.ascontiguousarray(surface.points), np.ascontiguousarray(surface.faces)
        self.normals, self.areas = surface.face_normals, surface.face_areas
        self.centres = surface.triangles.mean(axis=1)
        self.cap = _cap_faces(surface)
        self.open_faces = np.ascontiguousarray(self.faces[~self.cap])
        self.open_normals = self.normals[~self.cap]

    def height(self, points: Array) -> Array:
        """Signed distance (n,), positive outside."""
        sign = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
        return igl.signed_distance(np.ascontiguousarray(points), self.points, self.faces, sign)[0]

    def closest(self, points: Array) -> tuple[Array, Array]:
        """Closest points (n, 3) of the skin proper and the normals (n, 3) there."""
        points = np.ascontiguousarray(points)
        _, face, closest = igl.point_mesh_squared_distance(points, self.points, self.open_faces)
        return closest, self.open_normals[face]

    def near_cap(self, points: Array) -> NDArray[np.bool_]:
        """Which points (n,) lie beyond the cap's plane or just under it."""
        if not self.cap.any():
            return np.zeros(len(points), bool)
        normal = np.average(self.normals[self.cap], axis=0, weights=self.areas[self.cap])
        normal /= np.linalg.norm(normal)
        level = np.average(self.centres[self.cap] @ normal, weights=self.areas[self.cap])
        return points @ normal > level - CAP_MARGIN_MM

    def foot(self, points: Array, weights: Array) -> tuple[Array, Array]:
        """Where the weighted centroid of points (n, 3) stands on the skin, and the mean normal around it."""
        (foot,), _ = self.closest(np.average(points, axis=0, weights=weights)[None])
        near = ~self.cap & (np.linalg.norm(self.centres - foot, axis=1) < NORMAL_RADIUS_MM)
        if not near.any():
            near = np.arange(len(self.faces)) == np.linalg.norm(self.centres - foot, axis=1).argmin()
        normal = (self.normals[near] * self.areas[near, None]).sum(axis=0)
        return foot, normal / np.linalg.norm(normal)


def _cap_faces(surface: Surface) -> NDArray[np.bool_]:
    """Faces of the one plane that holds more than 3 % of a surface: the cut; skin has no such plane."""
    normals, areas, centres = surface.face_normals, surface.face_areas, surface.triangles.mean(axis=1)
    levels = (normals * centres).sum(axis=1)
    keys = np.rint(np.column_stack([50 * normals, levels])).astype(np.int64)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.ravel()
    share = np.bincount(group, weights=areas) / areas.sum()
    if share.max() < 0.03:
        return np.zeros(len(normals), bool)
    members = group == share.argmax()
    normal = np.average(normals[members], axis=0, weights=areas[members])
    normal /= np.linalg.norm(normal)
    level = np.average(centres[members] @ normal, weights=areas[members])
    return (normals @ normal > 0.98) & (np.abs(centres @ normal - level) < 1.0)


def _off_cap_vertices(surface: Surface) -> NDArray[np.int64]:
    cap = _cap_faces(surface)
    return np.setdiff1d(surface.faces[~cap], surface.faces[cap])


def _registered(points: Array, usable: NDArray[np.int64], base: _Skin) -> Array:
    """Points (n, 3) after the rigid motion that lays the usable ones onto the skin."""
    sample = points[usable[:: max(1, len(usable) // ICP_POINTS)]]
    sample = sample[~base.near_cap(sample)]
    centre = sample.mean(axis=0)
    rotation, shift = Rotation.identity(), np.zeros(3)
    for _ in range(ICP_ROUNDS):
        moved = rotation.apply(sample - centre) + centre + shift
        turn, step = _icp_step(moved, centre + shift, *base.closest(moved))
        rotation, shift = Rotation.from_rotvec(turn) * rotation, shift + step
        if np.linalg.norm(turn) < 1e-5 and np.linalg.norm(step) < 1e-3:
            break
    return rotation.apply(points - centre) + centre + shift


def _icp_step(moved: Array, pivot: Array, closest: Array, normals: Array) -> tuple[Array, Array]:
    """Rotation vector about ``pivot`` and translation of one weighted point-to-plane step."""
    residual = ((closest - moved) * normals).sum(axis=1)
    scale = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), 0.05)
    u = np.clip(np.abs(residual) / (4.685 * scale), 0, 1)
    weight = (1 - u * u) ** 2
    design = np.column_stack([np.cross(moved - pivot, normals), normals])
    normal_matrix = design.T @ (design * weight[:, None])
    # The limb is nearly a body of revolution: damping keeps single steps of the turn about its axis small.
    damping = np.diag(1e-4 * np.diag(normal_matrix))
    step = np.linalg.solve(normal_matrix + damping, design.T @ (weight * residual))
    return step[:3], step[3:]


def _clusters(raised: NDArray[np.bool_], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cluster number (n,) of raised vertices that share edges; -1 elsewhere."""
    edges = half_edges(faces)
    edges = edges[raised[edges].all(axis=1)]
    n = len(raised)
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(n, n))
    _, component = connected_components(graph, directed=False)
    labels = np.full(n, -1, np.int64)
    if raised.any():
        labels[raised] = np.unique(component[raised], return_inverse=True)[1]
    return labels


def _vertex_areas(surface: Surface) -> Array:
    areas = np.zeros(len(surface.points))
    np.add.at(areas, surface.faces, surface.face_areas[:, None] / 3)
    return areas
