"""Sampled images in patient space: the grid, volumes and label maps; where a limb lies in them.

Vocabulary
----------
index    (i, j, k): column, row, slice; the array is ``[k, j, i]``.
point    LPS patient coordinates (x to the Left, y Posterior, z Superior), mm.
affine   the 4 x 4 matrix that takes an index to a point: ``direction @ diag(spacing)`` and ``origin``,
         the centre of voxel (0, 0, 0).
limb frame  the proximal cut is the plane z = 0 and the limb lies at z <= 0; mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from math import prod
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..arrays import Array, Mask
from ..errors import ImageError, LabelError
from .morphology import find_box

SOFT_TISSUE = "soft tissue"
FAT = "fat"  # under the skin, the skin included
BONES = ("tibia", "fibula", "femur", "patella")
DEFAULT_NAMES: Mapping[int, str] = {1: SOFT_TISSUE, **dict(enumerate(BONES, 2)), 6: FAT}
SOFT_NAMES = frozenset({SOFT_TISSUE, "skin", FAT, "muscle", "limb", "body"})

MAX_VOXELS = 1_000_000_000  # a leg of 1 m in voxels of 0.4 mm has a quarter of that
_ORTHONORMAL = 1e-4  # largest deviation of direction^T direction from the identity
_SAME_POINT_MM = 0.01


@dataclass(frozen=True)
class Grid:
    """A sampled array with its place in the patient.

    Attributes
    ----------
    array : ``[k, j, i]``.
    spacing : (3,) mm along i, j, k.
    origin : (3,) LPS mm of the centre of voxel (0, 0, 0).
    direction : (3, 3), columns are the unit axes of i, j, k in LPS; orthonormal, either handedness.
    """

    array: NDArray[Any]
    spacing: Array
    origin: Array
    direction: Array

    _dtype: ClassVar[DTypeLike | None] = None  # that of the array; by default what is given

    def __post_init__(self) -> None:
        for name in ("spacing", "origin", "direction"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=float))
        object.__setattr__(self, "array", np.asarray(self.array, self._dtype))
        self._check()

    def _check(self) -> None:
        if self.array.ndim != 3 or 0 in self.array.shape:
            raise ImageError(f"an image needs three dimensions, this one has shape {self.array.shape}")
        if self.spacing.shape != (3,) or not np.all(np.isfinite(self.spacing) & (self.spacing > 0)):
            raise ImageError(f"voxel spacing must be three positive lengths, not {self.spacing.tolist()}")
        if self.origin.shape != (3,) or not np.all(np.isfinite(self.origin)):
            raise ImageError("the image has no usable origin")
        if self.direction.shape != (3, 3) or not np.all(np.isfinite(self.direction)):
            raise ImageError("the image axes are not a 3 x 3 matrix of numbers")
        skew = np.abs(self.direction.T @ self.direction - np.eye(3)).max()
        if skew > _ORTHONORMAL:  # a sheared grid (gantry tilt) would be read as a straight one
            raise ImageError(
                f"the image axes are not orthonormal (off by {skew:.2g})",
                remedy="resample the image to a rectangular grid",
            )

    @property
    def size(self) -> tuple[int, int, int]:
        """Number of voxels along i, j, k."""
        k, j, i = self.array.shape
        return i, j, k

    @property
    def corners(self) -> Array:
        """(8, 3) indices (i, j, k) of the corner voxels."""
        return np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T * (np.array(self.size) - 1.0)

    @property
    def affine(self) -> Array:
        """(4, 4): index (i, j, k, 1) to LPS mm."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.direction * self.spacing
        matrix[:3, 3] = self.origin
        return matrix

    @property
    def geometry(self) -> tuple[Array, Array, Array]:
        """Spacing, origin and direction, with which other samples of the grid are made."""
        return self.spacing, self.origin, self.direction

    @property
    def voxel_mm3(self) -> float:
        return float(np.prod(self.spacing))

    def index_to_point(self, index: ArrayLike) -> Array:
        """(..., 3) continuous indices (i, j, k) to LPS mm."""
        return np.asarray(index, dtype=float) @ (self.direction * self.spacing).T + self.origin

    def point_to_index(self, point: ArrayLike) -> Array:
        """(..., 3) LPS mm to continuous indices (i, j, k)."""
        return (np.asarray(point, dtype=float) - self.origin) @ (self.direction / self.spacing)

    def compute_heights(self, point: ArrayLike, normal: ArrayLike) -> Array:
        """``[k, j, i]`` distance of each voxel beyond a plane (LPS mm, unit normal), mm."""
        i, j, k = (np.arange(n, dtype=float) for n in self.size)
        steps = (self.direction * self.spacing).T @ np.asarray(normal)
        start = float((self.origin - np.asarray(point)) @ np.asarray(normal))
        return start + k[:, None, None] * steps[2] + j[:, None] * steps[1] + i * steps[0]

    def permute_axes(self, order: Sequence[int]) -> Self:
        """Return the samples with other index axes: ``order[n]`` is the present axis that becomes axis n."""
        axes = tuple(2 - order[2 - n] for n in range(3))
        return replace(
            self,
            array=np.transpose(self.array, axes),
            spacing=self.spacing[list(order)],
            direction=self.direction[:, list(order)],
        )

    def reverse_axes(self, axes: Sequence[int]) -> Self:
        """Return the samples with some index axes (0, 1, 2 for i, j, k) running the other way."""
        last = np.zeros(3)
        last[list(axes)] = [self.size[axis] - 1 for axis in axes]
        direction = self.direction.copy()
        direction[:, list(axes)] *= -1
        array = np.flip(self.array, tuple(2 - axis for axis in axes))
        return replace(self, array=array, origin=self.index_to_point(last), direction=direction)

    def crop(self, box: Sequence[slice]) -> Self:
        """Return the samples in a box of array indices ``[k, j, i]``."""
        start = [part.start for part in box][::-1]
        return replace(self, array=self.array[tuple(box)], origin=self.index_to_point(start))

    def turn_along(self, axis: int) -> Self:
        """Return the samples with the index axis 0, 1, 2 (i, j, k) last: slices lie across it."""
        return self.permute_axes([*(n for n in range(3) if n != axis), axis])

    def align_with_lps(self) -> Self:
        """Return the samples with right-handed index axes in the order and sense nearest to x, y, z.

        What is computed from them then does not depend on how the file stored them.
        """
        best, nearness = np.eye(3), -np.inf
        for order in permutations(range(3)):
            axes = self.direction[:, order]
            signs = np.where(np.diag(axes) < 0, -1.0, 1.0)
            if np.linalg.det(axes * signs) < 0:
                signs[np.argmin(np.abs(np.diag(axes)))] *= -1
            if np.trace(axes * signs) > nearness + 1e-6:
                best, nearness = axes * signs, float(np.trace(axes * signs))
        return self.align_axes(best)

    def move_to_own_frame(self) -> Self:
        """Return the samples with the first voxel at zero and axes along x, y, z; spacing to 1e-5 mm.

        Rounding in files moves voxels by less than that, but remeshing turns it into other triangles.
        """
        return replace(self, spacing=np.round(self.spacing, 5), origin=np.zeros(3), direction=np.eye(3))

    def align_axes(self, axes: Array) -> Self:
        """Return the samples with index axes in the order and sense nearest to the columns of ``axes``."""
        across = np.asarray(axes).T @ self.direction
        order = max(permutations(range(3)), key=lambda p: sum(abs(across[n, p[n]]) for n in range(3)))
        turned = self.permute_axes(order)
        return turned.reverse_axes([n for n in range(3) if across[n, order[n]] < 0])

    def has_same_grid(self, other: Grid) -> bool:
        """True if both sample the same points: every corner voxel lies within 0.01 mm."""
        if self.array.shape != other.array.shape:
            return False
        gap = np.abs(self.index_to_point(self.corners) - other.index_to_point(self.corners))
        return bool(gap.max() <= _SAME_POINT_MM)

    def to_sitk(self) -> sitk.Image:
        """The same image for SimpleITK, geometry included."""
        image = sitk.GetImageFromArray(np.ascontiguousarray(self.array))
        image.SetSpacing(self.spacing.tolist())
        image.SetOrigin(self.origin.tolist())
        image.SetDirection(self.direction.ravel().tolist())
        return image


