"""Regions inside the core: closed surfaces whose inside is a tissue of its own (tendon, scar, muscle).

Vocabulary
----------
region   its number counts from 0 in the order given; of two that overlap the first has what they share.
wall     what a region may end at: the layers' inner face, the bones, the regions before it.
reach    the least thickness of core between a region and a wall, the clearance of the bones. Nearer to a wall
         than that, a point belongs to the region where the point above it, at that distance from the wall,
         does: regions meet walls at right angles, and no wedge or thin sheet of core is left between.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from ...arrays import Array, Indices, Mask
from ...errors import SurfaceError
from ...mesh import Mesh, boundary_faces
from ..surfaces.triangles import Surface
from .background import LONGEST_EDGE, REGION, Field, TetGrid, cut, refine_grid
from .layers import Level, LimbFields, compute_box_distance, evaluate_distance, sample_box

FAR_MM = 15.0  # of a region's box: a bound of the distance does there
MIN_SLOPE = 0.2  # slope of a region's level, below which it is no distance
WALL_REACHES = 2.0  # from a region before, where it may be a wall: it may itself be continued by one
SAMPLES = 20_000  # all over a region's box
CELLS_ACROSS = 3.0  # of the grid over a region's thickness, before it is cut
MIN_EDGES_ACROSS = 0.5  # of the edge near the site: a thinner region is refused


def build_region_level(fields: LimbFields, number: int) -> Field:
    """Signed function of points (n, 3) of the limb frame, negative in a region, and its gradient."""
    surface = list(fields.regions.values())[number]

    def level(points: Array) -> Level:
        value = compute_box_distance(surface, points)
        gradient = np.zeros((len(points), 3))
        near = np.flatnonzero(value < FAR_MM)
        if len(near):
            distance, normal = _measure_to_wall(fields, number, points[near])
            push = np.maximum(fields.bone_clearance_mm - distance, 0.0)
            value[near], slope = evaluate_distance(surface, points[near] + push[:, None] * normal)
            across = np.einsum("ij,ij->i", slope, normal)
            gradient[near] = slope - np.where(push > 0.0, across, 0.0)[:, None] * normal
        return value, gradient

    return level


def _measure_to_wall(fields: LimbFields, number: int, points: Array) -> Level:
    """Distance (n,) of points from the nearest wall of a region, and the unit direction away from it."""
    distance, normal = fields.layer(points)
    everywhere = np.arange(len(points))
    walls = [(everywhere, *fields.void(points))] if fields.bones else []
    for before, surface in enumerate(list(fields.regions.values())[:number]):
        close = everywhere[_is_near(surface, WALL_REACHES * fields.bone_clearance_mm, points)]
        value, slope = build_region_level(fields, before)(points[close])
        steep = np.maximum(np.linalg.norm(slope, axis=1), MIN_SLOPE)
        walls.append((close, value / steep, slope / steep[:, None]))
    for place, value, slope in walls:
        nearer = value < distance[place]
        distance[place[nearer]], normal[place[nearer]] = value[nearer], slope[nearer]
    return distance, normal


def measure_thickness(surface: Surface) -> float:
    """Thickness (mm) of a region where it is thickest: twice the greatest depth in it, below the cut."""
    samples, _ = sample_box(surface.points, 0.0, SAMPLES)
    return 2.0 * abs(float(evaluate_distance(surface, samples)[0].min(initial=0.0)))


def check_regions(fields: LimbFields, edge_near_mm: float) -> None:
    """Refuse regions that are too thin for a mesh. Raises `SurfaceError` for one that is thinner than half an
    edge near the site.
    """
    for name, surface in fields.regions.items():
        thick = measure_thickness(surface)
        if thick < MIN_EDGES_ACROSS * edge_near_mm:
            raise SurfaceError(
                f"the region is {thick:.1f} mm thick at most, too thin for edges of {edge_near_mm:g} mm",
                place=f"geometry.regions.{name}",
                remedy=f"choose edges of {thick / MIN_EDGES_ACROSS:.1f} mm or less, or leave the region out",
            )


def refine_at_regions(grid: TetGrid, fields: LimbFields) -> TetGrid:
    """A box's grid, fine enough about each region to be cut at its surface."""
    for surface in fields.regions.values():
        spacing = measure_thickness(surface) / CELLS_ACROSS
        grid = refine_grid(grid, partial(_is_near, surface, LONGEST_EDGE * spacing), spacing)
    return grid


def _is_near(surface: Surface, distance_mm: float, points: Array) -> Mask:
    """True (n,) for points inside a closed surface, or less than a distance outside it."""
    found = compute_box_distance(surface, points) < distance_mm
    found[found] = evaluate_distance(surface, points[found])[0] < distance_mm
    return found


def cut_at_regions(grid: TetGrid, fields: LimbFields) -> TetGrid:
    """The grid of the core with its regions numbered from 1. Raises `SurfaceError` for a region of which
    nothing is left under the layers.
    """
    # A level differs from the distance by as much as its points are pushed.
    slack = fields.floor_range_mm + 2.0 * fields.bone_clearance_mm
    for number, name in enumerate(fields.regions):
        grid, outside = cut(grid, build_region_level(fields, number), REGION << number, slack, region=0)
        inside = (grid.regions == 0) & ~outside
        if not inside.any():
            raise SurfaceError(
                "nothing of the region lies under the layers",
                place=f"geometry.regions.{name}",
                remedy="choose thinner layers, or leave the region out",
            )
        grid = replace(grid, regions=np.where(inside, number + 1, grid.regions))
    return grid


def compute_region_volumes(fields: LimbFields) -> dict[str, float]:
    """Volume (mm3) of each region under the layers, between the bones and the regions before it."""
    found = {}
    for number, (name, surface) in enumerate(fields.regions.items()):
        samples, whole = sample_box(surface.points, fields.bone_clearance_mm, SAMPLES)
        levels = [build_region_level(fields, before)(samples)[0] for before in range(number + 1)]
        inside = (levels.pop() < 0.0) & (fields.layer(samples)[0] > 0.0) & (fields.void(samples)[0] > 0.0)
        for before in levels:
            inside &= before > 0.0
        found[name] = float(inside.sum()) * (whole / max(len(samples), 1))
    return found


def mesh_numbers(regions: Indices, layers: int, count: int) -> Indices:
    """Numbers (m,) in a mesh, whose core comes last, of the ``regions`` (m,) of a grid, whose core is 0."""
    return np.where(regions == 0, layers + count, layers + regions - 1)


def find_interfaces(mesh: Mesh, layers: int) -> list[Indices]:
    """Outward faces (k, 3 or 6) of each region after a mesh's layers to what comes after it, to the core."""
    found = []
    for number in range(layers, len(mesh.region_names) - 1):
        inner = boundary_faces(mesh, mesh.regions == number)
        outer = boundary_faces(mesh, mesh.regions > number)
        found.append(inner[find_same_faces(inner[:, :3], outer[:, :3], len(mesh.points))])
    return found


def find_same_faces(faces: Indices, chosen: Indices, count: int) -> Mask:
    """True (m,) for faces (m, 3) among the chosen (k, 3), in any order of nodes; ``count`` nodes in all."""
    packed = [np.sort(part, axis=1) @ [count * count, count, 1] for part in (faces, chosen)]
    return np.isin(packed[0], packed[1])
