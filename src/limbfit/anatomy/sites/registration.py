"""How a limb moved between two images of it: a rigid motion that lays their grey values onto each other.

Grey values inside the limb tell more than its skin: a limb is nearly a body of revolution, and turns about
its axis show in the bones. Both images are smoothed, so that noise does not prefer places between voxels,
and sampled with cubic splines at jittered points, so that interpolation blurs both alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from ...arrays import Array, Mask
from ...errors import ImageError
from ..grid import Volume

_LEVELS_MM = (6.0, 2.5)  # of smoothing: the first reaches far, the second is exact
_FINEST_MM = 1.0  # of voxels: finer ones are joined, as the smoothing does not show them
_SAMPLES = 20000
_BORDER_MM = 10.0  # of the image: what is nearer may have no partner in the other
_ARM_MM = 50.0  # a turn of 1 / _ARM_MM rad counts as much as a shift of 1 mm
_SOFT_SHARE = 0.2  # of the median grey value: differences beyond it pull less (soft L1)
_MIN_CORRELATION = 0.7  # least correlation of two images of one limb


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
