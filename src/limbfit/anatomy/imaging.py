"""Images and label maps in and out, geometry kept.

Images: DICOM folders, NIfTI, NRRD, MetaImage.  Label maps: ``.seg.nrrd``, any label image, DICOM-SEG and
RTSTRUCT.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813

from ..errors import ImageError, LabelError, add_location
from .grid import LabelMap, Volume
from .images.dicom import read_series
from .images.formats import describe_forms, format_of, read_image
from .labels import labelfiles
from .labels.labelcheck import place_on_grid

_SMALLEST_MM, _LARGEST_MM = 60.0, 3000.0  # of the longest side of an image


def read_volume(path: str | Path, series_uid: str | None = None) -> Volume:
    """An image with its full geometry, from a DICOM folder or one file of a format in `images.formats`.

    ``series_uid`` says which DICOM series, where the folder holds several. Raises `ImageError` with the file,
    the place and the remedy.
    """
    path = Path(path)
    if path.is_dir():
        volume = read_series(path, series_uid)
    else:
        image = read_image(path)
        if image.GetNumberOfComponentsPerPixel() != 1:
            raise ImageError("an image needs one grey value per voxel", file=path)
        with add_location(file=path):
            volume = Volume.from_sitk(image)
        if format_of(path).name == "NIfTI":
            volume = replace(volume, notes=describe_forms(path, volume.affine))
    if not np.all(np.isfinite(volume.array)):
        bad = int((~np.isfinite(volume.array)).sum())
        raise ImageError(f"{bad} voxels are not numbers", file=path, remedy="export the image again")
    return volume


def write_volume(path: str | Path, volume: Volume) -> None:
    """Write .nii(.gz), .nrrd, .mha or .mhd by the suffix, compressed where the format can."""
    format_of(Path(path), written=True)
    sitk.WriteImage(volume.to_sitk(), str(path), useCompression=True)


def check_image(volume: Volume, path: str | Path) -> None:
    """Raise `ImageError` for an image that cannot show a limb: of one grey value, or of another unit's
    size."""
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

    Raises `LabelError` also for a map whose voxels are not those of ``like``, and for one without a single
    labelled voxel.

    Parameters
    ----------
    path : the file, or a folder with one DICOM-SEG or RTSTRUCT; a plain image may have its names in
        ``<file>.json``.
    like : the image that it belongs to: the map is brought to its grid, voxel by voxel. Contours need it.
    """
    path = Path(path)
    try:
        dicom = labelfiles.find_dicom_labels(path)
        if dicom is not None:
            with add_location(file=dicom):
                labels = labelfiles.read_dicom_labels(dicom, like)
        elif labelfiles.is_seg_nrrd(path):
            labels = labelfiles.read_seg_nrrd(read_image(path))
        else:
            labels = labelfiles.read_label_image(path, read_image(path))
        if not labels.array.any():
            raise LabelError("the label map is empty", remedy="give one with the limb labelled")
        return labels if like is None else place_on_grid(labels, like)
    except (ImageError, LabelError) as error:  # of a label map an image's error is one of labels
        file = error.file or path
        raise LabelError(error.what, file=file, place=error.place, remedy=error.remedy) from None


def write_labels(path: str | Path, labels: LabelMap) -> None:
    """Write ``.seg.nrrd`` with names and colours, or a plain image with its names in ``<file>.json``."""
    path = Path(path)
    if labelfiles.is_seg_nrrd(path):
        labelfiles.write_seg_nrrd(path, labels)
        return
    format_of(path, written=True)
    sitk.WriteImage(labels.to_sitk(), str(path), useCompression=True)
    names = json.dumps({str(value): name for value, name in sorted(labels.names.items())}, indent=2)
    labelfiles.find_sidecar(path).write_text(names + "\n", encoding="utf-8")
