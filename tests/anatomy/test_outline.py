"""The outline with what lies around and inside a limb in real images: supports, ghosts, air; CT and T1."""

from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813

from limbfit.anatomy.grid import BONES, FAT, Volume
from limbfit.anatomy.imaging import read_volume
from limbfit.anatomy.morphology import compute_depth
from limbfit.anatomy.segmentation.body import (
    find_bright_fat,
    find_limb_mask,
    is_ct,
    remove_supports,
    select_subcutaneous,
    smooth_image,
)
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.errors import ImageError
from limbfit.phantom.geometry import SKIN_AND_FAT, Limb, make_limb
from limbfit.phantom.mri import CONTRASTS, make_grid
from limbs import dice, write_dicom
from scanned import build_image

SEED = 2


@pytest.fixture(scope="module")
def limb() -> Limb:
    return make_limb(SEED, SKIN_AND_FAT)


@pytest.fixture(scope="module")
def grid(limb):
    """The 140 mm about the knee, where all bones are."""
    whole = make_grid(limb, "coarse", SEED)
    first = int((limb.shape.joint - 85.0) / whole.spacing[2])
    origin = whole.origin + first * whole.spacing[2] * whole.direction[:, 2]
    return replace(whole, shape=(70, *whole.shape[1:]), origin=origin)


@pytest.fixture(scope="module")
def images(limb, grid) -> dict[str, Volume]:
    return {name: build_image(limb, grid, seed=SEED, levels=levels) for name, levels in CONTRASTS.items()}


@pytest.fixture(scope="module")
def points(grid) -> np.ndarray:
    return grid.points(*(slice(0, n) for n in grid.shape))


@pytest.fixture(scope="module")
def inside(limb, points) -> np.ndarray:
    return limb.skin(points) < 0


def outline(image: Volume, array: np.ndarray) -> np.ndarray:
    """What is found of a limb in an image with these grey values."""
    changed = image.with_array(array)
    return find_limb_mask(changed, smooth_image(changed))


def on_a_table(image: Volume, inside: np.ndarray, level: float, thick_mm: float) -> Volume:
    """The limb pressed 2 mm into a slab that is as wide and as long as the image."""
    lowest = int(np.flatnonzero(inside.any(axis=(0, 2)))[-1])
    top = lowest - round(2.0 / image.spacing[1])
    array = image.array.copy()
    slab = np.zeros(array.shape, dtype=bool)
    slab[:, top : top + round(thick_mm / image.spacing[1])] = True
    array[slab & ~inside] = level
    return image.with_array(array)


@pytest.mark.slow
@pytest.mark.parametrize(("contrast", "level"), [("UTE", 0.6), ("T1", 1.0), ("CT", -80.0)])
def test_a_table_that_touches_the_limb_is_no_limb(limb, contrast, level):
    grid = make_grid(limb, "coarse", SEED)
    inside = limb.skin(grid.points(*(slice(0, n) for n in grid.shape))) < 0
    image = on_a_table(build_image(limb, grid, seed=SEED, levels=CONTRASTS[contrast]), inside, level, 12.0)
    labels = segment(image)
    assert dice(labels.limb, inside) > 0.985
    outside = labels.limb & ~inside
    assert outside.sum() < 0.012 * inside.sum()


def test_a_cushion_on_one_side_only(images, inside):
    image = on_a_table(images["UTE"], inside, 0.7, 20.0)
    array = image.array.copy()
    array[:, :, :38][~inside[:, :, :38]] = images["UTE"].array[:, :, :38][~inside[:, :, :38]]
    assert dice(outline(image, array), inside) > 0.985


def test_ghosts_of_the_limb_are_air(images, inside):
    """Copies along the phase direction at 6 % of the signal, as motion and flow make them."""
    image = images["UTE"]
    ghosts = 0.06 * (np.roll(image.array, 25, axis=1) + np.roll(image.array, -25, axis=1))
    found = outline(image, image.array + ghosts)
    assert dice(found, inside) > 0.985
    assert (found & ~inside).sum() < 0.01 * inside.sum()


