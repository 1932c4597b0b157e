"""Image files by their suffix: how each format is read, and what it must say of its place in the patient.

Your own format is registered by `register_image_format`; see docs/extending.md.

A NIfTI file is checked here, because ITK leaves what is missing of a file that is cut short as it was in
memory, makes voxels that are not numbers zero, and takes one of the qform and the sform without a word.
"""

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
import SimpleITK as sitk  # noqa: N813
from scipy.spatial.transform import Rotation

from ...arrays import Array
from ...errors import ImageError, InputError
from ...extensions import Registry
from ..grid import check_voxel_count
from .dicom import mute_libraries

Read = Callable[[Path], sitk.Image]
# What is read of the header of NIfTI-1: names, types and offsets in bytes.
_NAMES = ("length", "dim", "datatype", "bitpix", "pixdim", "vox_offset", "units", "codes", "qform", "sform")
_TYPES = ("i4", "8i2", "i2", "i2", "8f4", "f4", "u1", "2i2", "6f4", "12f4")
_OFFSETS = (0, 40, 70, 72, 76, 108, 123, 252, 256, 280)
_HEADER = np.dtype({"names": _NAMES, "formats": _TYPES, "offsets": _OFFSETS, "itemsize": 348})
_CHUNK = 1 << 22
_FLOATS: dict[int, np.dtype[np.floating]] = {16: np.dtype("f4"), 64: np.dtype("f8")}  # codes of datatype
# Codes of NIfTI and spaces of NRRD that say nothing of the patient; ITK takes such a space for LPS.
_PLACELESS = {"", "0", "scanner-xyz", "3D-right-handed", "3D-left-handed"}
_SAME_VOXELS = 0.5  # within which two statements of a voxel's place are one
_UNITS_MM = {1: 1000.0, 2: 1.0, 3: 1e-3}  # by the code of the unit of length


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


