"""A socket to be printed: a wall around its inner face, a round brim and a flat face for an adapter."""

from itertools import pairwise

import manifold3d
import numpy as np

from ..anatomy.grid import build_limb_frame
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError
from .shape import Socket

BRIM_STEPS = 6  # of the half circle between the two sides
MIN_THICKNESS_SHARE = 0.9  # of the thickness that was asked for
ADAPTER_EDGES = 96  # edges of the adapter's cylinder
SLIVER_MM = 0.005  # what is shorter where adapter and wall meet would collapse in an STL file
# Behind the face, which may have moved by that much: where measuring its wall begins.
START_BEHIND_MM = 10 * SLIVER_MM


def build_wall(
    socket: Socket,
    axis: Array,
    thickness_mm: float = 4.0,
    *,
    adapter_diameter_mm: float = 60.0,
    adapter_mm: float = 8.0,
) -> Surface:
    """Build the socket as a closed body, LPS mm, outward.

    Its inner side is the socket's face; the outer side lies ``thickness_mm`` outside it along its normals.

    Raises `SurfaceError` for a socket whose distal end is open, a wall that would be thinner than 90 % of
    what was asked or cross itself, and an adapter that is as wide as the socket.

    Parameters
    ----------
    axis : (3,) proximal direction; the adapter's face looks the other way.
    thickness_mm : of the wall.
    adapter_diameter_mm : of the cylinder at the distal end; 0: none.
    adapter_mm : its material between the lowest point of the cavity and its flat face, mm.
    """
    if socket.open_distal:
        raise SurfaceError("a socket with an open distal end has no wall", remedy="close its end")
    shell = _to_manifold(_build_shell(socket, thickness_mm), "wall")
    if adapter_diameter_mm == 0.0:
        return _to_surface(shell)
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    block = _build_adapter(socket, axis, adapter_diameter_mm, max(adapter_mm, thickness_mm))
    cavity = _to_manifold(socket.closed_surface, "cavity")
    return _to_surface((shell + (block - cavity)).set_tolerance(SLIVER_MM))


def measure_thickness(body: Surface, socket: Socket) -> Array:
    """Measure the wall behind each triangle (m,) of a socket's face, along its normal, mm.

    Parameters
    ----------
    body : of `build_wall`, LPS mm.
    """
    outwards = -socket.surface.face_normals
    starts = socket.surface.triangles.mean(axis=1) + START_BEHIND_MM * outwards
    return np.array([met[0] for met in body.find_ray_hits(starts, outwards)]) + START_BEHIND_MM


def _build_shell(socket: Socket, thickness: float) -> Surface:
    """Build both sides and the half circle that joins them along the brim."""
    inner, outwards = socket.points, -socket.surface.vertex_normals
    outer = inner + thickness * outwards
    least = float(np.sqrt(socket.surface.find_nearest(outer)[0].min()))
    body = _build_sides(socket, outer, outwards, thickness)
    if least < MIN_THICKNESS_SHARE * thickness or len(body.self_intersections):
        raise SurfaceError(
            f"a wall of {thickness:g} mm would fold outside the socket's narrow places ({least:.1f} mm)",
            remedy="make it thinner, the flare larger, or the areas of the socket wider or less deep",
        )
    return body


def _build_sides(socket: Socket, outer: Array, outwards: Array, thickness: float) -> Surface:
    brim, count = socket.brim, len(socket.points)
    points, out = socket.points[brim], outwards[brim]
    along = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    up = np.cross(along, out)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    if np.einsum("ij,ij->i", up, points - socket.points.mean(axis=0)).mean() < 0.0:
        up = -up
    rings, added = [brim], []
    middle = points + thickness / 2 * out
    for turn in np.pi * np.arange(1, BRIM_STEPS) / BRIM_STEPS:
        added.append(middle + thickness / 2 * (np.sin(turn) * up - np.cos(turn) * out))
        rings.append(2 * count + (len(added) - 1) * len(brim) + np.arange(len(brim)))
    rings.append(brim + count)
    strips = []
    for low, high in pairwise(rings):
        strips.append(np.column_stack([np.roll(low, -1), low, high]))
        strips.append(np.column_stack([np.roll(low, -1), high, np.roll(high, -1)]))
    faces = np.vstack([socket.faces, socket.faces[:, ::-1] + count, *strips])
    return Surface(np.vstack([socket.points, outer, *added]), faces)


def _build_adapter(socket: Socket, axis: Array, diameter: float, below: float) -> manifold3d.Manifold:
    """Build the adapter's cylinder under the middle of the distal end, up into the wall around it."""
    height = socket.points @ axis
    bottom, length = float(height.min()), float(np.ptp(height))
    end = socket.points[height < bottom + min(diameter / 2, 0.25 * length)]
    lowest = end.mean(axis=0)
    lowest = lowest + (bottom - lowest @ axis) * axis
    spokes = socket.points - lowest
    across = np.linalg.norm(spokes - np.outer(spokes @ axis, axis), axis=1)
    low = height < bottom + 0.5 * length
    if diameter / 2 > np.percentile(across[low], 90):
        raise SurfaceError(
            f"an adapter of {diameter:g} mm is as wide as the socket",
            remedy="give a smaller diameter, or 0 for none",
        )
    # At no point's own height, where faces would lie in each other.
    top = float(height[low & (across < diameter / 2)].max()) + 0.1 * below
    foot, length = lowest - below * axis, below + top - bottom
    along = build_limb_frame(foot, axis).rotation.T  # columns: two directions across, and the axis
    cylinder = manifold3d.Manifold.cylinder(length, diameter / 2, circular_segments=ADAPTER_EDGES)
    return cylinder.transform(np.column_stack([along, foot]))


def _to_manifold(surface: Surface, name: str) -> manifold3d.Manifold:
    mesh = manifold3d.Mesh64(surface.points, surface.faces.astype(np.uint64))
    body = manifold3d.Manifold(mesh)
    if body.status() != manifold3d.Error.NoError:
        what = f"the socket's {name} is no closed body ({body.status().name})"
        raise SurfaceError(what, remedy="remesh the socket")
    return body


def _to_surface(body: manifold3d.Manifold) -> Surface:
    mesh = body.to_mesh64()
    return Surface(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts).astype(np.int64))