def test_air_inside_belongs_to_the_limb(images, inside, points, limb):
    """Gas pockets of 8 mm and a channel along the limb leave no hole."""
    image, array = images["UTE"], images["UTE"].array.copy()
    local = limb.to_limb(points)
    pockets = np.zeros(inside.shape, dtype=bool)
    for centre in ((10.0, 25.0, 110.0), (-15.0, 30.0, 150.0)):
        pockets |= np.linalg.norm(local - np.array(centre), axis=-1) < 8.0
    pockets |= np.hypot(local[..., 0] - 5.0, local[..., 1] - 40.0) < 3.0
    pockets &= limb.skin(points) < -8.0
    array[pockets] = 0.01
    found = outline(image, array)
    assert pockets.sum() > 300
    assert found[pockets].all()
    assert dice(found, inside) > 0.985


def test_a_limb_without_supports_is_left_as_it_is(inside, images):
    assert np.array_equal(remove_supports(inside, images["UTE"]), inside)


@pytest.mark.parametrize(
    "contrast", ["CT", *(pytest.param(c, marks=pytest.mark.slow) for c in ("UTE", "T1"))]
)
def test_every_contrast_gives_limb_bones_and_fat(images, inside, limb, points, contrast):
    labels = segment(images[contrast])
    assert dice(labels.limb, inside) > 0.99
    for name in BONES:
        assert dice(labels.mask(name), limb.bone(name, points) < 0) > 0.93, name
    layer = inside & (limb.skin(points) > -limb.layers_mm)
    assert dice(labels.mask(FAT), layer) > 0.85
    assert labels.mask(FAT).sum() == pytest.approx(layer.sum(), rel=0.15)


def test_contrast_is_told_by_the_grey_values_and_must_not_contradict_them(images):
    assert is_ct(images["CT"])
    assert not is_ct(images["T1"], "T1")
    for image, stated in (("CT", "T1"), ("UTE", "CT")):
        with pytest.raises(ImageError, match=stated):
            segment(images[image], contrast=stated)


FULL_SCALE = 2000.0  # of MRI's grey values, of which air has none below zero


