"""The image of a phantom: ultra-short-echo-like, T1-like or CT contrast, and real DICOM series of it.

Signal levels of MRI are relative to fat, those of CT are Hounsfield units.

Partial volume is the exact box average over a voxel of a locally flat
interface, blurred to a Gaussian: ``Phi(-sqrt(12) d / w)`` with ``d`` the distance to the interface and ``w``
the voxel's extent along its normal. Noise of MRI is Rician: the magnitude
of a signal with complex Gaussian noise.

The true label map is what someone who knew the limb would have drawn on the image.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import UID, ExplicitVRLittleEndian, MRImageStorage, generate_uid
from pydicom.valuerep import format_number_as_ds
from scipy.special import ndtr

from ..anatomy.grid import DEFAULT_NAMES
from ..anatomy.imaging import LabelMap
from ..arrays import Array
from .geometry import PROXIMAL_CUT_MM, Floats, Limb, build_rotation, intersect_fields

MARKER_DIAMETER_MM, MARKER_HEIGHT_MM = 9.0, 5.0
BIAS = 0.2
FULL_SCALE, RESCALE_SLOPE = 1200.0, 0.5
SLAB = 12
REACH_MM = 85.0  # no tissue or marker lies further from the limb's axis
DETAIL_GRIDS = {"coarse": ((130, 76, 76), (2.36, 2.30, 2.00)), "paper": ((256, 256, 256), (1.18, 1.15, 1.00))}
LABELS_FILE = Path("labels") / "labels.seg.nrrd"
TENDON_LABEL, TENDON_VALUE = "patellar tendon", 7


@dataclass(frozen=True)
class Contrast:
    """Levels of the tissues, the standard deviation of the noise and the amplitude of the bias."""

    air: float
    fat: float
    muscle: float
    marrow: float
    cortex: float
    tendon: float
    marker: float
    noise: float
    bias: float
    rician: bool = True


CONTRASTS = {
    "UTE": Contrast(0.0, 1.0, 0.5, 0.8, 0.12, 0.3, 1.15, 0.5 / 27.0, BIAS),
    "T1": Contrast(0.0, 1.0, 0.35, 0.95, 0.03, 0.1, 1.15, 0.02, BIAS),
    "CT": Contrast(-1000.0, -100.0, 50.0, 60.0, 1300.0, 90.0, 400.0, 25.0, 0.0, rician=False),
}
UTE = CONTRASTS["UTE"]


@dataclass(frozen=True)
class ScanGrid:
    """Where the voxels are: ``shape`` (k, j, i); ``spacing``, ``direction`` columns for i, j, k (LPS mm)."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    origin: Array
    direction: Array

    def points(self, k: slice, j: slice, i: slice) -> NDArray[np.float32]:
        """LPS centres (nk, nj, ni, 3) of a block of voxels."""
        steps = self.direction * np.array(self.spacing)
        kk, jj, ii = (np.arange(s.start, s.stop, dtype=np.float64) for s in (k, j, i))
        out = self.origin + kk[:, None, None, None] * steps[:, 2]
        out = out + jj[None, :, None, None] * steps[:, 1] + ii[None, None, :, None] * steps[:, 0]
        return out.astype(np.float32)


def make_grid(limb: Limb, detail: str, seed: int) -> ScanGrid:
    """Make the scanner's oblique box around a limb: a few degrees off the limb's own frame."""
    shape, spacing = DETAIL_GRIDS[detail]
    random = np.random.default_rng([seed, 3])
    tilt = build_rotation(random.normal(size=3), np.deg2rad(random.uniform(2, 4)))
    direction = limb.rotation @ tilt
    middle = limb.to_patient(np.array([0.0, 3.0, PROXIMAL_CUT_MM / 2 - 1.0]))
    half = np.array([shape[2] - 1, shape[1] - 1, shape[0] - 1]) / 2 * np.array(spacing)
    return ScanGrid(shape, spacing, middle - direction @ half, direction)


@dataclass(frozen=True)
class SkinMarker:
    """A bright disc on the skin: where it sits (LPS mm) and the outward direction."""

    position: Array
    outward: Array

    def field(self, points: Floats) -> Floats:
        """Field of a disc with rounded edges that reaches 2 mm into the skin."""
        offset = points - self.position.astype(points.dtype)
        height = offset @ self.outward.astype(points.dtype)
        radial = np.sqrt(np.maximum((offset * offset).sum(-1) - height**2, 0))
        base = 2.0
        along = np.abs(height - (MARKER_HEIGHT_MM - base) / 2) - (MARKER_HEIGHT_MM + base) / 2
        return intersect_fields(radial - MARKER_DIAMETER_MM / 2, along, rounding=1.5)


