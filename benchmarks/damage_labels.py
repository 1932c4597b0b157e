"""Ways to damage label maps: ``.seg.nrrd``, label images, DICOM-SEG and RTSTRUCT."""

from dataclasses import replace
from pathlib import Path

import contourpy
import numpy as np
import pydicom
from damage import Inputs, Whole, kind
from pydicom.dataset import Dataset, FileDataset, FileMetaDataset
from pydicom.pixels import pack_bits
from pydicom.sequence import Sequence
from pydicom.uid import ExplicitVRLittleEndian, generate_uid
from scipy.ndimage import binary_dilation, binary_erosion

from limbfit.anatomy.imaging import LabelMap, write_labels, write_volume

Random = np.random.Generator
SUFFIXES = (".seg.nrrd", ".nii.gz", ".nrrd", ".mha")
SEGMENTATION, STRUCTURES = "1.2.840.10008.5.1.4.1.1.66.4", "1.2.840.10008.5.1.4.1.1.481.3"


def given(folder: Path, whole: Whole, name: str) -> Inputs:
    """The whole image with a label map that lies in the folder already."""
    (folder / "mri").symlink_to(whole.series)
    return Inputs(image="mri", labels=name)


def written(random: Random, whole: Whole, folder: Path, labels: LabelMap) -> Inputs:
    name = f"labels{random.choice(SUFFIXES)}"
    write_labels(folder / name, labels)
    return given(folder, whole, name)


def editable(whole: Whole) -> np.ndarray:
    return whole.labels.array.copy()


def spot(random: Random, mask: np.ndarray, radius: int) -> tuple[slice, ...]:
    """A small box around a voxel of a mask."""
    centre = random.choice(np.argwhere(mask))
    return tuple(slice(max(int(c) - radius, 0), int(c) + radius + 1) for c in centre)


@kind("labels", "same")
def labels_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    return written(random, whole, folder, whole.labels)


@kind("labels", "refused", "empty")
def labels_empty(random: Random, whole: Whole, folder: Path) -> Inputs:
    return written(random, whole, folder, whole.labels.with_array(np.zeros_like(whole.labels.array)))


