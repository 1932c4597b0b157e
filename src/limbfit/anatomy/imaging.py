"""Images and label maps in and out, geometry kept.

Images: DICOM folders, NIfTI, NRRD, MetaImage.  Label maps: ``.seg.nrrd``, any label image, DICOM-SEG and
RTSTRUCT.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813

from ..errors import ImageError, LabelError
from .bounds import check_voxels
from .grid import BONES, DEFAULT_NAMES, SOFT_TISSUE, LabelMap, Volume
from .images.dicom import Series, describe_series, list_series, read_series
from .images.dicom_pixels import muted
from .images.nifti import check_nifti
from .labels.dicom_labels import find_dicom_labels, read_dicom_labels
from .labels.labelcheck import cleaned
from .labels.labelfiles import (
    is_seg_nrrd,
    read_label_image,
    read_seg_nrrd,
    write_seg_nrrd,
    write_sidecar,
    wrong_file,
)
from .labels.placement import on_grid_of

__all__ = [
    "BONES",
    "DEFAULT_NAMES",
    "SOFT_TISSUE",
    "LabelMap",
    "Series",
    "Volume",
    "check_image",
    "cleaned",
    "describe_series",
    "list_series",
    "read_labels",
    "read_volume",
    "write_labels",
    "write_volume",
]

_SMALLEST_MM, _LARGEST_MM = 60.0, 3000.0  # of the longest side of an image
SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")


def read_volume(path: str | Path, series_uid: str | None = None) -> Volume:
    """An image with its full geometry.

    Parameters
    ----------
    path : a DICOM folder, or one file: .nii, .nii.gz, .nrrd, .nhdr, .mha or .mhd.
    series_uid : which DICOM series, where the folder holds several.

    Raises
    ------
    ImageError
        With the file, the place and the remedy.
    """
    path = Path(path)
    if path.is_dir():
        volume = read_series(path, series_uid)
    else:
        volume = _as_volume(_read_image(path), path)
    if not np.all(np.isfinite(volume.array)):
        bad = int((~np.isfinite(volume.array)).sum())
        raise ImageError(f"{bad} voxels are not numbers", file=path, remedy="export the image again")
    return volume


def write_volume(path: str | Path, volume: Volume) -> None:
    """Write .nii(.gz), .nrrd, .mha or .mhd by the suffix, compressed where the format can."""
    _check_suffix(Path(path))
    sitk.WriteImage(volume.to_sitk(), str(path), useCompression=True)


def check_image(volume: Volume, path: str | Path) -> None:
    """Refuse an image that cannot show a limb: one grey value, or of a size that only another unit explains.

    Raises
    ------
    ImageError
    """
    if volume.array.min() == volume.array.max():
        raise ImageError("the image is constant", file=path, remedy="check the series, export it again")
    extent = float((np.array(volume.size) * volume.spacing).max())
    if not _SMALLEST_MM <= extent <= _LARGEST_MM:
        raise ImageError(
            f"the image is {extent:.3g} mm long, which is no limb's size",
            file=path,
            remedy="its voxel spacing must be in millimetres",
        )


def read_labels(path: str | Path, like: Volume | None = None) -> LabelMap:
    """A label map: ``.seg.nrrd``, DICOM-SEG, RTSTRUCT, or a label image with default or sidecar names.

    Parameters
    ----------
    path : the file, or a folder with one DICOM-SEG or RTSTRUCT; a plain image may have its names in
        ``<file>.json``.
    like : the image that it belongs to: the map is brought to its grid, voxel by voxel. Contours need it.

    Raises
    ------
    LabelError
        Also for a map whose voxels are not those of ``like``, and for one without a single labelled voxel.
    """
    path = Path(path)
    dicom = find_dicom_labels(path)
    if dicom is not None:
        labels = read_dicom_labels(dicom, like)
    elif is_seg_nrrd(path) and path.is_file():
        labels = read_seg_nrrd(path)
    else:
        labels = _read_label_file(path)
    if not labels.array.any():
        raise LabelError("the label map is empty", file=path, remedy="give one with the limb labelled")
    return labels if like is None else on_grid_of(labels, like, path)


def write_labels(path: str | Path, labels: LabelMap) -> None:
    """Write ``.seg.nrrd`` with names and colours, or a plain image with its names in ``<file>.json``."""
    path = Path(path)
    if is_seg_nrrd(path):
        write_seg_nrrd(path, labels)
        return
    _check_suffix(path)
    sitk.WriteImage(labels.to_sitk(), str(path), useCompression=True)
    write_sidecar(path, labels.names)


def _read_label_file(path: Path) -> LabelMap:
    try:
        image = _read_image(path)
        return read_label_image(path, image)
    except ImageError as error:
        raise wrong_file(error, path) from None


def _check_suffix(path: Path) -> None:
    if not path.name.lower().endswith(SUFFIXES):
        raise ImageError(
            f"unknown kind of image {path.suffix!r}", file=path, remedy="use one of " + " ".join(SUFFIXES)
        )


def _read_image(path: Path) -> sitk.Image:
    if not path.is_file():
        raise ImageError("no such image", file=path, remedy="give a DICOM folder or an image file")
    _check_suffix(path)
    if path.name.lower().endswith((".nii", ".nii.gz")):
        check_nifti(path)
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        with muted():
            reader.ReadImageInformation()
            check_voxels(reader.GetSize(), path)
            image = reader.Execute()
    except RuntimeError as error:
        raise _unreadable(path, str(error)) from None
    _check_stated_geometry(reader, path)
    return image


def _unreadable(path: Path, text: str) -> ImageError:
    if "orthonormal" in text or "Bad direction" in text:
        return ImageError(
            "the image axes are not orthonormal",
            file=path,
            remedy="resample the image to a rectangular grid",
        )
    return ImageError("the image cannot be read", file=path, remedy="check that the file is whole")


def _check_stated_geometry(reader: sitk.ImageFileReader, path: Path) -> None:
    """Refuse a file that leaves its place in the patient to be guessed."""
    keys = set(reader.GetMetaDataKeys())
    name = path.name.lower()
    if name.endswith((".nii", ".nii.gz")):
        codes = [reader.GetMetaData(key).strip() for key in ("qform_code", "sform_code") if key in keys]
        stated = any(code not in ("", "0") for code in codes)
    elif name.endswith((".nrrd", ".nhdr")):
        stated = "NRRD_space" in keys
    else:
        stated = True
    if not stated:
        raise ImageError(
            "the file does not say how it lies in the patient",
            file=path,
            remedy="export it with its orientation",
        )


def _as_volume(image: sitk.Image, path: Path) -> Volume:
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise ImageError("an image needs one grey value per voxel", file=path)
    try:
        return Volume.from_sitk(image)
    except ImageError as error:
        raise ImageError(error.what, file=path, remedy=error.remedy) from None
