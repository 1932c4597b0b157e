"""Images keep their place in the patient through every format, oblique and flipped axes included."""

import json
from dataclasses import replace

import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813

from limbfit.anatomy.imaging import LabelMap, Volume, read_labels, read_volume, write_volume
from limbfit.errors import ImageError, LabelError
from limbs import DIRECTIONS, volume

TOLERANCE_MM = 0.01


@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_affine_agrees_with_simpleitk(direction):
    image = volume(direction)
    foreign = image.to_sitk()
    for index in [(0, 0, 0), (4, 5, 6), (1, 0, 3)]:
        assert np.allclose(image.index_to_point(index), foreign.TransformIndexToPhysicalPoint(index))
        assert np.allclose(image.affine @ [*index, 1], [*image.index_to_point(index), 1])
        assert image.array[index[::-1]] == foreign[index]
    assert Volume.from_sitk(foreign).has_same_grid(image)


def test_point_to_index_is_the_inverse():
    image = volume(DIRECTIONS["flipped rows"])
    index = np.random.default_rng(0).uniform(-3, 9, size=(20, 3))
    assert np.allclose(image.point_to_index(image.index_to_point(index)), index)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".nrrd", ".mha", ".mhd"])
@pytest.mark.parametrize("direction", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_round_trip_through_files(tmp_path, suffix, direction):
    image = volume(direction)
    write_volume(tmp_path / f"image{suffix}", image)
    back = read_volume(tmp_path / f"image{suffix}")
    corner = np.array(image.size) - 1
    assert np.array_equal(back.array, image.array)
    assert np.abs(back.index_to_point(corner) - image.index_to_point(corner)).max() < TOLERANCE_MM
    assert back.has_same_grid(image)


@pytest.mark.parametrize("name", ["image.MHA", "image.MHD", "image.NRRD", "image.NII", "image.NII.GZ"])
def test_a_suffix_in_capitals_is_read(tmp_path, name):
    image = volume(DIRECTIONS["oblique"])
    write_volume(tmp_path / name.lower(), image)
    (tmp_path / name.lower()).rename(tmp_path / name)
    assert np.array_equal(read_volume(tmp_path / name).array, image.array)


def test_a_suffix_that_nifti_does_not_know_is_to_be_renamed(tmp_path):
    write_volume(tmp_path / "image.nii.gz", volume(np.eye(3)))
    (tmp_path / "image.nii.gz").rename(tmp_path / "image.nii.GZ")
    with pytest.raises(ImageError, match=r"rename it to end in \.nii\.gz"):
        read_volume(tmp_path / "image.nii.GZ")


def test_nifti_is_turned_from_ras_to_lps(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    affine = np.diag([2.0, 3.0, 4.0, 1.0])
    affine[:3, 3] = [10, 20, 30]
    array = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    nibabel.save(nibabel.Nifti1Image(array, affine), tmp_path / "ras.nii")
    image = read_volume(tmp_path / "ras.nii")
    ras = affine @ [2, 1, 3, 1]
    assert np.allclose(image.index_to_point([2, 1, 3]), ras[:3] * [-1, -1, 1])
    assert image.array[3, 1, 2] == array[2, 1, 3]


def two_forms(file, qform, sform, *, codes=(1, 1)):
    """A NIfTI file of a limb's size that says twice where it lies."""
    nibabel = pytest.importorskip("nibabel")
    image = nibabel.Nifti1Image(np.random.default_rng(0).random((20, 22, 24), np.float32), sform)
    image.header.set_xyzt_units("mm")
    image.set_qform(qform, codes[0])
    image.set_sform(sform, codes[1])
    image.to_filename(file)
    return file


def placed(turn, origin=(10.0, 20.0, 30.0)):
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn * [3.0, 2.0, 4.0], origin
    return affine


@pytest.mark.parametrize("turn", DIRECTIONS.values(), ids=DIRECTIONS.keys())
def test_nifti_whose_forms_agree_needs_no_word(tmp_path, turn):
    assert read_volume(two_forms(tmp_path / "a.nii.gz", placed(turn), placed(turn))).notes == ()


@pytest.mark.parametrize(
    ("codes", "used", "other"),
    [((1, 1), "sform", "qform"), ((1, 2), "qform", "sform")],
    ids=["scanner", "aligned"],
)
def test_nifti_whose_forms_differ_says_which_is_used(tmp_path, codes, used, other):
    turn = DIRECTIONS["oblique"]
    forms = {"qform": placed(turn), "sform": placed(turn, (40.0, 20.0, 30.0))}
    found = read_volume(two_forms(tmp_path / "a.nii", *forms.values(), codes=codes))
    assert found.affine == pytest.approx(np.diag([-1.0, -1.0, 1.0, 1.0]) @ forms[used], abs=1e-4)
    assert len(found.notes) == 1
    assert f"its qform and sform differ by up to 30.0 mm; the {used} is used" in found.notes[0]
    assert f"set the {used}'s code to 0, and the {other} is" in found.notes[0]
    # As it says: without the code it is the other that is read, and nothing is said.
    again = [0 if name == used else code for name, code in zip(forms, codes)]
    other_read = read_volume(two_forms(tmp_path / "b.nii", *forms.values(), codes=again))
    assert other_read.affine == pytest.approx(np.diag([-1.0, -1.0, 1.0, 1.0]) @ forms[other], abs=1e-4)
    assert other_read.notes == ()


def test_nifti_whose_forms_mirror_each_other_is_refused(tmp_path):
    turn = DIRECTIONS["oblique"]
    file = two_forms(tmp_path / "a.nii", placed(turn), placed(turn * [-1.0, 1.0, 1.0]))
    for read in (read_volume, read_labels):
        with pytest.raises(
            (ImageError, LabelError), match=r"mirror each other: left in one .*; convert .* code"
        ) as caught:
            read(file)
        assert str(file) in str(caught.value)


def test_nifti_without_a_stated_orientation_is_refused(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    bare = nibabel.Nifti1Image(np.ones((3, 4, 5), np.float32), np.eye(4))
    bare.set_qform(None, code=0)
    bare.set_sform(None, code=0)
    nibabel.save(bare, tmp_path / "bare.nii")
    with pytest.raises(ImageError, match="does not say how it lies"):
        read_volume(tmp_path / "bare.nii")


@pytest.mark.parametrize("space", [None, "scanner-xyz", "3D-right-handed", "3D-left-handed"])
def test_nrrd_without_a_space_of_the_patient_is_refused(tmp_path, space):
    header = {} if space is None else {"space": space, "space directions": np.eye(3)}
    nrrd.write(str(tmp_path / "bare.nrrd"), np.ones((3, 4, 5), np.float32), header)
    with pytest.raises(ImageError, match="does not say how it lies"):
        read_volume(tmp_path / "bare.nrrd")


def test_sheared_axes_are_refused(tmp_path):
    header = {
        "space": "left-posterior-superior",
        "space directions": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0.3, 1]]),
        "space origin": [0, 0, 0],
    }
    nrrd.write(str(tmp_path / "tilted.nrrd"), np.ones((3, 4, 5), np.float32), header)
    with pytest.raises(ImageError, match="orthonormal"):
        read_volume(tmp_path / "tilted.nrrd")


