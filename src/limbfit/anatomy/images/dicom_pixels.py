"""The voxels of DICOM slices: single images by GDCM, frames of enhanced files by pydicom."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pydicom
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray
from pydicom.uid import UID

from ...errors import ImageError
from .dicom_headers import SliceHeader, silence_readers


def read_pixels(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    """``[k, j, i]`` rescaled grey values of slices in their order.

    Raises
    ------
    ImageError
        For pixels that are cut short, cannot be decoded or do not match the headers.
    """
    with silence_readers():
        try:
            array = _read_files(slices) if slices[0].frame is None else _read_frames(slices)
        except ImageError:
            raise
        except Exception:  # its text may hold file names and tag values
            raise _build_decoding_error({one.syntax for one in slices}) from None
    if array.shape != (len(slices), slices[0].rows, slices[0].columns):
        raise ImageError("the pixels do not match the headers", remedy="export the series again")
    return array


def _read_files(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    """GDCM applies each image's own slope and intercept."""
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames([str(one.path) for one in slices])
    reader.SetOutputPixelType(sitk.sitkFloat32)
    with mute_libraries():
        return sitk.GetArrayFromImage(reader.Execute())


@contextmanager
def mute_libraries() -> Iterator[None]:
    """Keep the C libraries below ITK from writing to the terminal, which they do past every setting."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [(stream, os.dup(stream)) for stream in (1, 2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream, _ in kept:
            os.dup2(nowhere, stream)
        yield
    finally:
        for stream, copy in kept:
            os.dup2(copy, stream)
            os.close(copy)
        os.close(nowhere)


def _read_frames(slices: Sequence[SliceHeader]) -> NDArray[np.float32]:
    files = {one.path: pydicom.dcmread(one.path).pixel_array for one in slices}
    planes = []
    for one in slices:
        stored = files[one.path]
        plane = stored if stored.ndim == 2 else stored[one.frame]
        slope, intercept = one.rescale
        planes.append(plane.astype(np.float32) * np.float32(slope) + np.float32(intercept))
    return np.stack(planes)


def _build_decoding_error(syntaxes: set[str]) -> ImageError:
    """What is wrong with pixels that no decoder took."""
    names = sorted(UID(text).name for text in syntaxes if _is_compressed(UID(text)))
    if names:
        return ImageError(
            f"the pixels, compressed as {', '.join(names)}, cannot be decoded",
            remedy="export the series again, uncompressed",
        )
    return ImageError("the pixels are cut short or cannot be decoded", remedy="export the series again")


def _is_compressed(uid: UID) -> bool:
    return uid.is_valid and not uid.is_private and uid.is_transfer_syntax and uid.is_compressed