@dataclass(frozen=True)
class Volume(Grid):
    """A scalar image, ``array`` float32; see :class:`Grid`.

    ``modality`` is DICOM's code where it is known, ``notes`` are what to know of its file, in words.
    """

    modality: str = ""
    notes: tuple[str, ...] = ()

    _dtype: ClassVar = np.float32

    @classmethod
    def from_sitk(cls, image: sitk.Image) -> Volume:
        return cls(sitk.GetArrayFromImage(image), *read_geometry(image))

    def with_array(self, array: NDArray[Any]) -> Volume:
        return replace(self, array=array)


@dataclass(frozen=True)
class LabelMap(Grid):
    """What each voxel is: ``array`` uint8, 0 outside the limb, ``names`` of the other values.

    ``regions`` are the labels that are bodies of soft tissue, not bones: what each is called as a tissue.
    """

    names: Mapping[int, str] = field(default_factory=lambda: dict(DEFAULT_NAMES))
    regions: Mapping[str, str] = field(default_factory=dict)

    def _check(self) -> None:
        super()._check()
        # Other programs name the background, too: as a tissue it would be a bone.
        names = {value: name for value, name in self.names.items() if value != 0}
        object.__setattr__(self, "names", names)
        if len(set(names.values())) < len(names):
            raise LabelError("two labels have the same name", remedy="give them different names")
        raw = self.array
        if raw.dtype != np.uint8:
            if raw.min() < 0 or raw.max() > 255 or np.any(raw != np.round(raw)):
                raise LabelError("labels must be whole numbers from 0 to 255")
            object.__setattr__(self, "array", raw.astype(np.uint8))

    @property
    def limb(self) -> Mask:
        """Everything inside the skin, bones included."""
        return self.array > 0

    @property
    def bone_names(self) -> tuple[str, ...]:
        """Names of the bones that have voxels, in order of their label."""
        present = set(np.unique(self.array).tolist())
        soft = SOFT_NAMES | self.regions.keys()
        return tuple(
            name for value, name in sorted(self.names.items()) if value in present and name not in soft
        )

    def with_regions(self, regions: Mapping[str, str]) -> LabelMap:
        """Return the map with some labels as regions, given by the label of each region's name. Raises
        `LabelError` for a label that has no voxel, is soft tissue as a whole, or is that of two regions.
        """
        if len(set(regions.values())) < len(regions):
            raise LabelError("two regions have one label", place="geometry.regions", remedy="leave one out")
        present = {self.names.get(value) for value in np.unique(self.array).tolist()} - {None}
        for name, label in regions.items():
            if label not in present - SOFT_NAMES:
                have = ", ".join(sorted(map(str, present - SOFT_NAMES))) or "none but soft tissue"
                raise LabelError(
                    f"no voxel is labelled {label!r}",
                    place=f"geometry.regions.{name}",
                    remedy=f"name a label of the map ({have}), or label the region",
                )
        return replace(self, regions={label: name for name, label in regions.items()})

    def value(self, name: str) -> int:
        """The label value of a name."""
        values = {known: value for value, known in self.names.items()}
        if name not in values:
            raise LabelError(f"no label is named {name!r}", remedy="the map has " + ", ".join(sorted(values)))
        return values[name]

    @property
    def soft_value(self) -> int:
        """The label value of soft tissue; of several kinds the lowest, fat and skin last."""
        soft = [value for value, name in sorted(self.names.items()) if name in SOFT_NAMES]
        if not soft:
            raise LabelError("the label map names no soft tissue", remedy=f"name one label {SOFT_TISSUE!r}")
        return min(soft, key=lambda value: (self.names[value] in ("skin", FAT), value))

    def mask(self, name: str) -> Mask:
        """Voxels of one name."""
        return self.array == self.value(name)

    def with_array(self, array: NDArray[Any], names: Mapping[int, str] | None = None) -> LabelMap:
        return replace(self, array=array, names=dict(names or self.names))