def _compute_occupancy(
    field: Floats, spacing: tuple[float, float, float], offsets: Sequence[float]
) -> list[Floats]:
    """Compute the share of each voxel that lies deeper than ``offset`` inside, for each offset (mm)."""
    steps = [np.gradient(field, axis=axis) for axis in range(3)]
    per_voxel = np.sqrt(sum(g * g for g in steps))
    per_mm = np.sqrt(sum((g / h) ** 2 for g, h in zip(steps, spacing[::-1], strict=True)))
    per_mm = np.clip(per_mm, 0.2, 1.6)  # fields are near-distances; their ridges and centres are not
    distance, width = field / per_mm, np.maximum(per_voxel / per_mm, 0.5 * min(spacing))
    return [ndtr(-np.sqrt(12.0, dtype=field.dtype) * (distance + offset) / width) for offset in offsets]


def _compute_tissue(
    limb: Limb, points: Floats, spacing: tuple[float, float, float], levels: Contrast
) -> tuple:
    """Compute the noise-free signal of a block and the share of each voxel inside the skin."""
    skin, inner = _compute_occupancy(limb.skin(points), spacing, (0.0, limb.layers_mm))
    signal = levels.air + (levels.fat - levels.air) * skin + (levels.muscle - levels.fat) * inner
    if limb.has_tendon:
        (band,) = _compute_occupancy(limb.tendon(points), spacing, (0.0,))
        signal += (levels.tendon - signal) * band
    for name, cortex in limb.shape.cortex_mm.items():
        bone, marrow = _compute_occupancy(limb.bone(name, points), spacing, (0.0, cortex))
        signal = signal * (1 - bone) + levels.cortex * bone + (levels.marrow - levels.cortex) * marrow
    return signal, skin


def _find_limb_window(grid: ScanGrid, limb: Limb, k: slice) -> tuple[slice, slice]:
    """Find the rows and columns of a slab that can hold tissue."""
    heights = np.array([-10.0, PROXIMAL_CUT_MM + 40.0])
    axis = limb.to_patient(np.stack([0 * heights, 0 * heights, heights], axis=-1))
    index = (axis - grid.origin) @ grid.direction / np.array(grid.spacing)
    t = (np.array([k.start, k.stop]) - index[0, 2]) / (index[1, 2] - index[0, 2])
    centres = index[0] + t[:, None] * (index[1] - index[0])
    window = []
    for column, size in ((1, grid.shape[1]), (0, grid.shape[2])):
        reach = REACH_MM / grid.spacing[column]
        low, high = centres[:, column].min() - reach, centres[:, column].max() + reach
        window.append(slice(max(int(low), 0), min(int(high) + 2, size)))
    return window[0], window[1]


def _compute_bias(grid: ScanGrid, k: slice, seed: int, amplitude: float) -> NDArray[np.float32]:
    """Compute, for a slab, a smooth receive profile within 1 +- ``amplitude`` over the whole image."""
    random = np.random.default_rng([seed, 4])
    linear, quadratic = random.uniform(-1, 1, 3), random.uniform(-1, 1, 3)
    scale = amplitude / (np.abs(linear).sum() + np.abs(quadratic).sum())
    axes = [np.linspace(-1, 1, count) for count in grid.shape]
    x, y, z = (a * u + b * (2 * u * u - 1) for u, a, b in zip(axes, linear, quadratic, strict=True))
    total = x[k, None, None] + y[None, :, None] + z[None, None, :]
    return (1 + scale * total).astype(np.float32)


