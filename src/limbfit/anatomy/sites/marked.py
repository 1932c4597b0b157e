"""The skin of an image with markers on it, and the same image without them.

The outline with markers is a contour of the grey values, not of a mask: a marker is a few voxels wide, and
its place follows from how much of each voxel it fills. Without a second image the skin under a marker is what
the skin around it suggests: quadratic patches, fitted to the outline so that what stands out does not pull.

How a limb moved between two images of it is a rigid motion that lays their grey values onto each other. Grey
values inside the limb tell more than its skin: a limb is nearly a body of revolution, and turns about its
axis show in the bones. Both images are smoothed, so that noise does not prefer places between voxels, and
sampled with cubic splines at jittered points, so that interpolation blurs both alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ...arrays import Array, Mask
from ...errors import ImageError
from ..grid import Volume
from ..morphology import dilate_mask, erode_mask, find_box, find_local_maximum
from ..segmentation.body import find_limb_mask, is_ct, smooth_image
from ..surfaces.extraction import extract_contour
from ..surfaces.triangles import Surface
from .sites import find_bumps, find_cap

_RIM_MM = 2.5  # the outline lies this near to the mask's, and at half of the brightest tissue this near
_SPACING_MM = 3.0  # of the places where patches are fitted
_NEIGHBOURS = 160  # of such places under a patch: some 20 mm around
_REJECT_MM = 0.7  # what stands out of a patch by more does not pull it
_ROUNDS = 8
_AROUND_MM = 2.5  # a marker's foot beyond what stands out
_PATCH_MM = 14.0  # of skin around a foot, from which the skin under it follows
_ABOVE_MM = 15.0  # no marker is higher
_LEVELS_MM = (6.0, 2.5)  # of smoothing: the first reaches far, the second is exact
_FINEST_MM = 1.0  # of voxels: finer ones are joined, as the smoothing does not show them
_SAMPLES = 20000
_BORDER_MM = 10.0  # of the image: what is nearer may have no partner in the other
_ARM_MM = 50.0  # a turn of 1 / _ARM_MM rad counts as much as a shift of 1 mm
_SOFT_SHARE = 0.2  # of the median grey value: differences beyond it pull less (soft L1)
_MIN_CORRELATION = 0.7  # least correlation of two images of one limb


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
    smooth, inside = smooth[box], limb[box]
    # The skin is where the signal falls to half of the tissue beside it, near to the limb's outline.
    half = gaussian_filter(0.5 * find_local_maximum(smooth, _RIM_MM, volume.spacing), 1.0)
    level = np.clip(smooth / np.maximum(half, 1e-6) - 1, -1, 1)
    level[erode_mask(inside, _RIM_MM, volume.spacing)] = 1.0
    level[~dilate_mask(inside, _RIM_MM, volume.spacing)] = -1.0
    contour = extract_contour(np.pad(level, 1, constant_values=-1.0), 0.0)
    skin = Surface(volume.crop(box).index_to_point(contour.points - 1), contour.faces)
    return skin.outward_surface, limb


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
    for bump in found:  # what is above the patch that fits the skin around its foot
        centre = skin.points[bump.feet].mean(axis=0)
        distance = np.linalg.norm(skin.points - centre, axis=1)
        foot = float(distance[bump.feet].max()) + _AROUND_MM
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
        share = np.clip(0.5 - height / width, 0, 1)  # of voxels that the patch cuts
        share[(np.hypot(u, v) > foot) | (height > _ABOVE_MM)] = 1.0
        share = share.reshape(index.shape[:3])
        array[box] = np.where(share < 1, np.minimum(array[box], air + (array[box] - air) * share), array[box])
    return volume.with_array(array), len(found)


def outline_height(skin: Surface) -> Array:
    """How far each vertex (n,) stands out of the patch of skin around it, mm; 0 near the cap."""
    normals = skin.vertex_normals
    cells = np.floor(skin.points / _SPACING_MM).astype(np.int64)
    places = np.unique(cells, axis=0, return_index=True)[1]
    cap = find_cap(skin, skin.points)[1]
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


@dataclass(frozen=True)
class LimbMotion:
    """A rigid motion of points, LPS mm: ``rotation @ (point - centre) + centre + shift``.

    ``correlation`` is that of the grey values that it lays onto each other.
    """

    rotation: Array
    centre: Array
    shift: Array
    correlation: float = 1.0

    def apply(self, points: ArrayLike) -> Array:
        """Moved points (n, 3)."""
        return (np.asarray(points, dtype=float) - self.centre) @ self.rotation.T + self.centre + self.shift

    @property
    def turn_deg(self) -> float:
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))

    @property
    def shift_mm(self) -> float:
        """Length of the shift of the limb's middle."""
        return float(np.linalg.norm(self.shift))