def check_voxel_count(size: Sequence[int], path: str | Path) -> None:
    """Raise `ImageError` for an image of more than `MAX_VOXELS`, before it takes the memory."""
    if prod(int(n) for n in size) > MAX_VOXELS:
        shape = " x ".join(str(n) for n in size)
        raise ImageError(
            f"{shape} voxels are more than {MAX_VOXELS:.0e}", file=path, remedy="crop or resample the image"
        )


def resample_cubic(
    image: sitk.Image, grid: Grid, edge_mm: float, interpolator: int, outside: float
) -> sitk.Image:
    """An image on cubic voxels along the axes of its grid; ``outside`` is the value beyond its samples."""
    size = np.maximum(np.floor((np.array(grid.size) - 1) * grid.spacing / edge_mm).astype(int) + 1, 1)
    return sitk.Resample(
        image,
        size.tolist(),
        sitk.Transform(),
        interpolator,
        grid.origin.tolist(),
        [edge_mm] * 3,
        grid.direction.ravel().tolist(),
        outside,
        sitk.sitkFloat32,
    )


def read_geometry(image: sitk.Image) -> tuple[Array, Array, Array]:
    """Spacing, origin and direction of a three-dimensional SimpleITK image."""
    if image.GetDimension() != 3:
        what = f"an image needs three dimensions, this one has {image.GetDimension()}"
        raise ImageError(what, remedy="give one volume of the series")
    direction = np.array(image.GetDirection()).reshape(3, 3)
    return np.array(image.GetSpacing()), np.array(image.GetOrigin()), direction


