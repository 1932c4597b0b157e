"""Indentation sites on the skin: the nearest skin point, the indenter's direction, the tissue under it."""

import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array
from ...errors import SiteError
from ..surfaces.surfaces import ON_CUT_MM, Anatomy
from ..surfaces.triangles import Surface, cross_edges

MAX_OFF_SKIN_MM = 5.0
SAMPLE_EDGE_MM = 1.0
AXIS_STEPS = 4
MAX_DEPTH_MM = 40.0  # beyond it, bone no longer stiffens what is felt
_TICKS = np.linspace(-0.5, 0.5, 5)


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

    Parameters
    ----------
    skin : outward; of a limb its `Anatomy.open_skin`, as the cap at the cut is no skin.
    position : (3,) the footprint's centre, on the skin.
    width : side of the square, mm.
    edge : (3,) an edge direction of the square; the cross product of axis and z (or x) when not given.

    Raises
    ------
    SiteError
        When no skin lies under the footprint.
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
        corners = _split_in_four(corners[close & (edges > SAMPLE_EDGE_MM)])
    corners = np.concatenate(fine)
    near = np.linalg.norm(corners.mean(axis=1) - centre, axis=1) < width
    return corners[near].mean(axis=1), cross_edges(corners[near])


def _split_in_four(corners: Array) -> Array:
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


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
        least = min(least, float((hits - skin)[through].min(initial=least)))
    return least
