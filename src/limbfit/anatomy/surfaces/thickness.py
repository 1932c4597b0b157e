"""Thickness as a function on the skin: measured from the segmented fat, smoothed, carried to points."""

from pathlib import Path

import numpy as np
import pyvista as pv
from scipy.sparse import coo_array, diags_array
from scipy.spatial import KDTree

from ...arrays import Array, Indices
from ...errors import LabelError, SurfaceError
from ..grid import FAT, LabelMap
from ..morphology import find_largest_piece, open_mask
from .extraction import extract_surface
from .surfaces import Anatomy
from .triangles import Surface, find_half_edges

FAT_DEPTH = "fat_depth_mm"
SHELL_MM = 1.5  # half the thickness of the dark skin outside the fat, which is not taken for the core
SMOOTH_MM = 4.0  # how far along the skin the measured depth is smoothed
SLOPE = 0.5  # greatest change of thickness along the skin, mm per mm
OBLIQUE = 1.25  # greatest depth along the normal, of the nearest distance
CUT_MM = 3.0  # below the proximal cut, from where depth is measured
MARCHES = 30


def check_fat(labels: LabelMap) -> None:
    """Raise `LabelError` where the map has no fat."""
    if FAT not in labels.names.values() or not labels.mask(FAT).any():
        raise LabelError(
            "no voxel is labelled 'fat', which a layer's thickness map needs",
            remedy="label the fat, or give the layer a thickness_mm",
        )


def measure_fat_depth(labels: LabelMap, anatomy: Anatomy, edge_mm: float = 3.0) -> Array:
    """Depth (n,) of the fat's inner face below the vertices of an anatomy's skin, mm.

    Measured along the skin's inward normal to the smooth surface of all that the fat encloses; islands of fat
    between muscles do not count, nor does the skin outside the fat. Zero where muscle or bone lies directly
    under the skin. The anatomy is made from the same labels; ``edge_mm`` is the edge length of the surface
    under the fat. Raises `LabelError` when the map has no fat, or nothing but fat.
    """
    check_fat(labels)
    inside = labels.limb & ~labels.mask(FAT)  # with a thin shell of skin outside the fat, which goes
    core = find_largest_piece(open_mask(inside, SHELL_MM, labels.spacing))
    if not core.any():
        raise LabelError("nothing but fat lies under the skin", remedy="correct the label 'fat'")
    inner = extract_surface(labels.with_array(core.astype(np.uint8), {1: "core"}), None, edge_mm)
    skin = anatomy.skin
    depth = _measure_along_normals(skin, inner)
    near_cut = anatomy.height(skin.points) > -CUT_MM
    if near_cut.all():
        raise SurfaceError(f"the limb is not {CUT_MM:g} mm long distal of the proximal cut")
    below = np.flatnonzero(~near_cut)
    lowered = skin.points[near_cut] - CUT_MM * anatomy.cut_normal
    depth[near_cut] = depth[below[KDTree(skin.points[below]).query(lowered)[1]]]
    return limit_slope(skin, smooth_along_surface(skin, depth, SMOOTH_MM))


def _measure_along_normals(skin: Surface, inner: Surface) -> Array:
    """Distance (n,) from the skin's vertices along their inward normals to an inner surface, mm."""
    inward, origin = -skin.vertex_normals, skin.points
    nearest = np.maximum(inner.signed_distance(origin), 0.0)
    along = nearest.copy()
    for _ in range(MARCHES):  # steps that cannot cross the surface
        along += inner.signed_distance(origin + along[:, None] * inward)
    return np.clip(along, 0.0, OBLIQUE * nearest)


def smooth_along_surface(surface: Surface, values: Array, length_mm: float) -> Array:
    """Values (n,) at vertices averaged over their neighbours along the surface, about ``length_mm`` far."""
    a, b = find_edges(surface).T
    count = len(surface.points)
    links = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(count, count)).tocsr()
    mean = diags_array(1.0 / links.sum(axis=1)) @ links
    edge = float(np.median(np.linalg.norm(surface.points[a] - surface.points[b], axis=1)))
    for _ in range(max(1, round((length_mm / edge) ** 2))):  # a random walk's spread
        values = 0.5 * values + 0.5 * (mean @ values)
    return np.asarray(values)


def limit_slope(surface: Surface, values: Array) -> Array:
    """Values (n,) at vertices lowered so that along no edge they change by more than `SLOPE` per mm."""
    a, b = find_edges(surface).T
    rise = SLOPE * np.linalg.norm(surface.points[a] - surface.points[b], axis=1)
    values = values.copy()
    while True:
        before = values.copy()
        np.minimum.at(values, a, before[b] + rise)
        np.minimum.at(values, b, before[a] + rise)
        if np.array_equal(values, before):
            return values


def transfer_values(surface: Surface, values: Array, points: Array) -> Array:
    """Values (k, n) at a surface's vertices, interpolated at the surface points nearest to points (m, 3)."""
    _, face, nearest = surface.find_nearest(points)
    return interpolate_values(surface, values, face, nearest, np.finfo(float).tiny)


def interpolate_values(
    surface: Surface, values: Array, face: Indices, points: Array, least: float = -np.inf
) -> Array:
    """Values (k, n) at a surface's vertices, linear over each face (m,) and beyond it, at points (m, 3).

    ``least``: of each corner's share; a small positive one keeps to the face, which may have no area.
    """
    a, b, c = np.moveaxis(surface.triangles[face], 1, 0)
    normal = np.cross(b - a, c - a)
    parts = [np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)]
    share = np.stack([np.einsum("ij,ij->i", part, normal) for part in parts], axis=1)
    share = np.maximum(share, least)
    share /= share.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("kmi,mi->km", values[:, surface.faces[face]], share))


def find_edges(surface: Surface) -> Indices:
    """Edges (e, 2) of a closed surface, each once."""
    edges = find_half_edges(surface.faces)
    return edges[edges[:, 0] < edges[:, 1]]


def write_thickness(path: str | Path, skin: Surface, depth_mm: Array) -> None:
    """The skin with the depth (n,) of the fat's inner face at its vertices, as VTP."""
    poly = skin.to_pyvista()
    poly.point_data[FAT_DEPTH] = depth_mm
    poly.save(path)


def read_thickness(path: str | Path, skin: Surface) -> Array:
    """Depth (n,) at the vertices of a skin from a VTP file that :func:`write_thickness` wrote.

    The vertices need not be numbered alike: a surface that went through STL numbers them anew.
    """
    if not Path(path).is_file():
        raise SurfaceError("no such thickness map", file=Path(path), remedy="run the surfaces stage again")
    poly = pv.read(path)
    stored = Surface(np.asarray(poly.points), np.asarray(poly.regular_faces))
    return transfer_values(stored, np.asarray(poly.point_data[FAT_DEPTH], dtype=float)[None], skin.points)[0]