def register_limb(image: Volume, moved: Volume, limb: Mask) -> LimbMotion:
    """The motion that lays the limb of ``moved`` onto that of ``image``, in which it is ``limb`` ``[k, j,
    i]``.

    Both show one limb in the same contrast, some centimetres and degrees apart at most; a factor between
    their grey values is found too. Raises `ImageError` where the images cannot be laid onto each other: other
    limbs, other contrasts, too large a motion.
    """
    index = _sample(image, limb)
    points = image.index_to_point(index)
    image, moved = _coarsen_volume(image), _coarsen_volume(moved)
    centre = points.mean(axis=0)
    unknowns = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    for sigma in _LEVELS_MM:
        target = _build_interpolator(image, sigma)(points)
        value = _build_interpolator(moved, sigma)
        scale = _SOFT_SHARE * float(np.median(target))

        def misfit(x: Array, target: Array = target, value: Callable[[Array], Array] = value) -> Array:
            return (x[6] * value(_move_points(points, centre, x)) - target) / scale  # noqa: B023 - used at once

        unknowns = least_squares(misfit, unknowns, loss="soft_l1", diff_step=0.02, xtol=1e-4, ftol=1e-6).x
    correlation = float(np.corrcoef(target, value(_move_points(points, centre, unknowns)))[0, 1])
    if not correlation >= _MIN_CORRELATION:
        raise ImageError(
            f"the images with and without markers do not match (correlation {correlation:.2f})",
            remedy="give two scans of the same limb, place and contrast, or use the one with markers alone "
            '(image.markers = "same")',
        )
    turn = Rotation.from_rotvec(unknowns[:3] / _ARM_MM).as_matrix()
    return LimbMotion(turn.T, centre, -turn.T @ unknowns[3:6], correlation)


def _sample(image: Volume, limb: Mask) -> Array:
    """Jittered indices (n, 3), i j k, of points within the limb, off the image's border."""
    random = np.random.default_rng(0)
    voxels = np.argwhere(limb)[:, ::-1]
    border = _BORDER_MM / image.spacing
    inside = ((voxels > border) & (voxels < np.array(image.size) - 1 - border)).all(axis=1)
    if not inside.any():
        raise ImageError("no limb was found in the image", remedy="check the series and its contrast")
    voxels = voxels[inside]
    chosen = voxels[random.choice(len(voxels), min(_SAMPLES, len(voxels)), replace=False)]
    return chosen + random.uniform(-0.5, 0.5, chosen.shape)


def _coarsen_volume(volume: Volume) -> Volume:
    """The means of blocks of voxels that are not larger than 1 mm."""
    factors = np.maximum((_FINEST_MM / volume.spacing).astype(int), 1)
    return Volume.from_sitk(sitk.BinShrink(volume.to_sitk(), factors.tolist()))


def _move_points(points: Array, centre: Array, unknowns: Array) -> Array:
    return Rotation.from_rotvec(unknowns[:3] / _ARM_MM).apply(points - centre) + centre + unknowns[3:6]


def _build_interpolator(volume: Volume, sigma_mm: float) -> Callable[[Array], Array]:
    """The smoothed image as a function of points (n, 3); thinned to steps that still carry it."""
    smooth = gaussian_filter(volume.array, sigma_mm / volume.spacing[::-1])
    steps = np.maximum((sigma_mm / volume.spacing).astype(int), 1)
    thin = smooth[:: steps[2], :: steps[1], :: steps[0]]
    spline = spline_filter(thin, order=3, output=np.float32)

    def value(points: Array) -> Array:
        place = (volume.point_to_index(points) / steps)[:, ::-1].T
        return map_coordinates(spline, place, order=3, mode="nearest", prefilter=False)

    return value
