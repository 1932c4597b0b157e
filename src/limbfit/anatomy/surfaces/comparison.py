"""Two shapes side by side: rigid registration, signed distances, and circumferences along an axis."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ...arrays import Array
from ...errors import SurfaceError
from ...results.shapes import Circumference, ShapeComparison
from .mending import find_flat_ends
from .triangles import Surface, close_by_fans, cross_edges, find_bodies, find_open_edges, open_loops

STEP_MM = 20.0  # between circumferences
ROLLS = 8  # of the starts of a registration, around the long axis
_FIRST_ROUNDS, _ROUNDS = (15, 300), (500, 4000)  # and points: of each start, of the best one
_MEAN_MM = 1e-4  # a registration ends where the mean distance changes less


def orient_outside(surface: Surface) -> Surface:
    """Look outward; with an open end, away from what it surrounds. Raises `SurfaceError` for several bodies,
    open ends or holes.
    """
    if (count := len(find_bodies(surface))) > 1:
        raise SurfaceError(f"{count} bodies in one file", remedy="choose one by --body: 1 is the largest")
    if (count := len(open_loops(surface))) > 1:
        raise SurfaceError(f"not closed: {count} open ends or holes", remedy="close all but the proximal end")
    return surface if close_by_fans(surface).volume > 0.0 else surface.flipped_surface


def find_axis(surface: Surface, proximal: Array) -> Array:
    """The unit normal of an open or flat end, or the long axis: whichever is nearest to ``proximal`` (3,)."""
    longest = _find_principal_axes(surface)[:, 2]
    open_end = cross_edges(close_by_fans(surface).triangles[len(surface.faces) :]).sum(axis=0)
    ends = [normal for _, normal in find_flat_ends(surface)]
    ends += [open_end / np.linalg.norm(open_end)] if open_end.any() else []
    return max((*ends, longest, -longest), key=lambda axis: float(axis @ proximal))


def _find_principal_axes(surface: Surface) -> Array:
    """Columns: the principal axes of a surface, the longest last, right-handed."""
    axes = np.linalg.eigh(np.cov(surface.triangles.mean(axis=1).T, aweights=surface.face_areas))[1]
    return np.asarray(axes * [np.linalg.det(axes), 1.0, 1.0])


def register_surface(moving: Surface, fixed: Surface) -> Surface:
    """Move a surface rigidly onto another one by iterative closest points (VTK, by pyvista).

    It starts as it lies, and with both long axes on each other, upright and upside down, in 8 rolls.
    """
    from_middle, target = moving.points - moving.points.mean(axis=0), fixed.points.mean(axis=0)
    ours, theirs = _find_principal_axes(moving), _find_principal_axes(fixed)
    angles = [(360.0 * k / ROLLS, flip) for k in range(ROLLS) for flip in (0.0, 180.0)]
    turns = theirs @ Rotation.from_euler("zx", angles, degrees=True).as_matrix() @ ours.T
    starts = [moving.points, *(from_middle @ turn.T + target for turn in turns)]

    def match(points: Array, rounds: int, most: int) -> Array:
        settings = {"max_landmarks": most, "max_iterations": rounds, "max_mean_distance": _MEAN_MM}
        placed: Any = replace(moving, points=points).to_pyvista()
        return np.asarray(
            placed.align(fixed.to_pyvista(), start_by_matching_centroids=False, **settings).points
        )

    found = [match(start, *_FIRST_ROUNDS) for start in starts]
    nearest = min(found, key=lambda points: float(fixed.find_nearest(points)[0].mean()))
    return replace(moving, points=match(nearest, *_ROUNDS))


def measure_distances(here: Surface, there: Surface) -> tuple[Array, Array]:
    """Signed distance (n,) of another surface at the points of an outward one, mm, positive where it lies
    outside, and the area (n,) of these points, mm2: 0 where what is nearest is at an open edge.
    """
    squared, face, foot = there.find_nearest(here.points)
    side = np.where(np.einsum("ij,ij->i", foot - here.points, here.vertex_normals) < 0.0, -1.0, 1.0)
    area = np.bincount(here.faces.ravel(), np.repeat(here.face_areas / 3, 3), len(here.points))
    at_edge = np.isin(there.faces[face], find_open_edges(there.faces)).any(axis=1)
    return side * np.sqrt(squared), np.where(at_edge, 0.0, area)


def compare_surfaces(first: Surface, second: Surface, axis: Array) -> ShapeComparison:
    """Distances, measures, and circumferences of two outward surfaces, LPS mm, along a proximal axis (3,)."""
    one, another = measure_distances(first, second), measure_distances(second, first)
    distance, area = np.append(one[0], -another[0]), np.append(one[1], another[1])
    if not area.any():
        raise SurfaceError("the two shapes do not face each other", remedy="add --register")
    return ShapeComparison(
        axis=axis,  # type: ignore[arg-type]
        max_mm=np.abs(distance[area > 0.0]).max(),
        rms_mm=np.sqrt(np.average(distance**2, weights=area)),
        mean_mm=np.average(distance, weights=area),
        compared_percent=100.0 * area.sum() / (first.area + second.area),
        lengths_mm=(np.ptp(first.points @ axis), np.ptp(second.points @ axis)),
        volumes_cm3=(close_by_fans(first).volume / 1000.0, close_by_fans(second).volume / 1000.0),
        circumferences=list_circumferences(first, second, axis),
    )


def list_circumferences(first: Surface, second: Surface, axis: Array) -> list[Circumference]:
    """Lengths of a tape around sections of two surfaces, every 20 mm over the distal end of the first.

    A tape spans hollows: it has the length of a section's convex hull. None: the section is open, or is none.
    """
    height = first.points @ axis
    rows = []
    for level in np.arange(height.min() + STEP_MM, height.max(), STEP_MM):
        around = [_measure_circumference(one, axis, float(level)) for one in (first, second)]
        rows.append(Circumference(height_mm=level - height.min(), first_mm=around[0], second_mm=around[1]))
    return rows


def _measure_circumference(surface: Surface, axis: Array, level: float) -> float | None:
    section = np.asarray(surface.to_pyvista().slice(normal=axis, origin=level * axis).points)
    ends = [surface.points[loop] @ axis for loop in open_loops(surface)]
    if len(section) < 3 or any(end.min() <= level <= end.max() for end in ends):
        return None
    return float(ConvexHull(section @ np.linalg.svd(axis[None])[2][1:].T).area)
