"""Ways to damage an Enhanced MR file, which holds a whole series in its frames."""

from pathlib import Path

import numpy as np
import pydicom
from damage import Inputs, Whole, kind
from damage_dicom import SERIES, Random, cut, decimals
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence
from pydicom.uid import EnhancedMRImageStorage

_OF_FRAMES = (
    "PixelSpacing",
    "SliceThickness",
    "SpacingBetweenSlices",
    "SliceLocation",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "RescaleSlope",
    "RescaleIntercept",
)


def write_enhanced(folder: Path, whole: Whole, order: list[int], **changes: object) -> Path:
    """The series as one Enhanced MR file whose frames are the slices in the given order."""
    first = pydicom.dcmread(sorted(whole.series.iterdir())[0])
    data = first
    data.SOPClassUID = data.file_meta.MediaStorageSOPClassUID = EnhancedMRImageStorage
    spacing, thickness = list(first.PixelSpacing), first.SliceThickness
    axes = list(first.ImageOrientationPatient)
    for tag in _OF_FRAMES:
        data.pop(tag, None)
    measures, plane, values, shared = Dataset(), Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness, measures.SpacingBetweenSlices = (
        spacing, thickness, thickness,
    )  # fmt: skip
    plane.ImageOrientationPatient = axes
    values.RescaleSlope, values.RescaleIntercept = "0.5", "0"
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = Sequence([measures]), Sequence([plane])
    shared.PixelValueTransformationSequence = Sequence([values])
    data.SharedFunctionalGroupsSequence = Sequence([shared])
    frames = []
    for k in order:
        frame, place = Dataset(), Dataset()
        place.ImagePositionPatient = decimals(whole.image.index_to_point([0, 0, k]))
        frame.PlanePositionSequence = Sequence([place])
        frames.append(frame)
    data.PerFrameFunctionalGroupsSequence = Sequence(frames)
    data.NumberOfFrames = len(order)
    data.PixelData = np.rint(whole.image.array[order] / 0.5).astype(np.uint16).tobytes()
    for tag, value in changes.items():
        setattr(data, tag, value)
    (folder / "mri").mkdir()
    data.save_as(folder / "mri" / "frames")
    return folder / "mri" / "frames"


@kind("dicom", "same")
def enhanced_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_enhanced(folder, whole, random.permutation(whole.image.size[2]).tolist())
    return SERIES


@kind("dicom", "refused", "missing")
def enhanced_frame_missing(random: Random, whole: Whole, folder: Path) -> Inputs:
    order = list(range(whole.image.size[2]))
    del order[random.integers(2, len(order) - 2)]
    write_enhanced(folder, whole, order)
    return SERIES


@kind("dicom", "refused", "same place")
def enhanced_frame_doubled(random: Random, whole: Whole, folder: Path) -> Inputs:
    order = list(range(whole.image.size[2]))
    write_enhanced(folder, whole, [*order, int(random.choice(order))])
    return SERIES


@kind("dicom", "refused")
def enhanced_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    cut(write_enhanced(folder, whole, list(range(whole.image.size[2]))), 0.001, 0.98, random)
    return SERIES


@kind("dicom", "refused", "where each of its frames lies")
def enhanced_count_wrong(random: Random, whole: Whole, folder: Path) -> Inputs:
    size = whole.image.size[2]
    wrong = int(size - random.integers(1, 10))
    write_enhanced(folder, whole, list(range(size)), NumberOfFrames=wrong)
    return SERIES
