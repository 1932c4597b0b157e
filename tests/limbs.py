"""Synthetic limbs, grids and DICOM files."""

from pathlib import Path

import numpy as np
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, MRImageStorage, generate_uid

from limbfit.anatomy.imaging import LabelMap, Volume

SHARED = Path(__file__).parents[1] / ".." / "shared"
CALF = SHARED / "data" / "calf-mri"
OPENLIMB = SHARED / "reference" / "openlimb-study"

IDENTITY = {
    "PatientName": "DOE^JANESECRET",
    "PatientID": "PID4711SECRET",
    "PatientBirthDate": "19700131",
    "InstitutionName": "SECRETHOSPITAL",
    "SeriesDescription": "SECRETDESCRIPTION",
    "StudyDate": "20210203",
}


def rotation(seed: int) -> np.ndarray:
    """A random proper rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


DIRECTIONS = {
    "straight": np.eye(3),
    "oblique": rotation(1),
    "flipped slices": np.diag([1.0, 1.0, -1.0]),
    "flipped rows": rotation(2) @ np.diag([1.0, -1.0, 1.0]),
    "permuted": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}


def volume(direction: np.ndarray, seed: int = 0) -> Volume:
    """A small image of whole numbers, each spacing and size different."""
    array = np.random.default_rng(seed).integers(0, 900, size=(7, 6, 5)).astype(np.float32)
    return Volume(array, [0.7, 1.3, 2.9], [-80.3, 45.7, -310.9], direction)


def write_dicom(
    folder: Path,
    image: Volume,
    *,
    number: int = 3,
    skip: tuple[int, ...] = (),
    uid: str | None = None,
    prefix: str = "DOEJANE",
    **changes: object,
) -> str:
    """The image as one file per slice, in shuffled order, with a planted identity; returns the series UID.

    ``changes`` are tags to set on every slice, or callables of the slice index that give the value; None
    leaves the tag out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    uid = uid or generate_uid()
    order = np.random.default_rng(5).permutation(len(image.array))
    for place, k in enumerate(order):
        if k in skip:
            continue
        data = _slice(image, int(k), number, uid)
        for tag, value in changes.items():
            value = value(int(k)) if callable(value) else value
            if value is None:
                delattr(data, tag)
            else:
                setattr(data, tag, value)
        data.save_as(folder / f"{prefix}_{place:03d}.dcm", enforce_file_format=True)
    return uid


def _slice(image: Volume, k: int, number: int, uid: str) -> FileDataset:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = CTImageStorage if number < 0 else MRImageStorage
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = FileDataset(None, {}, file_meta=meta, preamble=b"\0" * 128)
    data.SOPClassUID, data.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    for tag, value in IDENTITY.items():
        setattr(data, tag, value)
    data.Modality, data.SeriesNumber, data.SeriesInstanceUID = "MR", number, uid
    data.StudyInstanceUID, data.FrameOfReferenceUID = "1.2.3.4", "1.2.3.5"
    data.Rows, data.Columns = image.array.shape[1:]
    data.PixelSpacing = [f"{image.spacing[1]:.10g}", f"{image.spacing[0]:.10g}"]
    data.SliceThickness = f"{image.spacing[2]:.10g}"
    data.ImagePositionPatient = [f"{x:.10g}" for x in image.index_to_point([0, 0, k])]
    data.ImageOrientationPatient = [f"{x:.10g}" for x in image.direction[:, :2].T.ravel()]
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated = data.BitsStored = 16
    data.HighBit, data.PixelRepresentation = 15, 0
    data.RescaleSlope, data.RescaleIntercept = "0.5", "0"
    data.PixelData = np.rint(image.array[k] / 0.5).astype(np.uint16).tobytes()
    return data


def grid(shape: tuple[int, int, int], spacing: list[float], direction: np.ndarray) -> LabelMap:
    """Empty labels centred on (-70, 30, -350) mm."""
    half = (np.array(shape[::-1]) - 1) / 2 * np.array(spacing)
    return LabelMap(
        np.zeros(shape, np.uint8), spacing, np.array([-70.0, 30.0, -350.0]) - direction @ half, direction
    )


def dice(a: np.ndarray, b: np.ndarray) -> float:
    """Agreement of two masks: 1 where they are the same, 0 where they share nothing."""
    return 2 * float((a & b).sum()) / float(a.sum() + b.sum())


class Leg:
    """A straight leg along z of its own frame, cut by the image proximally (z up), with two bones.

    A tapered cylinder of 42 to 50 mm radius, rounded distally; fat of 5 mm, tibia of 13 mm radius close to
    the anterior (-y) skin, fibula of 6 mm, cortex of 4 and 2.5 mm.
    """

    low, top = -70.0, 75.0

    def limb(self, p: np.ndarray) -> np.ndarray:
        """Depth below the skin, mm, about."""
        radius = 46 + 0.05 * p[..., 2]
        side = radius - np.hypot(p[..., 0], p[..., 1])
        end = p[..., 2] - self.low
        r = 20.0
        a, b = np.clip(r - side, 0, None), np.clip(r - end, 0, None)
        return np.where((side < r) & (end < r), r - np.hypot(a, b), np.minimum(side, end))

    def bone(self, name: str, p: np.ndarray) -> np.ndarray:
        """Depth below the bone's surface, mm."""
        x, y, radius, low = (0.0, -24.0, 13.0, -45.0) if name == "tibia" else (-22.0, 2.0, 6.5, -40.0)
        return np.minimum(radius - np.hypot(p[..., 0] - x, p[..., 1] - y), p[..., 2] - low)


def leg_image(
    spacing: list[float], shape: tuple[int, int, int], direction: np.ndarray, noise: float = 0.02
) -> tuple[Volume, LabelMap]:
    """A T1-like image of :class:`Leg` whose proximal end is the image's last slice, and its truth."""
    leg, labels = Leg(), grid(shape, spacing, direction)
    centre = labels.index_to_point((np.array(labels.size) - 1) / 2)
    i, j, k = np.meshgrid(*[np.arange(n) for n in labels.size], indexing="ij")
    index = np.stack([i, j, k], axis=-1).transpose(2, 1, 0, 3)
    p = (labels.index_to_point(index) - centre) @ direction
    depth = leg.limb(p)
    cover = np.clip(depth / spacing[0] + 0.5, 0, 1)
    image = np.where(depth < 5, 1.0, 0.5)
    truth = (depth > 0).astype(np.uint8)
    for value, (name, cortex) in enumerate((("tibia", 4.0), ("fibula", 2.5)), start=2):
        inside = leg.bone(name, p)
        part = np.clip(inside / spacing[0] + 0.5, 0, 1)
        marrow = np.clip((inside - cortex) / spacing[0] + 0.5, 0, 1)
        image = image * (1 - part) + part * (0.1 * (1 - marrow) + 0.85 * marrow)
        truth[inside > 0] = value
    random = np.random.default_rng(4)
    bias = 1 + 0.2 * np.sin(p[..., 0] / 60) * np.cos(p[..., 2] / 70)
    real, imaginary = (random.normal(0, noise, image.shape) for _ in range(2))
    array = 700 * np.hypot(image * cover * bias + real, imaginary)
    return Volume(array, *labels.geometry), LabelMap(truth, *labels.geometry)
