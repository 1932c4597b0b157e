"""The skin of an image with markers on it, and the same image without them.

The outline with markers is a contour of the grey values, not of a mask: a marker is a few voxels wide, and
its place follows from how much of each voxel it fills. Without a second image the skin under a marker is what
the skin around it suggests: quadratic patches, fitted to the outline so that what stands out does not pull.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from ...arrays import Array, Indices, Mask
from ...errors import ImageError
from ..grid import Volume
from ..morphology import Field, dilate_mask, erode_mask, find_box, find_local_maximum
from ..segmentation.body import find_limb_mask, is_ct, smooth_image
from ..surfaces.extraction import extract_contour
from ..surfaces.triangles import Surface
from .sites import find_bumps, find_cap_faces, find_near_cap

_RIM_MM = 2.5  # the outline lies this near to the mask's, and at half of the brightest tissue this near
_SPACING_MM = 3.0  # of the places where patches are fitted
_NEIGHBOURS = 160  # of such places under a patch: some 20 mm around
_REJECT_MM = 0.7  # what stands out of a patch by more does not pull it
_ROUNDS = 8
_AROUND_MM = 2.5  # a marker's foot beyond what stands out
_PATCH_MM = 14.0  # of skin around a foot, from which the skin under it follows
_ABOVE_MM = 15.0  # no marker is higher


def extract_marked_skin(volume: Volume) -> tuple[Surface, Mask]:
    """The skin of an image with the markers on it, LPS mm, and the limb's mask ``[k, j, i]``.

    Where the image ends, the skin is closed by a flat cap.
    """
    if is_ct(volume):
        raise ImageError(
            "the image is CT; markers are found in MRI only",
            remedy="give the sites' positions (position in study.toml)",
        )
    smooth = smooth_image(volume)
    limb = find_limb_mask(volume, smooth)
    box = find_box(limb, 2 * np.ceil(_RIM_MM / volume.spacing[::-1]).astype(int) + 2)
    contour = _extract_outline(smooth[box], limb[box], volume.spacing)
    return Surface(volume.crop(box).index_to_point(contour.points), contour.faces).outward, limb


def _extract_outline(smooth: Field, limb: Mask, spacing: Array) -> Surface:
    """Where the signal falls to half of the tissue beside it, near to a limb's outline, in voxels."""
    core = erode_mask(limb, _RIM_MM, spacing)
    half = gaussian_filter(0.5 * find_local_maximum(smooth, _RIM_MM, spacing), 1.0)
    level = np.clip(smooth / np.maximum(half, 1e-6) - 1, -1, 1)
    level[core] = 1.0
    level[~dilate_mask(limb, _RIM_MM, spacing)] = -1.0
    padded = np.pad(level, 1, constant_values=-1.0)
    contour = extract_contour(padded, 0.0)
    return Surface(contour.points - 1, contour.faces)


def remove_markers(volume: Volume, skin: Surface) -> tuple[Volume, int]:
    """The image with the markers on its skin turned into air, and how many there were.

    ``skin`` is the outline of the image with markers on (:func:`extract_marked_skin`).
    """
    found = find_bumps(skin, outline_height(skin))
    marked = np.zeros(len(skin.points), bool)
    for bump in found:
        marked[bump.feet] = True
    array = volume.array.copy()
    air = float(np.median(array[array < 0.2 * np.percentile(array, 99)]))
    normals = skin.vertex_normals
    for bump in found:
        _clear_marker(array, volume, skin, normals, marked, bump.feet, air)
    return volume.with_array(array), len(found)


