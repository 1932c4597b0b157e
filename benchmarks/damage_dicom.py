"""Ways to damage a DICOM series."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pydicom
from damage import Inputs, Whole, kind
from pydicom.dataset import FileDataset
from pydicom.encaps import encapsulate
from pydicom.uid import (
    MPEG4HP41,
    ExplicitVRBigEndian,
    HTJ2KLossless,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLSLossless,
    RLELossless,
    generate_uid,
)

SERIES = Inputs(image="mri")
Random = np.random.Generator
Change = Callable[[FileDataset], None]


def change(files: Iterable[Path], how: Change) -> None:
    for file in files:
        data = pydicom.dcmread(file)
        how(data)
        data.save_as(file)


def some(random: Random, files: list[Path], inner: bool = False) -> list[Path]:
    """One file, or all of them; ``inner``: one that is not at an end."""
    if inner:
        return [files[random.integers(2, len(files) - 2)]]
    return files if random.random() < 0.5 else [files[random.integers(len(files))]]


def cut(file: Path, low: float, high: float, random: Random) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * random.uniform(low, high))])


@kind("dicom", "same")
def dicom_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    whole.copy_series(folder)
    return SERIES


@kind("dicom", "refused", "cut short")
def pixels_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    cut(files[random.integers(len(files))], 0.2, 0.999, random)
    return SERIES


@kind("dicom", "refused")
def header_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    file = files[random.choice([0, len(files) - 1, random.integers(len(files))])]
    file.write_bytes(file.read_bytes()[: random.integers(1, 1000)])
    return SERIES


@kind("dicom", "refused", "cut short or damaged")
def empty_file(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    files[random.integers(len(files))].write_bytes(b"")
    return SERIES


@kind("dicom", "refused", "spacing")
def no_pixel_spacing(random: Random, whole: Whole, folder: Path) -> Inputs:
    change(some(random, whole.copy_series(folder)), lambda data: delattr(data, "PixelSpacing"))
    return SERIES


@kind("dicom", "refused", "spacing")
def zero_pixel_spacing(random: Random, whole: Whole, folder: Path) -> Inputs:
    spacing = [["0", "0"], ["0", "2.0"], ["-2.3", "2.0"]][random.integers(3)]
    change(some(random, whole.copy_series(folder)), lambda data: setattr(data, "PixelSpacing", spacing))
    return SERIES


@kind("dicom", "refused", "where they lie")
def no_position(random: Random, whole: Whole, folder: Path) -> Inputs:
    tag = str(random.choice(["ImagePositionPatient", "ImageOrientationPatient"]))
    change(whole.copy_series(folder), lambda data: delattr(data, tag))
    return SERIES


@kind("dicom", "refused")
def skewed_axes(random: Random, whole: Whole, folder: Path) -> Inputs:
    off = random.uniform(0.01, 0.3)

    def skew(data: FileDataset) -> None:
        axes = [float(x) for x in data.ImageOrientationPatient]
        axes[3:] = [b + off * a for a, b in zip(axes[:3], axes[3:])]
        data.ImageOrientationPatient = [f"{x:.8f}" for x in axes]

    change(some(random, whole.copy_series(folder)), skew)
    return SERIES


@kind("dicom", "refused")
def other_modality(random: Random, whole: Whole, folder: Path) -> Inputs:
    modality = str(random.choice(["US", "OT", "XA", "CR", "DOE^JANE"]))
    change(some(random, whole.copy_series(folder)), lambda data: setattr(data, "Modality", modality))
    return SERIES


@kind("dicom", "refused", "cannot be decoded")
def no_decoder(random: Random, whole: Whole, folder: Path) -> Inputs:
    """Compressed as nothing here decodes, or as something that it is not."""
    syntax = (HTJ2KLossless, MPEG4HP41, JPEG2000Lossless, JPEGLSLossless)[random.integers(4)]

    def compress(data: FileDataset) -> None:
        data.PixelData = encapsulate([bytes(random.integers(0, 256, 400, dtype=np.uint8))])
        data["PixelData"].is_undefined_length = True
        data.file_meta.TransferSyntaxUID = syntax

    change(some(random, whole.copy_series(folder)), compress)
    return SERIES


@kind("dicom", "either")
def falsely_compressed(random: Random, whole: Whole, folder: Path) -> Inputs:
    """A header that says compressed over pixels that are not."""
    syntax = (JPEG2000Lossless, JPEGLSLossless, RLELossless)[random.integers(3)]
    files = whole.copy_series(folder)
    for file in some(random, files):
        content, known = file.read_bytes(), b"1.2.840.10008.1.2.1\0"
        new = str(syntax).encode()
        new += b"\0" * (len(new) % 2)
        place = content.index(known)
        length = place - 2
        group = int.from_bytes(content[140:144], "little") + len(new) - len(known)
        content = content[:140] + group.to_bytes(4, "little") + content[144:]
        size = len(new).to_bytes(2, "little")
        file.write_bytes(content[:length] + size + new + content[place + len(known) :])
    return SERIES


@kind("dicom", "same")
def truly_compressed(random: Random, whole: Whole, folder: Path) -> Inputs:
    for file in whole.copy_series(folder):
        data = pydicom.dcmread(file)
        data.compress(RLELossless, generate_instance_uid=False)
        data.save_as(file)
    return SERIES


@kind("dicom", "same")
def other_transfer_syntax(random: Random, whole: Whole, folder: Path) -> Inputs:
    is_big = random.random() < 0.5
    for file in whole.copy_series(folder):
        data = pydicom.dcmread(file)
        if is_big:
            data.PixelData = np.frombuffer(data.PixelData, "<u2").astype(">u2").tobytes()
        data.file_meta.TransferSyntaxUID = ExplicitVRBigEndian if is_big else ImplicitVRLittleEndian
        pydicom.dcmwrite(file, data, implicit_vr=not is_big, little_endian=not is_big, force_encoding=True)
    return SERIES


@kind("dicom", "refused", "differ")
def mixed_sizes(random: Random, whole: Whole, folder: Path) -> Inputs:
    def shrink(data: FileDataset) -> None:
        data.PixelData = data.pixel_array[:, :-2].tobytes()
        data.Columns -= 2

    change(some(random, whole.copy_series(folder), inner=True), shrink)
    return SERIES


@kind("dicom", "refused", "differ")
def mixed_spacing(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = some(random, whole.copy_series(folder), inner=True)
    change(files, lambda data: setattr(data, "PixelSpacing", ["2.4", "2.0"]))
    return SERIES


@kind("dicom", "refused", "missing")
def slices_missing(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    start, count = random.integers(2, len(files) - 8), random.integers(1, 5)
    for file in files[start : start + count]:
        file.unlink()
    return SERIES


@kind("dicom", "refused", "missing")
def every_second_slice(random: Random, whole: Whole, folder: Path) -> Inputs:
    for file in whole.copy_series(folder)[random.integers(2) :: 2]:
        file.unlink()
    return SERIES


@kind("dicom", "refused", "same place")
def doubled_slices(random: Random, whole: Whole, folder: Path) -> Inputs:
    for file in some(random, whole.copy_series(folder)):
        shutil.copy(file, file.with_name("again-" + file.name))
    return SERIES


@kind("dicom", "refused", "tilt")
def gantry_tilt(random: Random, whole: Whole, folder: Path) -> Inputs:
    angle = np.deg2rad(random.uniform(3, 20))
    for n, file in enumerate(whole.copy_series(folder)):
        shift = n * whole.image.spacing[2] * np.tan(angle) * whole.image.direction[:, 1]
        place = whole.image.index_to_point([0, 0, n]) + shift
        change([file], lambda data, place=place: setattr(data, "ImagePositionPatient", decimals(place)))
    return SERIES


def decimals(values: Iterable[float]) -> list[str]:
    return [f"{value:.9g}" for value in values]


@kind("dicom", "refused", "choose one by its UID")
def two_series(random: Random, whole: Whole, folder: Path) -> Inputs:
    whole.copy_series(folder)
    other = shutil.copytree(whole.series, folder / "mri" / "other")
    uid = generate_uid()
    change(sorted(other.iterdir()), lambda data: setattr(data, "SeriesInstanceUID", uid))
    return SERIES


@kind("dicom", "refused", "scout")
def scout_in_series(random: Random, whole: Whole, folder: Path) -> Inputs:
    file = whole.copy_series(folder)[random.integers(20)]
    scout = file.with_name("scout")
    shutil.copy(file, scout)
    axes = decimals(whole.image.direction[:, [0, 2]].T.ravel())
    change([scout], lambda data: setattr(data, "ImageOrientationPatient", axes))
    return SERIES


@kind("dicom", "same")
def foreign_files(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    (folder / "mri" / "README.txt").write_text("Exported for J. Doe")
    (folder / "mri" / "AUTORUN.INF").write_bytes(bytes(random.integers(0, 256, 500, dtype=np.uint8)))
    report = pydicom.dcmread(files[0], stop_before_pixels=True)
    report.SOPClassUID = report.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
    report.Modality = "SR"
    del report.Rows, report.Columns
    report.save_as(folder / "mri" / "report.dcm")
    return SERIES


@kind("dicom", "same")
def shuffled_names(random: Random, whole: Whole, folder: Path) -> Inputs:
    files = whole.copy_series(folder)
    for n, file in zip(random.permutation(len(files)), files):
        place = folder / "mri" / f"part{n % 3}"
        place.mkdir(exist_ok=True)
        file.rename(place / f"x{n}")
    return SERIES


@kind("dicom", "same")
def uid_per_slice(random: Random, whole: Whole, folder: Path) -> Inputs:
    change(whole.copy_series(folder), lambda data: setattr(data, "SeriesInstanceUID", generate_uid()))
    return SERIES


@kind("dicom", "same")
def rescale_per_slice(random: Random, whole: Whole, folder: Path) -> Inputs:
    """The same grey values by other stored numbers, as PET writes them."""

    def rescale(data: FileDataset) -> None:
        data.PixelData = (data.pixel_array * 2).astype(np.uint16).tobytes()
        data.RescaleSlope = "0.25"

    files = whole.copy_series(folder)
    change(files[:: random.integers(2, 5)], rescale)
    return SERIES


@kind("dicom", "refused")
def slope_not_a_number(random: Random, whole: Whole, folder: Path) -> Inputs:
    def spoil(file: Path) -> None:
        content = file.read_bytes()
        assert content.count(b"\x28\x00\x53\x10DS\x04\x000.5 ") == 1
        file.write_bytes(content.replace(b"\x53\x10DS\x04\x000.5 ", b"\x53\x10DS\x04\x00nan "))

    for file in some(random, whole.copy_series(folder)):
        spoil(file)
    return SERIES


@kind("dicom", "refused", "constant")
def constant_series(random: Random, whole: Whole, folder: Path) -> Inputs:
    value = np.uint16(random.integers(0, 2000))
    change(
        whole.copy_series(folder),
        lambda data: setattr(data, "PixelData", np.full_like(data.pixel_array, value).tobytes()),
    )
    return SERIES


def other_unit(factor: float, random: Random, whole: Whole, folder: Path) -> Inputs:
    def scale(data: FileDataset) -> None:
        for tag in ("PixelSpacing", "ImagePositionPatient"):
            setattr(data, tag, decimals(float(x) * factor for x in data[tag].value))
        for tag in ("SliceThickness", "SpacingBetweenSlices"):
            setattr(data, tag, decimals([float(data[tag].value) * factor])[0])

    change(whole.copy_series(folder), scale)
    return SERIES


@kind("dicom", "refused", "millimetres")
def series_in_metres(random: Random, whole: Whole, folder: Path) -> Inputs:
    return other_unit(0.001, random, whole, folder)


@kind("dicom", "refused", "millimetres")
def series_in_centimetres(random: Random, whole: Whole, folder: Path) -> Inputs:
    return other_unit(0.1, random, whole, folder)


@kind("dicom", "refused", "colour")
def colour_series(random: Random, whole: Whole, folder: Path) -> Inputs:
    def colour(data: FileDataset) -> None:
        grey = (data.pixel_array >> 4).astype(np.uint8)
        data.PixelData = np.repeat(grey[..., None], 3, axis=2).tobytes()
        data.SamplesPerPixel, data.PhotometricInterpretation, data.PlanarConfiguration = 3, "RGB", 0
        data.BitsAllocated = data.BitsStored = 8
        data.HighBit = 7

    change(whole.copy_series(folder), colour)
    return SERIES


@kind("dicom", "refused", "MONOCHROME1")
def inverted_series(random: Random, whole: Whole, folder: Path) -> Inputs:
    change(whole.copy_series(folder), lambda data: setattr(data, "PhotometricInterpretation", "MONOCHROME1"))
    return SERIES


@kind("dicom", "either", within_mm=2.5)
def header_bytes_flipped(random: Random, whole: Whole, folder: Path) -> Inputs:
    """Some bytes of one header are others; where it still reads, one slice may be brighter."""
    files = whole.copy_series(folder)
    file = files[random.integers(len(files))]
    content = bytearray(file.read_bytes())
    end = content.index(b"\xe0\x7f\x10\x00")
    for place in random.integers(132, end, random.integers(1, 6)):
        content[place] ^= 1 << random.integers(8)
    file.write_bytes(bytes(content))
    return SERIES


@kind("dicom", "refused", "two limbs")
def two_limbs(random: Random, whole: Whole, folder: Path) -> Inputs:
    gap = int(random.integers(0, 8))

    def double(data: FileDataset) -> None:
        one = data.pixel_array
        both = np.concatenate([one, one[:, ::-1][:, gap:]], axis=1)
        data.Columns, data.PixelData = both.shape[1], both.tobytes()

    change(whole.copy_series(folder), double)
    return SERIES


@kind("dicom", "same", within_mm=1.0)
def rows_flipped(random: Random, whole: Whole, folder: Path) -> Inputs:
    """The same body with rows and columns stored the other way round."""

    def flip(data: FileDataset) -> None:
        axes = np.array(data.ImageOrientationPatient, dtype=float)
        corner = np.array(data.ImagePositionPatient, dtype=float)
        corner = corner + axes[:3] * float(data.PixelSpacing[1]) * (data.Columns - 1)
        data.ImagePositionPatient = decimals(corner)
        data.ImageOrientationPatient = decimals([*-axes[:3], *axes[3:]])
        data.PixelData = np.ascontiguousarray(data.pixel_array[:, ::-1]).tobytes()

    change(whole.copy_series(folder), flip)
    return SERIES
