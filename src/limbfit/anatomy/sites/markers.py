"""Skin markers from two surfaces of the same limb, with and without them (paper, section 2.1.1, figure 1).

Places that stand out of the skin by more than a threshold are clustered; each cluster that is high and small
enough is a marker. The flat proximal cap is no skin and is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from ...arrays import Array, Indices, Mask
from ...errors import SiteError
from ..surfaces.triangles import Surface, find_half_edges, number_components

CAP_MARGIN_MM = 6.0
MIN_HEIGHT_MM = 2.0  # of a marker; half of it is where bumps are separated
MAX_AREA_MM2 = 500.0  # what is larger is no marker (a cushion, a fold, a bandage)
MAX_DISTANCE_MM = 15.0  # of a marker from its hint
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


@dataclass(frozen=True)
class Bump:
    """Vertices of a surface that stand out together: all of them, and those of the upper half."""

    feet: Indices
    upper: Indices
    height: float
    area: float


def find_markers(skin_with: Surface, skin_without: Surface) -> tuple[Marker, ...]:
    """Markers on a limb, from the distance between its surfaces with and without them.

    Parameters
    ----------
    skin_with, skin_without : closed outward surfaces of the limb in one place (``registration`` lays the
        images of two scans onto each other).

    Returns
    -------
    tuple[Marker, ...]
        Highest first; empty where nothing stands out.
    """
    height = skin_without.signed_distance(skin_with.points)
    cap = find_cap_faces(skin_without)
    height[find_near_cap(skin_without, cap, skin_with.points)] = 0.0
    areas = _compute_vertex_areas(skin_with)
    open_skin = Surface(skin_without.points, skin_without.faces[~cap])
    found = []
    for bump in find_bumps(skin_with, height):
        weights = areas[bump.upper] * height[bump.upper]
        position, direction = _find_foot(open_skin, skin_with.points[bump.upper], weights)
        found.append(Marker(position, bump.height, bump.area, direction))
    return tuple(sorted(found, key=lambda marker: -marker.height))


def find_bumps(surface: Surface, height: Array) -> list[Bump]:
    """What stands out high and small enough for a marker; ``height`` (n,) of each vertex, mm."""
    labels = _number_clusters(height > MIN_HEIGHT_MM / 2, surface.faces)
    areas = _compute_vertex_areas(surface)
    found = []
    for label in range(labels.max(initial=-1) + 1):
        feet = np.flatnonzero(labels == label)
        tallest = float(height[feet].max())
        upper = feet[height[feet] > tallest / 2]  # terraces of the skin may touch a marker's foot
        area = float(areas[upper].sum())
        if tallest >= MIN_HEIGHT_MM and area <= MAX_AREA_MM2:
            found.append(Bump(feet, upper, tallest, area))
    return found


def match_markers(markers: Sequence[Marker], hints: Mapping[str, Array]) -> dict[str, Marker]:
    """Give each named place its marker, one to one, with the least total distance.

    Markers that no place asks for are left over: a limb may carry more markers than the study has sites.

    Parameters
    ----------
    hints : rough position (3,) in LPS mm by site name.

    Raises
    ------
    SiteError
        When a place has no marker within reach, or more than one; it names them all.
    """
    if not hints:
        return {}
    names = list(hints)
    positions = np.array([marker.position for marker in markers]).reshape(-1, 3)
    distance = np.linalg.norm(np.array(list(hints.values()), float)[:, None] - positions, axis=-1)
    # A pair beyond reach costs more than any choice of pairs within it, so reach goes before nearness.
    cost = np.where(distance <= MAX_DISTANCE_MM, distance, 1e3 * (1 + MAX_DISTANCE_MM) * len(names))
    rows, columns = linear_sum_assignment(cost)
    pairs = {r: c for r, c in zip(rows, columns, strict=True) if distance[r, c] <= MAX_DISTANCE_MM}
    nearest = distance.min(axis=1, initial=np.inf)
    missing = [
        f"{name} (nearest at {nearest[r]:.1f} mm)" if markers else name
        for r, name in enumerate(names)
        if r not in pairs
    ]
    spare = np.setdiff1d(np.arange(len(markers)), list(pairs.values()))
    doubled = [names[r] for r in pairs if (distance[r, spare] <= MAX_DISTANCE_MM).any()]
    faults = []
    if missing:
        faults.append(f"no marker of its own within {MAX_DISTANCE_MM:g} mm for {', '.join(missing)}")
    if doubled:
        faults.append(f"more than one marker within {MAX_DISTANCE_MM:g} mm of {', '.join(doubled)}")
    if faults:
        raise SiteError(
            "; ".join(faults),
            place="sites",
            remedy="correct 'near', or give the site's 'position' on the skin",
        )
    return {names[r]: markers[c] for r, c in pairs.items()}


def _find_foot(skin: Surface, points: Array, weights: Array) -> tuple[Array, Array]:
    """Where the weighted centroid of points (n, 3) stands on the skin, and the mean normal around it."""
    centre = np.average(points, axis=0, weights=weights)[None]
    (foot,) = skin.find_nearest(centre)[2]
    distance = np.linalg.norm(skin.triangles.mean(axis=1) - foot, axis=1)
    near = distance < NORMAL_RADIUS_MM
    if not near.any():
        near = np.arange(len(distance)) == distance.argmin()
    normal = (skin.face_normals[near] * skin.face_areas[near, None]).sum(axis=0)
    return foot, normal / np.linalg.norm(normal)


def find_cap_faces(surface: Surface) -> Mask:
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


def find_near_cap(surface: Surface, cap: Mask, points: Array) -> Mask:
    """True (n,) for points beyond the plane of a surface's cap (faces of it) or just under it."""
    if not cap.any():
        return np.zeros(len(points), bool)
    areas = surface.face_areas[cap]
    normal = np.average(surface.face_normals[cap], axis=0, weights=areas)
    normal /= np.linalg.norm(normal)
    level = np.average(surface.triangles[cap].mean(axis=1) @ normal, weights=areas)
    return points @ normal > level - CAP_MARGIN_MM


def _number_clusters(raised: Mask, faces: Indices) -> Indices:
    """Cluster number (n,) of raised vertices that share edges; -1 elsewhere."""
    edges = find_half_edges(faces)
    edges = edges[raised[edges].all(axis=1)]
    component = number_components(edges, len(raised))
    labels = np.full(len(raised), -1, np.int64)
    if raised.any():
        labels[raised] = np.unique(component[raised], return_inverse=True)[1]
    return labels


def _compute_vertex_areas(surface: Surface) -> Array:
    areas = np.zeros(len(surface.points))
    np.add.at(areas, surface.faces, surface.face_areas[:, None] / 3)
    return areas