def test_an_overshoot_of_resampling_is_no_hounsfield_unit(images):
    """B-splines put voxels of MRI below -200; one there decides nothing, nor do a few thousand at -300."""
    slices = replace(images["T1"], array=images["T1"].array[20:40])
    image = slices.with_array(FULL_SCALE * (slices.array > 0.2))
    steps = (0.45 * image.spacing).tolist()
    size = [int(n / 0.45) for n in image.size]
    fine = sitk.Resample(
        image.to_sitk(), size, sitk.Transform(), sitk.sitkBSpline3, image.origin.tolist(), steps,
        image.direction.ravel().tolist(), 0.0,
    )  # fmt: skip
    resampled = Volume.from_sitk(fine)
    assert (resampled.array < -200).sum() > 1000
    assert not is_ct(resampled)
    few = image.array.copy()
    few.ravel()[:: few.size // 3000] = -300.0
    assert not is_ct(image.with_array(few))


def test_ct_is_told_by_its_air_wherever_a_window_cut_it_off(images):
    image = images["CT"]
    assert is_ct(image.with_array(np.clip(image.array, -500, 500)))
    outside = np.where(image.array < -900, -3024.0, image.array)  # beyond the circle of reconstruction
    outside[:, 10:-10, 10:-10] = image.array[:, 10:-10, 10:-10]
    assert is_ct(image.with_array(outside))
    narrow = image.with_array(np.clip(image.array, -250, 250))
    assert not is_ct(narrow)
    assert is_ct(narrow, "CT")


def test_the_dicom_modality_decides_and_must_not_be_contradicted(images, tmp_path):
    """An MR series with air at -1000, as of an offset, is MR; a CT without Hounsfield units is refused."""
    image = images["CT"]
    small = replace(image, array=np.rint(image.array[::12] + 1024), spacing=image.spacing * [1, 1, 12])
    for modality, intercept in (("MR", "-1024"), ("CT", "-1024"), ("CT", "0")):
        write_dicom(tmp_path / f"{modality}{intercept}", small, Modality=modality, RescaleIntercept=intercept)
    found = read_volume(tmp_path / "MR-1024")
    assert found.modality == "MR"
    assert (found.array < -900).mean() > 0.5
    assert not is_ct(found)
    assert is_ct(read_volume(tmp_path / "CT-1024"))
    with pytest.raises(ImageError, match="modality MR does not fit CT"):
        is_ct(found, "CT")
    with pytest.raises(ImageError, match="not Hounsfield units"):
        is_ct(read_volume(tmp_path / "CT0"))


def test_seeds_part_bones_that_were_found_as_one(images, limb):
    """A bridge of bone across the knee joins femur and tibia; a seed in each parts them in the gap."""
    image, array = images["CT"], images["CT"].array.copy()
    gap = limb.to_patient(np.array([5.0, 0.0, limb.shape.joint]))
    i, j, k = np.round(image.point_to_index(gap)).astype(int)
    array[k - 3 : k + 4, j - 2 : j + 3, i - 2 : i + 3] = 1300.0
    bridged = image.with_array(array)
    assert len(segment(bridged).bone_names) < len(BONES)
    low, high = (limb.to_patient(np.array([2.0, -4.0, limb.shape.joint + dz])) for dz in (-20.0, 30.0))
    labels = segment(bridged, seeds={"shin": [low], "thigh": [high]})
    assert labels.bone_names == ("shin", "thigh")
    heights = [limb.to_limb(labels.index_to_point(np.argwhere(labels.mask(name))[:, ::-1]))[:, 2]
               for name in labels.bone_names]  # fmt: skip
    assert heights[0].max() < limb.shape.joint + 6
    assert heights[1].min() > limb.shape.joint - 6


def test_a_seed_outside_every_bone_is_refused_with_its_place(images, limb):
    point = limb.to_patient(np.array([0.0, 40.0, 100.0]))
    with pytest.raises(ImageError, match="seed of 'tibia'"):
        segment(images["CT"], seeds={"tibia": [point]})


def fat_of(levels: np.ndarray, limb: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """The subcutaneous fat of a limb without bones."""
    bones, depth = np.zeros(limb.shape, dtype=bool), compute_depth(limb, spacing)
    bright = find_bright_fat(levels, limb, bones, depth, spacing)
    return select_subcutaneous(bright, limb, bones, depth, spacing)


def test_a_septum_is_no_subcutaneous_fat_and_a_vessel_in_the_fat_is():
    """A sheet of fat 2 mm thick that reaches in from the skin, fat deep between muscles, a dark vessel."""
    spacing, shape = np.ones(3), (20, 60, 60)
    j, i = np.mgrid[:60, :60]
    radius = np.hypot(j - 29.5, i - 29.5)
    limb = np.broadcast_to(radius < 27, shape).copy()
    layer = limb & (radius > 21)
    levels = np.where(layer, 2.0, 1.0).astype(np.float32) * limb
    septum = limb & (np.abs(i - 29.5) < 1) & (j > 30)
    deep = limb & (np.hypot(j - 24, i - 24) < 4)
    vessel = layer & (np.hypot(j - 29.5, i - 5.5) < 1.2)
    levels[septum | deep] = 2.0
    levels[vessel] = 0.1
    fat = fat_of(levels, limb, spacing)
    assert dice(fat, layer) > 0.95
    assert not fat[deep].any()
    assert not fat[septum & (radius < 18)].any()
    assert fat[vessel].all()


def test_dark_fat_far_from_the_coil_is_fat():
    """The signal falls to 40 % along the limb: fat at one end is darker than muscle at the other."""
    spacing = np.array([1.0, 1.0, 2.0])
    k, j, i = np.mgrid[:80, :60, :60]
    radius = np.hypot(j - 29.5, i - 29.5)
    limb, layer = radius < 27, (radius < 27) & (radius > 22)
    levels = (np.where(layer, 2.0, 1.0) * limb * (1 - 0.6 * k / 79)).astype(np.float32)
    fat = fat_of(levels, limb, spacing)
    for end in (slice(0, 10), slice(-10, None)):
        assert dice(fat[end], layer[end]) > 0.9
