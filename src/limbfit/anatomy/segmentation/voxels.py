"""Closed surfaces as a label map, and what is done to them there: a virtual amputation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkImagingStencil import vtkImageStencilToImage, vtkPolyDataToImageStencil

from ..frame import build_limb_frame
from ..grid import SOFT_TISSUE, Grid, LabelMap
from ..surfaces.surfaces import Anatomy, build_anatomy
from ..surfaces.triangles import Surface
from .amputation import amputate_limb

Mask = NDArray[np.bool_]

VOXEL_MM = 1.0  # as fine as an image of a limb; build_anatomy smooths its steps away
_MARGIN_MM = 4.0  # of empty voxels beside and below the limb


def amputate_anatomy(
    anatomy: Anatomy, plane_point: ArrayLike, plane_normal: ArrayLike, pad_mm: float, edge_mm: float
) -> Anatomy:
    """An anatomy cut at a plane, with a pad over the cut bones; see :func:`amputate_limb`.

    Parameters
    ----------
    anatomy : closed surfaces of a whole limb.
    plane_point, plane_normal : LPS mm; the normal points proximally, to what is kept.
    pad_mm : soft tissue distal of the bones.
    edge_mm : edge length of the new triangles.

    Raises
    ------
    LabelError
        For a plane that misses the limb, lies along it, points distally or cuts no bone off.
    """
    labels = amputate_limb(
        voxelise_anatomy(anatomy, pad_mm + _MARGIN_MM), plane_point, plane_normal, pad_mm=pad_mm
    )
    return build_anatomy(labels, edge_mm, (anatomy.cut_point, anatomy.cut_normal))


def voxelise_anatomy(
    anatomy: Anatomy, distal_mm: float = _MARGIN_MM, spacing_mm: float = VOXEL_MM
) -> LabelMap:
    """The label map of an anatomy: cubic voxels in layers along the cut, the last just distal of it.

    ``distal_mm`` of empty voxels are left beyond the limb's end.
    """
    frame = build_limb_frame(anatomy.cut_point, anatomy.cut_normal)
    points = frame.to_limb(anatomy.skin.points)
    low = points.min(axis=0) - [_MARGIN_MM, _MARGIN_MM, distal_mm]
    high = np.array([*(points.max(axis=0)[:2] + _MARGIN_MM), 0.0])
    size = np.ceil((high - low) / spacing_mm).astype(int)
    corner = np.array([*low[:2], -size[2] * spacing_mm]) + spacing_mm / 2
    empty = np.zeros(size[::-1], dtype=np.uint8)
    grid = Grid(empty, np.full(3, spacing_mm), frame.to_patient(corner), frame.rotation.T)
    inner = {**anatomy.regions, **anatomy.bones}  # bones last: they stay whole where the two overlap
    masks = {name: fill_surface(body, grid) for name, body in inner.items()}
    labels = label_map(grid, fill_surface(anatomy.skin, grid), masks)
    return replace(labels, regions={name: name for name in anatomy.regions})


def label_map(grid: Grid, limb: Mask, bones: Mapping[str, Mask]) -> LabelMap:
    """Labels on a grid: soft tissue where nothing but the limb is, then the bones in their order."""
    array = limb.astype(np.uint8)
    for value, mask in enumerate(bones.values(), start=2):
        array[mask] = value
    names: dict[int, str] = {1: SOFT_TISSUE, **dict(enumerate(bones, start=2))}
    return LabelMap(array, grid.spacing, grid.origin, grid.direction, names)


def fill_surface(surface: Surface, grid: Grid) -> Mask:
    """``[k, j, i]``: which voxels' centres lie inside a closed surface."""
    index = Surface(grid.point_to_index(surface.points), surface.faces)
    stencil = vtkPolyDataToImageStencil()
    stencil.SetInputData(index.to_pyvista())
    stencil.SetOutputSpacing(1.0, 1.0, 1.0)
    stencil.SetOutputOrigin(0.0, 0.0, 0.0)
    stencil.SetOutputWholeExtent(_find_extent(grid.size))
    image = vtkImageStencilToImage()
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetInsideValue(1)
    image.SetOutsideValue(0)
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    values = vtk_to_numpy(image.GetOutput().GetPointData().GetScalars())
    return values.reshape(grid.array.shape).astype(bool)


def _find_extent(size: Sequence[int]) -> tuple[int, int, int, int, int, int]:
    return (0, size[0] - 1, 0, size[1] - 1, 0, size[2] - 1)
