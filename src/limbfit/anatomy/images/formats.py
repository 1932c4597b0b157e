"""Image files by their suffix: how each format is read, and what it must say of its place in the patient.

Your own format is registered by `register_image_format`; see docs/extending.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import SimpleITK as sitk  # noqa: N813

from ...errors import ImageError, InputError
from ...extensions import Registry
from ..bounds import check_voxels
from .dicom_pixels import mute_libraries
from .nifti import check_nifti

Read = Callable[[Path], sitk.Image]


@dataclass(frozen=True)
class ImageFormat:
    """A kind of image file.

    Parameters
    ----------
    name : what it is called.
    suffixes : of its files, lower case, with their dots.
    read : makes an image of such a file, its geometry in LPS mm.
    is_written : SimpleITK writes it too.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Read
    is_written: bool = False


def _read_itk(path: Path, is_placed: Callable[[sitk.ImageFileReader], bool] = lambda _: True) -> sitk.Image:
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        with mute_libraries():
            reader.ReadImageInformation()
            check_voxels(reader.GetSize(), path)
            image = reader.Execute()
    except RuntimeError as error:
        raise _build_reading_error(path, str(error)) from None
    if not is_placed(reader):  # its place in the patient would be a guess
        raise ImageError(
            "the file does not say how it lies in the patient",
            file=path,
            remedy="export it with its orientation",
        )
    return image


def _build_reading_error(path: Path, text: str) -> ImageError:
    if "orthonormal" in text or "Bad direction" in text:
        return ImageError(
            "the image axes are not orthonormal",
            file=path,
            remedy="resample the image to a rectangular grid",
        )
    return ImageError("the image cannot be read", file=path, remedy="check that the file is whole")


def _read_nifti(path: Path) -> sitk.Image:
    check_nifti(path)
    return _read_itk(path, _has_form)


def _has_form(reader: sitk.ImageFileReader) -> bool:
    keys = set(reader.GetMetaDataKeys()) & {"qform_code", "sform_code"}
    return any(reader.GetMetaData(key).strip() not in ("", "0") for key in keys)


def _read_nrrd(path: Path) -> sitk.Image:
    return _read_itk(path, lambda reader: "NRRD_space" in reader.GetMetaDataKeys())


_OWN = (
    ImageFormat("NIfTI", (".nii", ".nii.gz"), _read_nifti, is_written=True),
    ImageFormat("NRRD", (".nrrd", ".nhdr"), _read_nrrd, is_written=True),
    ImageFormat("MetaImage", (".mha", ".mhd"), _read_itk, is_written=True),
)
IMAGE_FORMATS = Registry("image format", {one.name: one for one in _OWN})


def register_image_format(name: str, suffixes: tuple[str, ...], read: Read) -> None:
    """Make files of some suffixes readable, in the file that a study names in ``study.extensions``.

    Parameters
    ----------
    name : of the format.
    suffixes : lower case, with their dots.
    read : makes a `SimpleITK.Image` of a path, its geometry in LPS mm; it may raise anything.

    Raises
    ------
    InputError
        Where the name or a suffix is taken.
    """
    for one in IMAGE_FORMATS:
        taken = sorted(set(one.suffixes) & set(suffixes))
        if taken and one.name != name:
            raise InputError(f"images {taken[0]} are {one.name} already", place=name, remedy="rename them")
    IMAGE_FORMATS.add(name, ImageFormat(name, suffixes, read))


def format_of(path: Path, written: bool = False) -> ImageFormat:
    """The format of an image file by its name; ``written``: of those that can be written.

    Raises
    ------
    ImageError
        For a suffix that no format has.
    """
    known = [one for one in IMAGE_FORMATS if one.is_written or not written]
    for one in known:
        if path.name.lower().endswith(one.suffixes):
            return one
    suffixes = " ".join(suffix for one in known for suffix in one.suffixes)
    raise ImageError(f"unknown kind of image {path.suffix!r}", file=path, remedy=f"use one of {suffixes}")


def read_image(path: Path) -> sitk.Image:
    """The image of a file.

    Raises
    ------
    ImageError
        Where there is none, or it cannot be read.
    """
    if not path.is_file():
        raise ImageError("no such image", file=path, remedy="give a DICOM folder or an image file")
    form = format_of(path)
    try:
        image = form.read(path)
    except InputError:
        raise
    except Exception as error:
        what = f"not readable as {form.name}: {type(error).__name__}: {error}"
        raise ImageError(what, file=path, remedy="check that the file is whole") from error
    check_voxels(image.GetSize(), path)
    return image