@kind("labels", "repaired", "apart from the limb")
def limb_islands(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    for _ in range(random.integers(1, 6)):
        corner = [random.integers(0, 4), random.integers(0, 4), random.integers(0, 4)]
        place = [c if random.random() < 0.5 else n - 1 - c for c, n in zip(corner, array.shape)]
        place[0] = int(random.integers(0, array.shape[0]))
        array[tuple(place)] = random.choice([1, 2])
    return written(random, whole, folder, whole.labels.with_array(array))


def soft_inside(array: np.ndarray) -> np.ndarray:
    """Soft tissue (label 1) well away from the skin and from everything else."""
    return np.asarray(binary_erosion(array > 0, iterations=3) & ~binary_dilation(array > 1, iterations=3))


@kind("labels", "repaired", "became soft tissue")
def bone_islands(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    inner = soft_inside(array)
    for _ in range(random.integers(1, 4)):
        array[spot(random, inner, 1)] = random.choice([2, 3, 4, 5])
    return written(random, whole, folder, whole.labels.with_array(array))


@kind("labels", "repaired", "inside the limb")
def limb_holes(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    inner = soft_inside(array)
    for _ in range(random.integers(1, 6)):
        array[spot(random, inner, 1)] = 0
    return written(random, whole, folder, whole.labels.with_array(array))


@kind("labels", "refused", "a different grid")
def labels_shifted(random: Random, whole: Whole, folder: Path) -> Inputs:
    shift = random.uniform(0.1, 0.9, 3)
    moved = replace(whole.labels, origin=whole.labels.index_to_point(shift))
    return written(random, whole, folder, moved)


@kind("labels", "refused", "a different grid")
def labels_stretched(random: Random, whole: Whole, folder: Path) -> Inputs:
    stretched = replace(whole.labels, spacing=whole.labels.spacing * random.uniform(1.01, 1.5))
    return written(random, whole, folder, stretched)


@kind("labels", "refused", "outside the image")
def labels_outside(random: Random, whole: Whole, folder: Path) -> Inputs:
    step = np.zeros(3)
    step[2] = random.integers(1, 30) * random.choice([-1, 1])
    grown = np.pad(whole.labels.array, [(40, 40), (0, 0), (0, 0)], mode="edge")
    moved = replace(whole.labels, array=grown, origin=whole.labels.index_to_point(step - [0, 0, 40]))
    return written(random, whole, folder, moved)


@kind("labels", "same")
def labels_padded(random: Random, whole: Whole, folder: Path) -> Inputs:
    n = int(random.integers(1, 8))
    grown = np.pad(whole.labels.array, n)
    moved = replace(whole.labels, array=grown, origin=whole.labels.index_to_point([-n, -n, -n]))
    return written(random, whole, folder, moved)


@kind("labels", "same")
def labels_cropped(random: Random, whole: Whole, folder: Path) -> Inputs:
    low = [int(np.argwhere(whole.labels.array > 0)[:, axis].min()) for axis in range(3)]
    high = [int(np.argwhere(whole.labels.array > 0)[:, axis].max()) + 1 for axis in range(3)]
    crop = whole.labels.array[tuple(slice(a, b) for a, b in zip(low, high))]
    cropped = replace(whole.labels, array=crop, origin=whole.labels.index_to_point(low[::-1]))
    return written(random, whole, folder, cropped)


@kind("labels", "same")
def labels_turned(random: Random, whole: Whole, folder: Path) -> Inputs:
    turned = whole.labels.permute_axes(random.permutation(3).tolist())
    return written(
        random, whole, folder, turned.reverse_axes(np.flatnonzero(random.random(3) < 0.5).tolist())
    )


@kind("labels", "refused", "two limbs")
def labels_of_two_limbs(random: Random, whole: Whole, folder: Path) -> Inputs:
    size = 2 * whole.labels.size[0] + 2
    array = np.zeros((*whole.labels.array.shape[:2], size), np.uint8)
    array[..., : whole.labels.size[0]] = whole.labels.array
    array[..., -whole.labels.size[0] :] = whole.labels.array[..., ::-1]
    image = replace(whole.image, array=array.astype(np.float32) * 100)
    write_volume(folder / "image.nrrd", image)
    inputs = written(random, whole, folder, replace(whole.labels, array=array))
    return replace(inputs, image="image.nrrd")


@kind("labels", "refused", "without a name")
def nameless_value(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    array[array == 2] = random.integers(9, 250)
    write_volume(folder / "labels.nii.gz", whole.image.with_array(array.astype(np.float32)))
    return given(folder, whole, "labels.nii.gz")


@kind("labels", "refused", "whole numbers")
def labels_with_fractions(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole).astype(np.float32) * random.uniform(0.3, 0.9)
    write_volume(folder / "labels.nrrd", whole.image.with_array(array))
    return given(folder, whole, "labels.nrrd")


@kind("labels", "refused", "soft tissue")
def bones_only(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    array[~np.isin(array, [whole.labels.value(name) for name in whole.labels.bone_names])] = 0
    return written(random, whole, folder, whole.labels.with_array(array))


@kind("labels", "refused")
def nameless_segments(random: Random, whole: Whole, folder: Path) -> Inputs:
    names = {value: f"Segment_{value}" for value in whole.labels.names}
    return written(random, whole, folder, replace(whole.labels, names=names))


@kind("labels", "refused", "large pieces")
def bone_in_two(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = editable(whole)
    slices = np.flatnonzero((array == 2).any(axis=(1, 2)))
    middle = int(slices[int(len(slices) * random.uniform(0.35, 0.65))])
    gap = array[middle : middle + 3]
    gap[gap == 2] = 1
    return written(random, whole, folder, whole.labels.with_array(array))


@kind("labels", "refused")
def labels_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(random, whole, folder, whole.labels)
    content = (folder / inputs.labels).read_bytes()
    (folder / inputs.labels).write_bytes(content[: int(len(content) * random.uniform(0.0, 0.98))])
    return inputs


@kind("labels", "refused", "side of the image", by_check=False)
def limb_cut_by_the_side(random: Random, whole: Whole, folder: Path) -> Inputs:
    filled = np.flatnonzero((whole.labels.array > 0).any(axis=(0, 1)))
    start = int(filled[0] + random.uniform(0.2, 0.4) * len(filled))
    place = whole.labels.index_to_point([start, 0, 0])
    image = replace(whole.image, array=whole.image.array[:, :, start:], origin=place)
    write_volume(folder / "image.nrrd", image)
    labels = replace(whole.labels, array=whole.labels.array[:, :, start:], origin=place)
    return replace(written(random, whole, folder, labels), image="image.nrrd")


def new_dicom(kind_uid: str, modality: str) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = kind_uid, generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID, data.Modality = kind_uid, meta.MediaStorageSOPInstanceUID, modality
    data.PatientName, data.StudyInstanceUID, data.SeriesInstanceUID = "DOE^J", generate_uid(), generate_uid()
    return data


def write_seg(file: Path, labels: LabelMap, random: Random, **changes: object) -> None:
    """A binary DICOM-SEG with a frame for each filled slice of each segment, in drawn order."""
    data = new_dicom(SEGMENTATION, "SEG")
    data.SegmentationType, data.Rows, data.Columns = "BINARY", labels.size[1], labels.size[0]
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PixelRepresentation = 1, "MONOCHROME2", 0
    data.BitsAllocated, data.BitsStored, data.HighBit = 1, 1, 0
    plane, measures, shared = Dataset(), Dataset(), Dataset()
    plane.ImageOrientationPatient = [f"{x:.9g}" for x in labels.direction[:, :2].T.ravel()]
    measures.PixelSpacing = [f"{labels.spacing[1]:.9g}", f"{labels.spacing[0]:.9g}"]
    measures.SliceThickness = measures.SpacingBetweenSlices = f"{labels.spacing[2]:.9g}"
    shared.PlaneOrientationSequence, shared.PixelMeasuresSequence = Sequence([plane]), Sequence([measures])
    data.SharedFunctionalGroupsSequence = Sequence([shared])
    segments, frames = [], []
    values = [value for value in labels.names if (labels.array == value).any()]
    for number, value in enumerate(values, start=1):
        segment = Dataset()
        segment.SegmentNumber, segment.SegmentLabel = number, labels.names[value].title()
        segments.append(segment)
        frames += [(number, value, k) for k in range(labels.size[2]) if (labels.array[k] == value).any()]
    frames = [frames[n] for n in random.permutation(len(frames))]
    data.SegmentSequence = Sequence(segments)
    data.PerFrameFunctionalGroupsSequence = Sequence([_frame(labels, number, k) for number, _, k in frames])
    data.NumberOfFrames = len(frames)
    data.PixelData = pack_bits(
        np.stack([labels.array[k] == value for _, value, k in frames]).astype(np.uint8)
    )
    for tag, value in changes.items():
        setattr(data, tag, value)
    data.save_as(file)


def _frame(labels: LabelMap, number: int, k: int) -> Dataset:
    frame, place, segment = Dataset(), Dataset(), Dataset()
    place.ImagePositionPatient = [f"{x:.9g}" for x in labels.index_to_point([0, 0, k])]
    segment.ReferencedSegmentNumber = number
    frame.PlanePositionSequence, frame.SegmentIdentificationSequence = Sequence([place]), Sequence([segment])
    return frame


@kind("labels", "same")
def dicom_seg_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_seg(folder / "labels.dcm", whole.labels, random)
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused")
def dicom_seg_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_seg(folder / "labels.dcm", whole.labels, random)
    content = (folder / "labels.dcm").read_bytes()
    (folder / "labels.dcm").write_bytes(content[: int(len(content) * random.uniform(0.0, 0.98))])
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused", "a different grid")
def dicom_seg_shifted(random: Random, whole: Whole, folder: Path) -> Inputs:
    moved = replace(whole.labels, origin=whole.labels.index_to_point(random.uniform(0.1, 0.9, 3)))
    write_seg(folder / "labels.dcm", moved, random)
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused", "fractional")
def dicom_seg_fractional(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_seg(folder / "labels.dcm", whole.labels, random, SegmentationType="FRACTIONAL")
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused", "no segmentation")
def other_dicom_as_labels(random: Random, whole: Whole, folder: Path) -> Inputs:
    file = sorted(whole.series.iterdir())[random.integers(20)]
    (folder / "labels.dcm").write_bytes(file.read_bytes())
    return given(folder, whole, "labels.dcm")


def write_rtstruct(file: Path, labels: LabelMap, shift: float = 0.0, step: int = 1, form: str = "") -> None:
    """Contours midway between the pixel centres of each label and its surroundings, holes as further ones."""
    data = new_dicom(STRUCTURES, "RTSTRUCT")
    rois, items = [], []
    for value, name in labels.names.items():
        mask = labels.limb if value == 1 else labels.array == value
        if not mask.any():
            continue
        roi, item, contours = Dataset(), Dataset(), []
        roi.ROINumber, roi.ROIName, item.ReferencedROINumber = value, name.title(), value
        slices = np.flatnonzero(mask.any(axis=(1, 2)))
        for k in slices[::step]:
            padded = np.pad(mask[k], 1).astype(float)
            for line in contourpy.contour_generator(z=padded).lines(0.5):
                index = np.column_stack([line[:-1] - 1, np.full(len(line) - 1, k + shift)])
                contour = Dataset()
                contour.ContourGeometricType = form or "CLOSED_PLANAR"
                contour.NumberOfContourPoints = len(index)
                contour.ContourData = [f"{x:.9g}" for x in labels.index_to_point(index).ravel()]
                contours.append(contour)
        item.ContourSequence = Sequence(contours)
        rois.append(roi)
        items.append(item)
    data.StructureSetROISequence, data.ROIContourSequence = Sequence(rois), Sequence(items)
    data.save_as(file)


@kind("labels", "same")
def rtstruct_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_rtstruct(folder / "labels.dcm", whole.labels)
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused", "do not lie on the slices")
def rtstruct_off_slice(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_rtstruct(folder / "labels.dcm", whole.labels, shift=random.uniform(0.15, 0.5))
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused", "without a contour")
def rtstruct_slices_missing(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_rtstruct(folder / "labels.dcm", whole.labels, step=int(random.integers(2, 5)))
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused")
def rtstruct_of_points(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_rtstruct(folder / "labels.dcm", whole.labels, form=str(random.choice(["POINT", "OPEN_PLANAR"])))
    return given(folder, whole, "labels.dcm")


@kind("labels", "refused")
def rtstruct_damaged(random: Random, whole: Whole, folder: Path) -> Inputs:
    write_rtstruct(folder / "labels.dcm", whole.labels)
    data = pydicom.dcmread(folder / "labels.dcm")
    item = data.ROIContourSequence[0].ContourSequence[0]
    item.ContourData = item.ContourData[: -int(random.integers(1, 3))]
    data.save_as(folder / "labels.dcm")
    return given(folder, whole, "labels.dcm")