@dataclass(frozen=True, eq=False)
class Frame:
    """The rigid map between patient space and the limb frame."""

    rotation: Array
    origin: Array

    def to_limb(self, points: Array) -> Array:
        """Patient space (..., 3) to the limb frame."""
        return (np.asarray(points, dtype=float) - self.origin) @ self.rotation.T

    def to_patient(self, points: Array) -> Array:
        """The limb frame (..., 3) to patient space."""
        return points @ self.rotation + self.origin


def build_limb_frame(cut_point: Array, cut_normal: Array) -> Frame:
    """The frame whose z axis is the proximal normal and whose origin is ``cut_point``."""
    z = np.asarray(cut_normal, dtype=float) / np.linalg.norm(cut_normal)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return Frame(np.array([x, np.cross(z, x), z]), np.asarray(cut_point, dtype=float))


def format_place(point: Array, digits: int = 1) -> str:
    """A point (3,) in mm as messages give it."""
    return "(" + ", ".join(f"{x:.{digits}f}" for x in point) + ") mm"


@dataclass(frozen=True)
class ProximalEnd:
    """The proximal end of a limb on its grid.

    ``axis`` is 0, 1, 2 for i, j, k; ``side`` -1 or 1, the sense of that axis that is proximal; ``layer`` the
    last index that holds limb.
    """

    axis: int
    side: int
    layer: int

    def direction(self, grid: Grid) -> Array:
        """(3,) unit vector, proximal, LPS."""
        return self.side * grid.direction[:, self.axis]

    def order_distal_first(self, array: NDArray) -> NDArray:
        """A view of ``[k, j, i]`` whose first axis runs along the limb from distal to proximal."""
        view = np.moveaxis(array, 2 - self.axis, 0)
        return view[::-1] if self.side < 0 else view


def find_longest_axis(limb: Mask, grid: Grid) -> int:
    """The grid axis (0, 1, 2 for i, j, k) along which a mask is longest."""
    extents = [part.stop - part.start for part in find_box(limb)[::-1]]
    return int(np.argmax(extents * grid.spacing))


def find_proximal_end(
    limb: Mask, grid: Grid, axis: int | None = None, normal: Array | None = None
) -> ProximalEnd:
    """Where the limb was cut: at the border of the image that it reaches, else at its thicker end.

    The limb's axis is the grid axis along which it is longest, if it is not given. Of two ends at the
    border, as of an intact leg, the superior one is proximal. A proximal direction, ``normal`` (3,) in LPS,
    decides about both: a short limb may be wider than long, an arm may be held up.
    """
    if not limb.any():
        raise LabelError("the label map is empty", remedy="give one with the limb labelled")
    if normal is not None:
        axis = int(np.abs(normal @ grid.direction).argmax())
    axis = find_longest_axis(limb, grid) if axis is None else axis
    part = find_box(limb)[2 - axis]
    low, high = part.start, part.stop - 1
    ends = [ProximalEnd(axis, -1, low), ProximalEnd(axis, 1, high)]
    if normal is not None:
        return max(ends, key=lambda end: end.direction(grid) @ normal)
    border = [end for end in ends if end.layer in (0, grid.size[axis] - 1)]
    if len(border) == 1:
        return border[0]
    if len(border) == 2:
        return max(border, key=lambda end: end.direction(grid)[2])
    depth = min(3, high - low)
    return max(ends, key=lambda end: int(limb.take(end.layer - depth * end.side, axis=2 - axis).sum()))