def _read_itk(path: Path, place_keys: tuple[str, ...] = (), by: str = "") -> sitk.Image:
    """An image by ITK, whose header has one of some keys with a value, or its place would be a guess."""
    reader = sitk.ImageFileReader()
    reader.SetImageIO(by)  # a format whose suffixes ITK knows in small letters only
    reader.SetFileName(str(path))
    try:
        with mute_libraries():
            reader.ReadImageInformation()
            check_voxel_count(reader.GetSize(), path)
            image = reader.Execute()
    except RuntimeError as error:
        if "orthonormal" in str(error) or "Bad direction" in str(error):
            remedy = "resample the image to a rectangular grid"
            raise ImageError("the image axes are not orthonormal", file=path, remedy=remedy) from None
        mixed = path.name.lower().endswith(".nii.gz") and not path.name.endswith((".nii.gz", ".NII.GZ"))
        remedy = "rename it to end in .nii.gz" if mixed else "check that the file is whole"
        raise ImageError("the image cannot be read", file=path, remedy=remedy) from None
    values = [reader.GetMetaData(key).strip() for key in place_keys if reader.HasMetaDataKey(key)]
    if place_keys and set(values) <= _PLACELESS:
        raise ImageError(
            "the file does not say how it lies in the patient",
            file=path,
            remedy="export it with its orientation",
        )
    return image


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
        Where the name or a suffix is taken, or a suffix is none.
    """
    if isinstance(suffixes, str) or not all(one.startswith(".") and one == one.lower() for one in suffixes):
        raise InputError(f"{suffixes!r} are no suffixes", place=name, remedy='give such as (".npz",)')
    for known in IMAGE_FORMATS:
        taken = sorted(set(known.suffixes) & set(suffixes))
        if taken and known.name != name:
            raise InputError(f"images {taken[0]} are {known.name} already", place=name, remedy="rename them")
    IMAGE_FORMATS.add(name, ImageFormat(name, tuple(suffixes), read))


def format_of(path: Path, written: bool = False) -> ImageFormat:
    """The format of an image file by its name; ``written``: of those that can be written. Raises `ImageError`
    for a suffix that no format has.
    """
    formats = [known for known in IMAGE_FORMATS if known.is_written or not written]
    for known in formats:
        if path.name.lower().endswith(known.suffixes):
            return known
    suffixes = " ".join(suffix for known in formats for suffix in known.suffixes)
    raise ImageError(f"unknown kind of image {path.suffix!r}", file=path, remedy=f"use one of {suffixes}")


def read_image(path: Path) -> sitk.Image:
    """The image of a file. Raises `ImageError` where there is none, or it cannot be read."""
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
    check_voxel_count(image.GetSize(), path)
    return image


def _read_nifti(path: Path) -> sitk.Image:
    """An image by ITK. Raises `ImageError` for a NIfTI file that is cut short, holds voxels that are not
    numbers, or whose two statements of its place differ in left and right."""
    try:
        with _open(path) as stream:
            header = _read_header(stream)
            length, bad = _count_bytes_and_nans(stream, header)
        dim = header["dim"].astype(float)
        count = np.prod(dim[1 : 1 + max(int(dim[0]), 0)])
        whole = length >= header["vox_offset"] + count * header["bitpix"] / 8
    except (OSError, EOFError, zlib.error, ValueError, OverflowError):
        whole, bad = False, 0
    if not whole:
        raise ImageError(
            "the image is cut short, damaged or NIfTI-2", file=path, remedy="export it as NIfTI-1"
        )
    if bad:
        raise ImageError(f"{bad} voxels are not numbers", file=path, remedy="export the image again")
    forms = _read_forms(path)
    if forms is not None and np.prod([np.linalg.det(form[:3, :3]) for form in forms[:2]]) < 0.0:
        raise ImageError(
            "the qform and the sform mirror each other: left in one is right in the other",
            file=path,
            remedy="convert the image again from its DICOM files, or set the code of the wrong one to 0",
        )
    return _read_itk(path, ("qform_code", "sform_code"))


def describe_forms(path: Path, affine: Array) -> tuple[str, ...]:
    """Say which of a file's qform and sform an image lies by, where they differ.

    ``affine`` (4, 4) is that of the image that was read, from indices to LPS mm.
    """
    forms = _read_forms(path)
    if forms is None:
        return ()
    qform, sform, size = forms
    corners = np.stack(np.meshgrid(*np.column_stack([np.zeros(3), size - 1]), [1.0]), -1).reshape(-1, 4)
    apart = float(np.linalg.norm(corners @ (qform - sform).T, axis=1).max())
    if apart <= _SAME_VOXELS * np.linalg.norm(affine[:3, :3], axis=0).min():
        return ()
    here = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    is_qform = np.abs(here - qform).max() <= np.abs(here - sform).max()
    used, other = ("qform", "sform") if is_qform else ("sform", "qform")
    return (
        f"its qform and sform differ by up to {apart:.1f} mm; the {used} is used: where sites or labels are "
        f"off by that, set the {used}'s code to 0, and the {other} is",
    )


def _read_forms(path: Path) -> tuple[Array, Array, Array] | None:
    """The qform and the sform of a file, affine matrices (4, 4) from indices to RAS mm, and the size (3,) of
    its image; None where it does not state both."""
    with _open(path) as stream:
        header = _read_header(stream)
    pixdim, place, rows = (header[name].astype(float) for name in ("pixdim", "qform", "sform"))
    if not header["codes"].all() or not np.isfinite(np.concatenate([pixdim, place, rows])).all():
        return None
    b, c, d = place[:3]
    turn = Rotation.from_quat([b, c, d, np.sqrt(max(0.0, 1.0 - b * b - c * c - d * d))]).as_matrix()
    qform, sform = np.eye(4), np.vstack([rows.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    qform[:3, :3] = turn * pixdim[1:4] * [1.0, 1.0, -1.0 if pixdim[0] < 0.0 else 1.0]
    qform[:3, 3] = place[3:]
    scale = np.diag([*[_UNITS_MM.get(int(header["units"]) & 7, 1.0)] * 3, 1.0])
    return scale @ qform, scale @ sform, header["dim"][1:4].astype(float)


def _open(path: Path) -> IO[bytes] | gzip.GzipFile:
    return gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb")


def _read_header(stream: IO[bytes] | gzip.GzipFile) -> np.void:
    """The header of a NIfTI-1 file, in either order of bytes; `ValueError` for anything else."""
    data = stream.read(_HEADER.itemsize)
    for kind in (_HEADER, _HEADER.newbyteorder()):
        header = np.frombuffer(data, kind, count=1)[0]
        if header["length"] == _HEADER.itemsize:
            return header
    raise ValueError("NIfTI-2, or not NIfTI at all")


def _count_bytes_and_nans(stream: IO[bytes] | gzip.GzipFile, header: np.void) -> tuple[int, int]:
    """Length of the file in bytes, and how many of its voxels are not numbers."""
    length, bad = _HEADER.itemsize, 0
    kind = _FLOATS.get(int(header["datatype"]))
    length += len(stream.read(max(int(header["vox_offset"]), length) - length))
    while chunk := stream.read(_CHUNK):
        length += len(chunk)
        if kind is not None:
            values = np.frombuffer(chunk[: len(chunk) - len(chunk) % kind.itemsize], kind)
            if not header["length"].dtype.isnative:
                values = values.byteswap()
            bad += int((~np.isfinite(values)).sum())
    return length, bad


_BUILTIN = (
    ImageFormat("NIfTI", (".nii", ".nii.gz"), _read_nifti, is_written=True),
    ImageFormat("NRRD", (".nrrd", ".nhdr"), partial(_read_itk, place_keys=("NRRD_space",)), is_written=True),
    ImageFormat("MetaImage", (".mha", ".mhd"), partial(_read_itk, by="MetaImageIO"), is_written=True),
)
IMAGE_FORMATS = Registry("image format", {known.name: known for known in _BUILTIN})
