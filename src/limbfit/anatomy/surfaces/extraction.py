"""From a mask of voxels to a smooth closed surface with even triangles.

The signed distance to the mask, rather than the mask itself, is smoothed: between thick slices it
interpolates the *shape*, so that a sloping surface shows no terraces (Raya and Udupa 1990, shape-based
interpolation). The level of the contour, and last a shift along the normals, keep the volume of the mask,
which smoothing and coarse triangles would otherwise shrink where the surface is curved.
"""

import gpytoolbox
import numpy as np
import pyvista as pv
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ...arrays import Indices, Mask
from ...errors import LabelError
from ..grid import Grid, LabelMap, Volume, resample_cubic
from ..morphology import Field, compute_distance, fill_largest_piece, find_box
from .triangles import Surface, find_bodies, find_half_edges, from_pyvista

_SIGMA_VOXELS = 0.7
# Passes and pass band of Taubin's filter, which takes out terraces wider than the Gaussian; skin has no
# edges to lose, bones have.
_TAUBIN_SKIN, _TAUBIN_BONE = (80, 0.008), (40, 0.03)
_MARGIN_MM = 4.0
_REMESH_PASSES = 8
_MAX_RELAXATIONS = 20


def extract_surface(labels: LabelMap, which: str | None, edge_mm: float = 3.0) -> Surface:
    """The closed surface of one label, or of the whole limb: LPS mm, outward, of the mask's volume.

    ``which`` is the label's name, None for the limb with all that is in it; ``edge_mm`` the edge length of
    the triangles. Only the largest body of the mask counts. Raises `LabelError` where there is nothing to
    extract.
    """
    fine = extract_fine_surface(labels, which, edge_mm)
    return untangle_surface(keep_volume(untangle_surface(remesh(fine, edge_mm)), fine.volume))


def extract_fine_surface(labels: LabelMap, which: str | None, edge_mm: float) -> Surface:
    """The same surface with the many uneven triangles of marching cubes, for cutting and remeshing."""
    mask = labels.limb if which is None else labels.mask(which)
    body, crop = _select_body(mask, labels, which or "limb")
    field, level = smooth_field(body, crop, edge_mm)
    contour = extract_contour(field.array, level)
    rough = Surface(field.index_to_point(contour.points), contour.faces).outward_surface
    passes, band = _TAUBIN_SKIN if which is None else _TAUBIN_BONE  # windowed sinc (Taubin 1995)
    smooth = rough.to_pyvista().smooth_taubin(n_iter=passes, pass_band=band, normalize_coordinates=True)
    return keep_volume(from_pyvista(smooth), float(body.sum()) * crop.voxel_mm3)


def _select_body(mask: Mask, grid: Grid, name: str) -> tuple[Mask, Grid]:
    """The largest connected body without inner holes, cropped with a margin of empty voxels."""
    if not mask.any():
        raise LabelError(f"no voxel is labelled {name!r}")
    body = fill_largest_piece(mask)
    box = find_box(body)
    pad = np.ceil(_MARGIN_MM / grid.spacing).astype(int) + 2
    padded = np.pad(body[box], pad[::-1, None])
    start = np.array([part.start for part in box])[::-1] - pad
    crop = Grid(padded, grid.spacing, grid.index_to_point(start), grid.direction)
    return padded, crop


def smooth_field(body: Mask, grid: Grid, edge_mm: float) -> tuple[Volume, float]:
    """Smoothed signed distance (mm, positive inside) on cubic voxels, and the level that keeps the volume."""
    distance = compute_signed_distance_to(body, grid)
    smooth = Volume(gaussian_filter(distance, _SIGMA_VOXELS, mode="nearest"), *grid.geometry)
    # Fine enough for triangles of that edge.
    fine = resample_cubic(
        smooth.to_sitk(), smooth, edge_mm / 2.5, sitk.sitkBSpline3, float(smooth.array.min())
    )
    cubic = Volume.from_sitk(fine)
    count = round(float(body.sum()) * grid.voxel_mm3 / cubic.voxel_mm3)
    values = cubic.array.ravel()
    place = len(values) - min(count, len(values) - 1)
    return cubic, float(np.partition(values, place)[place])


def compute_signed_distance_to(body: Mask, grid: Grid) -> Field:
    """Distance of each voxel to the nearest one on the other side, mm, positive inside, clamped."""
    reach = 3 * grid.spacing.max()
    inside, outside = (compute_distance(mask, grid.spacing) for mask in (~body, body))
    return np.minimum(inside, reach, out=inside) - np.minimum(outside, reach, out=outside)


def extract_contour(values: NDArray[np.floating], level: float) -> Surface:
    """Largest body of the surface on which values ``[k, j, i]`` have a level, in indices (i, j, k)."""
    image = pv.ImageData(dimensions=values.shape[::-1])
    image.point_data["values"] = values.ravel()
    contour = image.contour([level], scalars="values", method="flying_edges", compute_normals=False)
    return find_bodies(from_pyvista(contour))[0]


def remesh(
    surface: Surface, edge_mm: float, creases: Indices | None = None, passes: int = _REMESH_PASSES
) -> Surface:
    """Even triangles of ``edge_mm`` on the same shape (Botsch and Kobbelt 2004).

    ``creases`` (n, 2) are edges to keep sharp.
    """
    points, faces = gpytoolbox.remesh_botsch(
        surface.points,
        surface.faces.astype(np.int32),
        i=passes,
        h=edge_mm,
        project=True,
        feature_edges=None if creases is None else creases.astype(np.int32),
    )
    return Surface(points, faces)


def untangle_surface(surface: Surface, share: float = 0.5) -> Surface:
    """Move the points of crossing faces a share of the way to their neighbours' mean, until none cross.

    Remeshing folds a few triangles where a bone is hardly thicker than they are long, as at a patella's rim.
    What still crosses after that is left to the check of the anatomy.
    """
    edges = find_half_edges(surface.faces)
    for _ in range(_MAX_RELAXATIONS):
        crossing = surface.self_intersections
        if not len(crossing):
            break
        moved = np.unique(surface.faces[np.unique(crossing)])
        means = np.zeros_like(surface.points)
        np.add.at(means, edges[:, 0], surface.points[edges[:, 1]])
        means /= np.bincount(edges[:, 0], minlength=len(means))[:, None]
        points = surface.points.copy()
        points[moved] += share * (means[moved] - points[moved])
        surface = Surface(points, surface.faces)
    return surface


def keep_volume(surface: Surface, volume: float) -> Surface:
    """Shift the surface along its normals until it encloses ``volume`` (mm3): chords cut the corners of a
    curve."""
    for _ in range(3):
        shift = (volume - surface.volume) / surface.area
        surface = Surface(surface.points + shift * surface.vertex_normals, surface.faces)
    return surface