def outline_height(skin: Surface) -> Array:
    """How far each vertex (n,) stands out of the patch of skin around it, mm; 0 near the cap."""
    normals = skin.vertex_normals
    cells = np.floor(skin.points / _SPACING_MM).astype(np.int64)
    places = np.unique(cells, axis=0, return_index=True)[1]
    cap = find_near_cap(skin, find_cap_faces(skin), skin.points)
    places = places[~cap[places]]
    points = skin.points[places]
    tree = cKDTree(points)
    around = tree.query(points, k=min(_NEIGHBOURS, len(points)))[1]
    frames = _build_frames(normals[places][around].mean(axis=1))
    offsets = np.einsum("nab,nkb->nka", frames, points[around] - points[:, None])
    facing = np.einsum("nkb,nb->nk", normals[places][around], frames[:, 2]) > 0.3
    coefficients = _fit_patches(offsets, facing)
    nearest = tree.query(skin.points)[1]
    u, v, h = np.einsum("nab,nb->an", frames[nearest], skin.points - points[nearest])
    height = h - (_evaluate_basis(u, v) * coefficients[nearest]).sum(axis=1)
    height[cap] = 0.0
    return height


def _evaluate_basis(u: Array, v: Array) -> Array:
    """Quadratic polynomials (..., 6) over a tangent plane, of the order of one 10 mm away."""
    u, v = u / 10, v / 10
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _build_frames(normals: Array) -> Array:
    """Two tangents and the normal (n, 3, 3), rows, of normals (n, 3) of any length."""
    normal = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    other = np.eye(3)[np.abs(normal).argmin(axis=1)]
    first = np.cross(normal, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def _fit_patches(offsets: Array, usable: Mask) -> Array:
    """Coefficients (n, 6) of patches over local points (n, k, 3), with Geman and McClure's weights.

    The width of the weights shrinks from round to round, so that no start has to be right.
    """
    design = _evaluate_basis(offsets[..., 0], offsets[..., 1])
    weight = usable.astype(float)
    coefficients = np.zeros((len(offsets), 6))
    for width in np.geomspace(8 * _REJECT_MM, _REJECT_MM, _ROUNDS):
        weighted = design * weight[..., None]
        matrix = np.einsum("nka,nkb->nab", weighted, design) + 1e-6 * np.eye(6)
        right = np.einsum("nka,nk->na", weighted, offsets[..., 2])
        coefficients = np.linalg.solve(matrix, right[..., None])[..., 0]
        residual = offsets[..., 2] - np.einsum("nka,na->nk", design, coefficients)
        weight = usable / (1 + (residual / width) ** 2) ** 2
    return coefficients


def _clear_marker(
    array: NDArray[np.float32],
    volume: Volume,
    skin: Surface,
    normals: Array,
    marked: Mask,
    feet: Indices,
    air: float,
) -> None:
    """Turn a marker into air, in place: what is above the patch that fits the skin around its foot.

    Voxels that the patch cuts keep their share.
    """
    centre = skin.points[feet].mean(axis=0)
    distance = np.linalg.norm(skin.points - centre, axis=1)
    foot = float(distance[feet].max()) + _AROUND_MM
    near = (distance < foot + _PATCH_MM) & (distance > foot) & ~marked
    (frame,) = _build_frames(normals[near].mean(axis=0)[None])
    near &= normals @ frame[2] > 0.3
    offsets = (skin.points[near] - centre) @ frame.T
    (coefficients,) = _fit_patches(offsets[None], np.ones((1, len(offsets)), bool))
    reach = np.ceil((foot + _ABOVE_MM) / volume.spacing).astype(int) + 1
    middle = np.rint(volume.point_to_index(centre)).astype(int)
    low, high = np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, volume.size)
    box = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
    index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(low, high, strict=True))), axis=-1)
    index = index.transpose(2, 0, 1, 3)  # [k, j, i]
    u, v, above = frame @ (volume.index_to_point(index).reshape(-1, 3) - centre).T
    height = above - _evaluate_basis(u, v) @ coefficients
    width = float(np.abs(volume.direction.T @ frame[2]) @ volume.spacing)
    share = np.clip(0.5 - height / width, 0, 1)
    share[(np.hypot(u, v) > foot) | (height > _ABOVE_MM)] = 1.0
    share = share.reshape(index.shape[:3])
    array[box] = np.where(share < 1, np.minimum(array[box], air + (array[box] - air) * share), array[box])
