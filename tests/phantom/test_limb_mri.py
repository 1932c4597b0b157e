"""The phantom's MRI: geometry that survives DICOM, contrast, noise, markers."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk  # noqa: N813

from limbfit.anatomy.grid import BONES
from limbfit.phantom.geometry import SKIN_AND_FAT, make_limb
from limbfit.phantom.mri import (
    BIAS,
    FULL_SCALE,
    MARKER_HEIGHT_MM,
    RESCALE_SLOPE,
    UTE,
    ScanGrid,
    generate_slabs,
    make_grid,
    write_series,
)
from limbfit.phantom.robot import build_markers, build_true_sites


@pytest.fixture(scope="module")
def limb():
    return make_limb(0)


@pytest.fixture(scope="module")
def whole(limb) -> ScanGrid:
    return make_grid(limb, "coarse", 0)


def take_slices(whole: ScanGrid, first: int, count: int) -> ScanGrid:
    origin = whole.origin + first * whole.spacing[2] * whole.direction[:, 2]
    return replace(whole, shape=(count, *whole.shape[1:]), origin=origin)


@pytest.fixture(scope="module")
def grid(limb, whole) -> ScanGrid:
    """The 90 mm about the knee, where all bones are."""
    return take_slices(whole, int((limb.shape.joint - 55.0) / whole.spacing[2]), 45)


@pytest.fixture(scope="module")
def markers(limb, grid):
    """Those of the slices, with some room around them."""
    found = build_markers(build_true_sites(limb, 0))
    heights = [(m.position - grid.origin) @ grid.direction[:, 2] / grid.spacing[2] for m in found]
    return [m for m, height in zip(found, heights) if 6 < height < grid.shape[0] - 7]


@pytest.fixture(scope="module")
def series(tmp_path_factory, limb, grid, markers) -> Path:
    folder = tmp_path_factory.mktemp("mri")
    write_series(folder / "plain", limb, grid, seed=0)
    write_series(folder / "markers", limb, take_slices(grid, 0, 3), markers, seed=0, number=2)
    return folder


def read(folder: Path) -> sitk.Image:
    reader = sitk.ImageSeriesReader()
    (uid,) = reader.GetGDCMSeriesIDs(str(folder))
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder), uid))
    return reader.Execute()


def rendered(limb, grid, markers=(), noise=UTE.noise) -> np.ndarray:
    return np.concatenate([signal for _, signal in generate_slabs(limb, grid, markers, 0, noise)])


@pytest.fixture(scope="module")
def clean(limb, grid) -> np.ndarray:
    return rendered(limb, grid, noise=0.0)


@pytest.fixture(scope="module")
def noisy(limb, grid) -> np.ndarray:
    return rendered(limb, grid)


@pytest.fixture(scope="module")
def points(grid) -> np.ndarray:
    return grid.points(*(slice(0, n) for n in grid.shape))


def test_dicom_keeps_the_oblique_geometry_exactly(series, grid) -> None:
    image = read(series / "plain")
    assert image.GetSize() == grid.shape[::-1]
    np.testing.assert_allclose(image.GetSpacing(), grid.spacing, atol=1e-9)
    np.testing.assert_allclose(image.GetOrigin(), grid.origin, atol=1e-9)
    np.testing.assert_allclose(np.array(image.GetDirection()).reshape(3, 3), grid.direction, atol=1e-11)
    index = (10, 20, 30)
    expected = grid.points(*(slice(i, i + 1) for i in index[::-1])).ravel()
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint(index), expected, atol=1e-3)


def test_the_axes_are_oblique_and_right_handed(grid) -> None:
    tilt = np.rad2deg(np.arccos(np.abs(np.diag(grid.direction)).min()))
    assert 6 < tilt < 20
    assert np.linalg.det(grid.direction) == pytest.approx(1.0)


def test_dicom_keeps_the_signal(series, noisy) -> None:
    image = sitk.GetArrayFromImage(read(series / "plain"))
    np.testing.assert_allclose(image, FULL_SCALE * noisy, atol=RESCALE_SLOPE / 2 + 1e-3)


def test_tags_are_those_of_one_mr_study_of_nobody(series) -> None:
    first, other = (
        pydicom.dcmread(next((series / name).glob("*.dcm")), stop_before_pixels=True)
        for name in ("plain", "markers")
    )
    assert first.SOPClassUID == pydicom.uid.MRImageStorage
    assert str(first.PatientName) == "PHANTOM"
    assert first.PatientBirthDate == ""
    assert first.StudyInstanceUID == other.StudyInstanceUID
    assert first.FrameOfReferenceUID == other.FrameOfReferenceUID
    assert first.SeriesInstanceUID != other.SeriesInstanceUID
    assert float(first.SpacingBetweenSlices) == pytest.approx(2.0)


def test_the_bright_layer_is_as_thick_as_skin_and_fat(grid, points, clean) -> None:
    fat = make_limb(0, SKIN_AND_FAT)
    image = rendered(fat, grid, noise=0.0)
    skin, bones = fat.skin(points), fat.bones(points)
    band = (skin < -4.2) & (skin > -4.8) & (bones > 8)
    assert fat.layers_mm == 6.0
    assert np.median(image[band]) > 1.6 * np.median(clean[band])


def test_contrast_is_that_of_an_ultra_short_echo(limb, clean, points) -> None:
    skin, bones = limb.skin(points), limb.bones(points)
    tibia, femur = limb.bone("tibia", points), limb.bone("femur", points)
    fat = np.median(clean[(skin < -1.2) & (skin > -1.8) & (bones > 6)])
    muscle = np.median(clean[(skin < -8) & (bones > 6)])
    cortex = np.median(clean[np.abs(tibia + limb.shape.cortex_mm["tibia"] / 2) < 0.4])
    marrow = np.median(clean[femur < -8])
    air = clean[skin > 6].max()
    assert air < 1e-9
    assert cortex < 0.6 * muscle < 0.5 * marrow < 0.5 * fat


def test_the_bias_field_is_smooth_and_within_its_bound(limb, clean, points) -> None:
    muscle = (limb.skin(points) < -8) & (limb.bones(points) > 6)
    field = clean[muscle] / 0.5
    assert field.std() > 0.03
    assert np.abs(field - 1).max() <= BIAS + 0.02


def test_the_outline_has_partial_volume_at_the_truth(limb, clean, points) -> None:
    """Through the outer half of the fat layer the signal falls through half of it at the true skin."""
    skin = limb.skin(points)
    at_skin = np.abs(skin) < 0.1
    fat = np.abs(skin + 1.5) < 0.1
    assert clean[at_skin].mean() == pytest.approx(0.5 * clean[fat].mean(), rel=0.1)


def test_noise_is_rician(limb, points, clean, noisy) -> None:
    air = noisy[limb.skin(points) > 8] / UTE.noise
    assert air.mean() == pytest.approx(np.sqrt(np.pi / 2), rel=0.01)  # Rayleigh
    assert air.std() == pytest.approx(np.sqrt(2 - np.pi / 2), rel=0.01)
    deep = (limb.skin(points) < -8) & (limb.bones(points) > 6)
    residual = noisy[deep] - clean[deep]
    assert residual.std() == pytest.approx(UTE.noise, rel=0.02)


def test_markers_are_bright_bumps_on_the_skin_and_change_nothing_else(
    limb, grid, clean, points, markers
) -> None:
    difference = rendered(limb, grid, markers, noise=0.0) - clean
    away = np.min([np.linalg.norm(points - m.position.astype(np.float32), axis=-1) for m in markers], axis=0)
    assert np.abs(difference[away > MARKER_HEIGHT_MM + 5]).max() < 1e-6
    assert len(markers) > 3
    for marker in markers:
        top = marker.position + 2.5 * marker.outward
        near = np.linalg.norm(points - top.astype(np.float32), axis=-1) < 2.5
        assert difference[near].max() > 0.5


def test_the_same_seed_gives_the_same_bytes_and_another_another(tmp_path, limb, grid) -> None:
    """Of 13 slices, which are more than are made at once."""

    def digest(name: str, seed: int) -> str:
        write_series(tmp_path / name, limb, take_slices(grid, 20, 13), seed=seed)
        files = sorted((tmp_path / name).iterdir())
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()

    assert digest("one", 0) == digest("again", 0) != digest("other", 1)


def test_every_bone_is_in_the_image(limb, whole) -> None:
    """Asked at every other voxel of each axis."""
    step = np.array(whole.spacing) * 2
    half = replace(whole, shape=tuple(n // 2 for n in whole.shape), spacing=tuple(step))
    points = half.points(*(slice(0, n) for n in half.shape))
    assert all((limb.bone(name, points) < 0).sum() * np.prod(step) > 8000 for name in BONES)