def generate_slabs(
    limb: Limb,
    grid: ScanGrid,
    markers: Sequence[SkinMarker],
    seed: int,
    noise: float | None = None,
    levels: Contrast = UTE,
) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Generate slices and signal (nk, nj, ni) slab by slab, with bias and noise (None: the contrast's)."""
    random = np.random.default_rng([seed, 5, len(markers)])
    deviation = levels.noise if noise is None else noise
    for start in range(0, grid.shape[0], SLAB):
        k = slice(start, min(start + SLAB, grid.shape[0]))
        padded = slice(k.start - 1, k.stop + 1)
        rows, columns = _find_limb_window(grid, limb, padded)
        points = grid.points(padded, rows, columns)
        tissue, skin = _compute_tissue(limb, points, grid.spacing, levels)
        for marker in markers:
            near = np.linalg.norm(points - marker.position.astype(points.dtype), axis=-1) < 14.0
            if not near.any():
                continue
            box = tuple(slice(max(ix.min() - 1, 0), ix.max() + 2) for ix in np.nonzero(near))
            if min(tissue[box].shape) > 1:
                (share,) = _compute_occupancy(marker.field(points[box]), grid.spacing, (0.0,))
                tissue[box] += (levels.marker - levels.air) * share * (1 - skin[box])
        signal = np.full((k.stop - k.start, *grid.shape[1:]), levels.air, np.float32)
        signal[:, rows, columns] = tissue[1:-1]
        signal *= _compute_bias(grid, k, seed, levels.bias)
        signal += deviation * random.standard_normal(signal.shape, dtype=np.float32)
        if levels.rician:
            imaginary = deviation * random.standard_normal(signal.shape, dtype=np.float32)
            signal = np.hypot(signal, imaginary)
        yield k, signal


def write_series(
    folder: Path,
    limb: Limb,
    grid: ScanGrid,
    markers: Sequence[SkinMarker] = (),
    *,
    seed: int = 0,
    number: int = 1,
    description: str = "UTE plain",
    progress: Callable[[float], None] | None = None,
) -> None:
    """Render a limb and write it as one DICOM file per slice (MR Image Storage) into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    series = _build_uid(seed, "series", number)
    for k, signal in generate_slabs(limb, grid, markers, seed):
        stored = np.clip(np.rint(signal * (FULL_SCALE / RESCALE_SLOPE)), 0, 65535).astype(np.uint16)
        for index, pixels in zip(range(k.start, k.stop), stored, strict=True):
            slice_ = _build_slice(grid, index, pixels, seed, number, series)
            slice_.SeriesDescription = description
            slice_.save_as(folder / f"IM{index + 1:04d}.dcm", enforce_file_format=True)
        if progress is not None:
            progress(k.stop / grid.shape[0])


def _build_uid(seed: int, *names: object) -> UID:
    """Build the identifier of a seed, the same each time, so that a phantom is reproduced to the byte."""
    return generate_uid(entropy_srcs=["limbfit phantom", str(seed), *map(str, names)])


def _format_decimals(values: Sequence[float] | Array) -> list[str]:
    return [format_number_as_ds(float(value)) for value in values]


def _build_slice(
    grid: ScanGrid, index: int, pixels: NDArray[np.uint16], seed: int, number: int, series: UID
) -> FileDataset:
    """Build one slice of a made-up scan; nobody is behind its tags."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = MRImageStorage
    meta.MediaStorageSOPInstanceUID = _build_uid(seed, "image", number, index)
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)  # type: ignore[arg-type]
    data.SOPClassUID, data.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    data.StudyInstanceUID, data.SeriesInstanceUID = _build_uid(seed, "study"), series
    data.FrameOfReferenceUID, data.PositionReferenceIndicator = _build_uid(seed, "frame"), ""
    data.PatientName, data.PatientID = "PHANTOM", f"PHANTOM-{seed}"
    data.PatientBirthDate, data.PatientSex = "", ""
    data.StudyID, data.SeriesNumber, data.AccessionNumber = "1", str(number), ""
    data.StudyDate = data.SeriesDate = data.ContentDate = "20000101"
    data.StudyTime = data.SeriesTime = data.ContentTime = "120000"
    data.Modality, data.Manufacturer, data.ManufacturerModelName = "MR", "limbfit", "synthetic residuum"
    data.ReferringPhysicianName, data.BodyPartExamined, data.PatientPosition = "", "LEG", "FFP"
    data.ImageType = ["DERIVED", "PRIMARY", "M", "NONE"]
    data.ScanningSequence, data.SequenceVariant, data.ScanOptions = "RM", "SP", ""
    data.MRAcquisitionType, data.RepetitionTime, data.EchoTime = "3D", "5.8", "0.1"
    data.MagneticFieldStrength, data.FlipAngle, data.EchoTrainLength = "3", "10", "1"
    position = grid.origin + index * grid.spacing[2] * grid.direction[:, 2]
    data.ImagePositionPatient = _format_decimals(position)
    data.ImageOrientationPatient = _format_decimals(grid.direction[:, :2].T.ravel())  # along i, along j
    data.PixelSpacing = _format_decimals([grid.spacing[1], grid.spacing[0]])
    data.SliceThickness = data.SpacingBetweenSlices = _format_decimals([grid.spacing[2]])[0]
    data.SliceLocation = _format_decimals([float(position @ grid.direction[:, 2])])[0]
    data.InstanceNumber = index + 1
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.Rows, data.Columns = pixels.shape
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.RescaleSlope, data.RescaleIntercept, data.RescaleType = str(RESCALE_SLOPE), "0", "US"
    data.PixelData = pixels.tobytes()
    return data


def build_true_labels(limb: Limb, grid: ScanGrid) -> LabelMap:
    """Label soft tissue, bones and, where the limb has one, the patellar tendon, voxel by voxel."""
    values = {name: value for value, name in DEFAULT_NAMES.items()}
    array = np.zeros(grid.shape, dtype=np.uint8)
    for start in range(0, grid.shape[0], SLAB):
        k = slice(start, min(start + SLAB, grid.shape[0]))
        points = grid.points(k, slice(0, grid.shape[1]), slice(0, grid.shape[2]))
        part = (limb.skin(points) < 0).astype(np.uint8)
        if limb.has_tendon:
            part[limb.tendon(points) < 0] = TENDON_VALUE
        for name in limb.bone_names:
            part[limb.bone(name, points) < 0] = values[name]
        array[k] = part
    names = {value: name for value, name in DEFAULT_NAMES.items() if (array == value).any()}
    tendon = {TENDON_VALUE: TENDON_LABEL} if limb.has_tendon else {}
    return LabelMap(array, np.array(grid.spacing), grid.origin, grid.direction, names | tendon)
