"""Ways to damage image files: NIfTI, NRRD and MetaImage."""

import gzip
from pathlib import Path

import nrrd
import numpy as np
import SimpleITK as sitk  # noqa: N813
from damage import Inputs, Whole, kind

from limbfit.anatomy.imaging import Volume, write_volume

Random = np.random.Generator
SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha")


def written(folder: Path, image: Volume, suffix: str) -> Inputs:
    write_volume(folder / f"image{suffix}", image)
    return Inputs(image=f"image{suffix}")


def drawn(random: Random) -> str:
    return str(random.choice(SUFFIXES))


@kind("file", "same")
def file_whole(random: Random, whole: Whole, folder: Path) -> Inputs:
    return written(folder, whole.image, drawn(random))


@kind("file", "same")
def ras_nrrd(random: Random, whole: Whole, folder: Path) -> Inputs:
    sign = np.array([-1.0, -1.0, 1.0])
    header = {
        "space": "right-anterior-superior",
        "kinds": ["domain"] * 3,
        "space directions": (whole.image.direction * whole.image.spacing).T * sign,
        "space origin": whole.image.origin * sign,
    }
    nrrd.write(str(folder / "image.nrrd"), np.transpose(whole.image.array, (2, 1, 0)), header)
    return Inputs(image="image.nrrd")


@kind("file", "same", within_mm=1.0)
def axes_permuted(random: Random, whole: Whole, folder: Path) -> Inputs:
    """The same body with other index axes: found bones and bias field see other slices."""
    turned = whole.image.permute_axes(random.permutation(3).tolist())
    backward = np.flatnonzero(random.random(3) < 0.5).tolist()
    return written(folder, turned.reverse_axes(backward), drawn(random))


@kind("file", "refused")
def file_cut(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(folder, whole.image, drawn(random))
    content = (folder / inputs.image).read_bytes()
    (folder / inputs.image).write_bytes(content[: int(len(content) * random.uniform(0.0, 0.99))])
    return inputs


@kind("file", "refused", "not numbers")
def not_numbers(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = whole.image.array.copy()
    count = random.integers(1, 100)
    where = tuple(random.integers(0, n, count) for n in array.shape)
    array[where] = [np.nan, np.inf, -np.inf][random.integers(3)]
    return written(folder, whole.image.with_array(array), drawn(random))


@kind("file", "refused", "constant")
def constant_file(random: Random, whole: Whole, folder: Path) -> Inputs:
    array = np.full_like(whole.image.array, random.integers(0, 900))
    return written(folder, whole.image.with_array(array), drawn(random))


@kind("file", "refused", "how it lies")
def no_orientation(random: Random, whole: Whole, folder: Path) -> Inputs:
    if random.random() < 0.5:
        nrrd.write(str(folder / "image.nrrd"), whole.image.array)
        return Inputs(image="image.nrrd")
    inputs = written(folder, whole.image, ".nii")
    patch(folder / inputs.image, 252, np.zeros(2, np.int16))  # qform_code, sform_code
    return inputs


def patch(file: Path, place: int, values: np.ndarray) -> None:
    content = bytearray(file.read_bytes())
    content[place : place + values.nbytes] = values.tobytes()
    file.write_bytes(bytes(content))


@kind("file", "refused", "orthonormal")
def sheared(random: Random, whole: Whole, folder: Path) -> Inputs:
    steps = (whole.image.direction * whole.image.spacing).T
    steps[2] += random.uniform(0.05, 0.5) * steps[random.integers(2)]
    if random.random() < 0.5:
        inputs = written(folder, whole.image, ".nii")
        rows = np.column_stack([steps.T, whole.image.origin]) * np.array([[-1.0], [-1.0], [1.0]])
        patch(folder / inputs.image, 252, np.array([0, 1], np.int16))
        patch(folder / inputs.image, 280, rows.astype(np.float32))  # srow_x, srow_y, srow_z
        return inputs
    header = {"space": "LPS", "space directions": steps, "space origin": whole.image.origin}
    nrrd.write(str(folder / "image.nrrd"), np.transpose(whole.image.array, (2, 1, 0)), header)
    return Inputs(image="image.nrrd")


@kind("file", "refused", "three dimensions")
def wrong_dimension(random: Random, whole: Whole, folder: Path) -> Inputs:
    suffix = drawn(random)
    image = sitk.GetImageFromArray(whole.image.array[20])
    if random.random() < 0.5:
        image = sitk.JoinSeries([whole.image.to_sitk(), whole.image.to_sitk()])
    sitk.WriteImage(image, str(folder / f"image{suffix}"))
    return Inputs(image=f"image{suffix}")


@kind("file", "refused", "one grey value")
def colour_file(random: Random, whole: Whole, folder: Path) -> Inputs:
    suffix = drawn(random)
    sitk.WriteImage(sitk.Compose([whole.image.to_sitk()] * 3), str(folder / f"image{suffix}"))
    return Inputs(image=f"image{suffix}")


@kind("file", "either")
def nifti_in_metres(random: Random, whole: Whole, folder: Path) -> Inputs:
    """Lengths in metres, as the header says: read so, or refused for the size."""
    inputs = written(folder, whole.image, ".nii")
    file = folder / inputs.image
    head = file.read_bytes()
    pixdim = np.frombuffer(head, np.float32, 8, 76).copy()
    pixdim[1:4] /= 1000
    patch(file, 76, pixdim)
    patch(file, 268, np.frombuffer(head, np.float32, 3, 268) / np.float32(1000))  # qoffset
    rows = np.frombuffer(head, np.float32, 12, 280) / np.float32(1000)
    patch(file, 280, rows)
    if random.random() < 0.5:
        patch(file, 123, np.array([1], np.uint8))  # xyzt_units: metre
    return inputs


@kind("file", "refused")
def zero_spacing(random: Random, whole: Whole, folder: Path) -> Inputs:
    axis = int(random.integers(3))
    if random.random() < 0.5:
        inputs = written(folder, whole.image, ".nii")
        patch(folder / inputs.image, 80 + 4 * axis, np.zeros(1, np.float32))
        rows = np.frombuffer((folder / inputs.image).read_bytes(), np.float32, 12, 280).reshape(3, 4).copy()
        rows[:, axis] = 0
        patch(folder / inputs.image, 280, rows)
        return inputs
    steps = (whole.image.direction * whole.image.spacing).T
    steps[axis] = 0
    header = {"space": "LPS", "space directions": steps, "space origin": whole.image.origin}
    nrrd.write(str(folder / "image.nrrd"), np.transpose(whole.image.array, (2, 1, 0)), header)
    return Inputs(image="image.nrrd")


@kind("file", "refused")
def not_an_image(random: Random, whole: Whole, folder: Path) -> Inputs:
    suffix = drawn(random)
    content = [b"", b"patient: J. Doe\n" * 40, bytes(random.integers(0, 256, 5000, dtype=np.uint8))]
    chosen = content[random.integers(3)]
    is_packed = suffix == ".nii.gz" and random.random() < 0.5
    (folder / f"image{suffix}").write_bytes(gzip.compress(chosen) if is_packed else chosen)
    return Inputs(image=f"image{suffix}")


@kind("file", "either", within_mm=2.5)
def file_bytes_flipped(random: Random, whole: Whole, folder: Path) -> Inputs:
    inputs = written(folder, whole.image, str(random.choice([".nii", ".nrrd", ".mha"])))
    content = bytearray((folder / inputs.image).read_bytes())
    for place in random.integers(0, 340, random.integers(1, 6)):
        content[place] ^= 1 << random.integers(8)
    (folder / inputs.image).write_bytes(bytes(content))
    return inputs
