"""Indentation sites on the skin: the nearest skin point, the indenter's direction, the tissue under it.

Sites may be marked. Markers show from two surfaces of the same limb, with and without them (paper, section
2.1.1, figure 1): places that stand out of the skin by more than a threshold are clustered; each cluster that
is high and small enough is a marker. The flat proximal cap is no skin and is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linear_sum_assignment

from ...arrays import Array, Indices, Mask
from ...errors import SiteError
from ..surfaces.surfaces import ON_CUT_MM, Anatomy
from ..surfaces.triangles import Surface, cross_edges, find_half_edges, number_components

MAX_OFF_SKIN_MM = 5.0
SAMPLE_EDGE_MM = 1.0
AXIS_STEPS = 4
MAX_DEPTH_MM = 40.0  # beyond it, bone no longer stiffens what is felt
_TICKS = np.linspace(-0.5, 0.5, 5)
CAP_MARGIN_MM = 6.0
MIN_HEIGHT_MM = 2.0  # of a marker; half of it is where bumps are separated
MAX_AREA_MM2 = 500.0  # what is larger is no marker (a cushion, a fold, a bandage)
MAX_DISTANCE_MM = 15.0  # of a marker from its hint
NORMAL_RADIUS_MM = 8.0


def project_to_skin(anatomy: Anatomy, position: ArrayLike) -> tuple[Array, float]:
    """The skin point (3,) nearest to a position (3,), LPS mm, and its distance in mm. Raises `SiteError` when
    the position lies more than 5 mm off the skin, or at the proximal cut or beyond it, where the model has no
    skin.
    """
    query = np.asarray(position, dtype=float)
    if query.shape != (3,) or not np.isfinite(query).all():
        raise SiteError("a position has three finite coordinates", remedy="give LPS millimetres")
    skin = anatomy.skin
    squared, _, nearest = skin.find_nearest(query[None])
    distance = float(np.sqrt(squared[0]))
    if distance > MAX_OFF_SKIN_MM:
        raise SiteError(
            f"lies {distance:.1f} mm off the skin",
            remedy="give the position in LPS millimetres of the image (3D Slicer shows RAS: negate x and y)",
        )
    if anatomy.height(nearest[0]) > -ON_CUT_MM:
        raise SiteError(
            "lies on the proximal cut or beyond it",
            remedy="move the site distally, or geometry.proximal_cut, whose normal points proximally",
        )
    return np.asarray(nearest[0], dtype=float), distance


def find_thinnest_tissue(anatomy: Anatomy, bone: str) -> tuple[float, Array]:
    """Least distance (mm) from a bone to the skin, and where it is on the bone (3,); the cut is no skin."""
    points = anatomy.bones[bone].points
    inner = points[anatomy.height(points) < 0]
    squared = anatomy.open_skin.find_nearest(inner)[0]
    least = int(np.argmin(squared))
    return float(np.sqrt(squared[least])), inner[least]


def compute_indenter_axis(
    skin: Surface, position: ArrayLike, width: float, edge: ArrayLike | None = None
) -> Array:
    """The unit inward axis (3,): the area-weighted mean inward normal of the skin under a square footprint.

    Raises `SiteError` when no skin lies under the footprint.

    Parameters
    ----------
    skin : outward; of a limb its `Anatomy.open_skin`, as the cap at the cut is no skin.
    position : (3,) the footprint's centre, on the skin.
    width : side of the square, mm.
    edge : (3,) an edge direction of the square; the cross product of axis and z (or x) when not given.
    """
    centre = np.asarray(position, dtype=float)
    points, normals = _sample_faces(skin, centre, width)
    face = skin.find_nearest(centre[None])[1]
    axis = _normalise(-cross_edges(skin.triangles[face])[0])
    for _ in range(AXIS_STEPS):
        across = compute_square_edges(axis, edge) @ (points - centre).T
        under = (np.abs(across) <= width / 2).all(axis=0) & (normals @ axis < 0)
        if not under.any():
            raise SiteError("no skin lies under the indenter", remedy="check the site's position")
        axis = _normalise(-normals[under].sum(axis=0))
    return axis


def compute_square_edges(axis: Array, edge: ArrayLike | None = None) -> Array:
    """The two unit edge directions (2, 3) of a square indenter, both normal to its axis.

    Without ``edge``, the first is the cross product of axis and z, or of axis and x where axis is z.
    """
    if edge is None:
        edge = np.cross(axis, [1.0, 0, 0] if abs(axis[2]) > 0.999 else [0, 0, 1.0])
    first = np.asarray(edge, float)
    first = first - (first @ axis) * axis
    if np.linalg.norm(first) < 1e-6:
        raise SiteError(
            "edge is parallel to the axis", remedy="give a direction along one edge of the square"
        )
    first = _normalise(first)
    return np.array([first, np.cross(axis, first)])


def _sample_faces(skin: Surface, centre: Array, width: float) -> tuple[Array, Array]:
    """Centroids of small pieces of the faces near a footprint, and normals as long as twice their areas."""
    corners, fine = skin.triangles, []
    while len(corners):
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        close = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) - edges < width
        fine.append(corners[close & (edges <= SAMPLE_EDGE_MM)])
        a, b, c = np.moveaxis(corners[close & (edges > SAMPLE_EDGE_MM)], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        corners = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    corners = np.concatenate(fine)
    near = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < width
    return corners[near].mean(axis=1), cross_edges(corners[near])


def _normalise(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def measure_tissue_under(anatomy: Anatomy, position: ArrayLike, axis: ArrayLike, width: float) -> float:
    """Least distance (mm) along the axis from the skin to a bone under a square footprint, at most 40.

    Parameters
    ----------
    position : (3,) the footprint's centre, on the skin.
    axis : (3,) unit, into the limb.
    width : side of the square, mm.
    """
    centre, direction = np.asarray(position, dtype=float), np.asarray(axis, dtype=float)
    along, across = compute_square_edges(direction)
    u, v = np.meshgrid(width * _TICKS, width * _TICKS)
    # From outside: at its edges the footprint may lie off a curved skin.
    starts = centre + u.reshape(-1, 1) * along + v.reshape(-1, 1) * across - width * direction
    directions = np.broadcast_to(direction, starts.shape)

    def find_first_hits(surface: Surface) -> Array:
        return np.array([met.min(initial=np.inf) for met in surface.find_ray_hits(starts, directions)])

    skin = find_first_hits(anatomy.skin)
    least = MAX_DEPTH_MM
    for bone in anatomy.bones.values():
        hits = find_first_hits(bone)
        through = np.isfinite(hits) & np.isfinite(skin) & (hits > skin)
        least = min(least, float((hits[through] - skin[through]).min(initial=least)))
    return least


@dataclass(frozen=True)
class Marker:
    """A bump on the skin: ``position`` and unit outward ``direction`` (LPS mm) on the skin without markers.

    ``height`` is its greatest height in mm.
    """

    position: Array
    height: float
    direction: Array


@dataclass(frozen=True)
class Bump:
    """Vertices of a surface that stand out together: all of them, and those of the upper half."""

    feet: Indices
    upper: Indices
    height: float


def find_markers(skin_with: Surface, skin_without: Surface) -> tuple[Marker, ...]:
    """Markers on a limb, highest first, from the distance between its surfaces with and without them.

    These are closed, outward and in one place (`register_limb` lays the images of two scans onto each
    other).
    """
    height = skin_without.signed_distance(skin_with.points)
    cap, near = find_cap(skin_without, skin_with.points)
    height[near] = 0.0
    areas = skin_with.vertex_areas
    open_skin = Surface(skin_without.points, skin_without.faces[~cap])
    found = []
    for bump in find_bumps(skin_with, height):
        weights = areas[bump.upper] * height[bump.upper]
        position, direction = _find_foot(open_skin, skin_with.points[bump.upper], weights)
        found.append(Marker(position, bump.height, direction))
    return tuple(sorted(found, key=lambda marker: -marker.height))


def find_bumps(surface: Surface, height: Array) -> list[Bump]:
    """What stands out high and small enough for a marker; ``height`` (n,) of each vertex, mm."""
    raised = height > MIN_HEIGHT_MM / 2
    edges = find_half_edges(surface.faces)
    clusters = number_components(edges[raised[edges].all(axis=1)], len(raised))
    areas = surface.vertex_areas
    found = []
    for number in np.unique(clusters[raised]):
        feet = np.flatnonzero(clusters == number)
        tallest = float(height[feet].max())
        upper = feet[height[feet] > tallest / 2]  # terraces of the skin may touch a marker's foot
        if tallest >= MIN_HEIGHT_MM and areas[upper].sum() <= MAX_AREA_MM2:
            found.append(Bump(feet, upper, tallest))
    return found


def match_markers(markers: Sequence[Marker], hints: Mapping[str, Array]) -> dict[str, Marker]:
    """Give each named place its marker, one to one, with the least total distance.

    Markers that no place asks for are left over: a limb may carry more markers than the study has sites.
    ``hints`` are rough positions (3,) in LPS mm by site name. Raises `SiteError` when a place has no marker
    within reach, or more than one; it names them all.
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


def find_cap(surface: Surface, points: Array) -> tuple[Mask, Mask]:
    """Faces (m,) of the one plane that holds more than 3 % of a surface, the cut, as skin has no such plane;
    and the points (n,) that lie beyond it or just under it."""
    normals, areas, centres = surface.face_normals, surface.face_areas, surface.triangles.mean(axis=1)
    levels = (normals * centres).sum(axis=1)
    keys = np.rint(np.column_stack([50 * normals, levels])).astype(np.int64)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.ravel()
    share = np.bincount(group, weights=areas) / areas.sum()
    if share.max() < 0.03:
        return np.zeros(len(normals), bool), np.zeros(len(points), bool)

    def fit_plane(faces: Mask) -> tuple[Array, float]:
        normal = np.average(normals[faces], axis=0, weights=areas[faces])
        normal /= np.linalg.norm(normal)
        return normal, np.average(centres[faces] @ normal, weights=areas[faces])

    normal, level = fit_plane(group == share.argmax())
    cap = (normals @ normal > 0.98) & (np.abs(centres @ normal - level) < 1.0)
    normal, level = fit_plane(cap)
    return cap, points @ normal > level - CAP_MARGIN_MM