@pytest.mark.parametrize("name", ["nan.nrrd", "nan.nii", "nan.nii.gz", "nan.mha"])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_voxels_that_are_not_numbers_are_refused(tmp_path, name, value):
    image = volume(np.eye(3))
    array = image.array.copy()
    array[2, 3, 1] = value
    write_volume(tmp_path / name, image.with_array(array))
    with pytest.raises(ImageError, match="1 voxels are not numbers"):
        read_volume(tmp_path / name)


@pytest.mark.parametrize("name", ["none.nii.gz", "cut.nii.gz", "cut.nii", "cut.nrrd", "cut.mha", "words.txt"])
def test_missing_and_damaged_files_are_refused(tmp_path, name):
    if name.startswith("cut"):
        write_volume(tmp_path / name, volume(np.eye(3)))
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    elif name == "words.txt":
        (tmp_path / name).write_text(json.dumps({}))
    with pytest.raises(ImageError, match=name):
        read_volume(tmp_path / name)


def test_colour_and_flat_images_are_refused(tmp_path):
    colour = sitk.GetImageFromArray(np.zeros((3, 4, 5, 3), np.uint8), isVector=True)
    sitk.WriteImage(colour, str(tmp_path / "colour.mha"))
    with pytest.raises(ImageError, match="one grey value"):
        read_volume(tmp_path / "colour.mha")
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((4, 5), np.float32)), str(tmp_path / "flat.mha"))
    with pytest.raises(ImageError, match="three dimensions"):
        read_volume(tmp_path / "flat.mha")


def test_grids_differ_by_shape_and_by_place():
    image = volume(DIRECTIONS["oblique"])
    assert not image.has_same_grid(replace(image, array=image.array[:-1]))
    assert not image.has_same_grid(replace(image, origin=image.origin + np.array([0, 0.02, 0])))


@pytest.mark.parametrize("bad", [[1, 1], [1, 1, 0], [1, 1, np.nan]])
def test_spacing_must_be_three_lengths(bad):
    with pytest.raises(ImageError, match="spacing"):
        Volume(np.zeros((2, 2, 2)), bad, [0, 0, 0], np.eye(3))


def test_labels_must_be_small_whole_numbers():
    with pytest.raises(LabelError, match="whole numbers"):
        LabelMap(np.full((2, 2, 2), 0.5), [1, 1, 1], [0, 0, 0], np.eye(3))
