"""A liner: one more layer, outside the skin."""

from dataclasses import replace

import numpy as np
import pyvista as pv

from ...arrays import Array
from ..surfaces.surfaces import Anatomy, cut_and_cap
from ..surfaces.thickness import transfer_values
from ..surfaces.triangles import Surface, find_bodies, from_pyvista
from .layers import evaluate_distance, prolong_surface

SPACING_MM = 3.0  # of the grid on which the surface is contoured
EDGE_MM = 4.0  # of its triangles


def build_liner_surface(
    anatomy: Anatomy, thickness_mm: float, fat_depth_mm: Array | None = None
) -> tuple[Anatomy, Array | None]:
    """The anatomy whose outer surface is a liner's, everywhere ``thickness_mm`` outside the skin.

    Parameters
    ----------
    anatomy : closed skin and bones, LPS mm.
    thickness_mm : of the liner; meshed as the outermost layer, it leaves the skin where it was.
    fat_depth_mm : (n,) depth of the fat's inner face below the vertices of the skin.

    Returns
    -------
    anatomy : with the liner's outer surface for its skin.
    fat_depth_mm : (m,) depth of the fat's inner face below the vertices of that surface.
    """
    frame = anatomy.frame
    skin = Surface(frame.to_limb(anatomy.skin.points), anatomy.skin.faces)
    long = prolong_surface(skin)
    liner = cut_and_cap(
        _extract_offset_surface(long, thickness_mm), np.zeros(3), np.array([0.0, 0.0, 1.0]), EDGE_MM
    )
    below = np.flatnonzero(liner.points[:, 2] < -EDGE_MM / 10)
    points = liner.points.copy()
    points[below] = _project_to_offset(long, points[below], thickness_mm)
    liner = replace(liner, points=points)
    depth = None
    if fat_depth_mm is not None:
        depth = transfer_values(skin, fat_depth_mm[None], liner.points)[0] + thickness_mm
    return replace(anatomy, skin=Surface(frame.to_patient(liner.points), liner.faces)), depth


def _extract_offset_surface(surface: Surface, distance_mm: float) -> Surface:
    """A level of the distance outside a closed surface; where that is concave it keeps clear of itself."""
    pad = distance_mm + 2.0 * SPACING_MM
    low, high = surface.points.min(axis=0) - pad, surface.points.max(axis=0) + pad
    size = np.ceil((high - low) / SPACING_MM).astype(int) + 1
    grid = pv.ImageData(dimensions=size, spacing=[SPACING_MM] * 3, origin=low)
    grid.point_data["distance"] = evaluate_distance(surface, np.asarray(grid.points))[0]
    found = grid.contour([distance_mm], scalars="distance", method="flying_edges", compute_normals=False)
    outer = find_bodies(from_pyvista(found.clean()))[0].outward
    return Surface(_project_to_offset(surface, outer.points, distance_mm), outer.faces)


def _project_to_offset(surface: Surface, points: Array, distance_mm: float) -> Array:
    """Points (n, 3) near a surface's offset, put on it."""
    distance, slope = evaluate_distance(surface, points)
    return np.asarray(points + (distance_mm - distance)[:, None] * slope)
