"""DICOM folders: geometry kept, ambiguity and damage refused, identity never told."""

import numpy as np
import pytest
from pydicom.uid import generate_uid

from limbfit.anatomy.images.dicom import list_series
from limbfit.anatomy.imaging import read_volume
from limbfit.errors import ImageError
from limbs import CALF, DIRECTIONS, IDENTITY, volume, write_dicom


def refusal(folder, **options) -> str:
    """The text of the refusal, which names no person, date or file inside the folder."""
    with pytest.raises(ImageError) as caught:
        read_volume(folder, **options)
    text = str(caught.value) + repr(caught.value) + str(caught.value.__cause__)
    assert not [secret for secret in [*IDENTITY.values(), "DOEJANE"] if secret in text]
    assert "\n" not in str(caught.value)
    assert caught.value.remedy or "perpendicular" in text
    return str(caught.value)


@pytest.mark.parametrize("name", DIRECTIONS)
def test_no_voxel_moves_and_none_changes(tmp_path, name):
    """A flipped stack is read along its normal."""
    image = volume(DIRECTIONS[name])
    write_dicom(tmp_path, image)
    (tmp_path / "README.txt").write_text("not an image")
    back = read_volume(tmp_path)
    index = np.argwhere(np.ones(image.array.shape))[:, ::-1]
    there = np.rint(back.point_to_index(image.index_to_point(index))).astype(int)
    assert np.abs(back.index_to_point(there) - image.index_to_point(index)).max() < 1e-3
    assert np.array_equal(back.array[tuple(there[:, ::-1].T)], image.array.ravel())
    assert np.linalg.det(back.direction) > 0


def test_one_of_two_series_is_chosen_by_uid(tmp_path):
    first, second = volume(np.eye(3), seed=1), volume(DIRECTIONS["oblique"], seed=2)
    uids = [
        write_dicom(tmp_path, image, number=n, prefix=f"DOEJANE{n}")
        for n, image in enumerate((first, second), start=7)
    ]
    text = refusal(tmp_path)
    assert "2 series" in text
    assert all(uid in text for uid in uids)
    assert "series 7" in text
    assert np.array_equal(read_volume(tmp_path, uids[1]).array, second.array)
    assert "there are" in refusal(tmp_path, series_uid="1.2.3")


def test_a_missing_slice_is_named_by_its_gap(tmp_path):
    write_dicom(tmp_path, volume(DIRECTIONS["oblique"]), skip=(3,))
    text = refusal(tmp_path)
    assert "gap of 5.8 mm" in text
    assert "between slices 3 and 4 of 6" in text


def test_every_second_slice_missing_is_seen_by_the_stated_spacing(tmp_path):
    write_dicom(tmp_path, volume(np.eye(3)), skip=(1, 3, 5), SpacingBetweenSlices="2.9")
    assert "5.8 mm apart but were taken 2.9 mm apart" in refusal(tmp_path)


def test_doubled_slices_are_refused(tmp_path):
    uid = write_dicom(tmp_path, volume(np.eye(3)))
    write_dicom(tmp_path, volume(np.eye(3), seed=3), uid=uid, prefix="DOEJANE2", skip=(0, 1, 2, 4, 5, 6))
    assert "same place" in refusal(tmp_path)


def test_gantry_tilt_is_refused(tmp_path):
    image = volume(np.eye(3))
    write_dicom(
        tmp_path,
        image,
        ImagePositionPatient=lambda k: [f"{x:.6f}" for x in image.index_to_point([0, 0.5 * k, k])],
    )
    assert "tilt" in refusal(tmp_path)


def test_mixed_geometry_in_one_series_is_refused(tmp_path):
    sagittal = ["0", "1", "0", "0", "0", "-1"]
    scout = {"ImageOrientationPatient": lambda k: sagittal if k == 4 else ["1", "0", "0", "0", "1", "0"]}
    write_dicom(tmp_path / "a", volume(np.eye(3)), **scout)
    assert "differ in orientation" in refusal(tmp_path / "a")
    write_dicom(
        tmp_path / "b", volume(np.eye(3)), PixelSpacing=lambda k: ["1", "1"] if k == 2 else ["1", "2"]
    )
    assert "pixel spacing" in refusal(tmp_path / "b")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"Modality": "US"}, "modality US"),
        ({"ImagePositionPatient": None}, "where they lie"),
        ({"ImageOrientationPatient": ["1", "0", "0", "0.5", "0.9", "0"]}, "perpendicular"),
        ({"NumberOfFrames": 2}, "multi-frame"),
    ],
)
def test_other_modalities_and_impossible_geometry_are_refused(tmp_path, changes, expected):
    write_dicom(tmp_path, volume(np.eye(3)), **changes)
    assert expected in refusal(tmp_path)


def test_a_truncated_file_is_refused(tmp_path):
    write_dicom(tmp_path, volume(np.eye(3)))
    file = sorted(tmp_path.iterdir())[2]
    file.write_bytes(file.read_bytes()[:-40])
    assert "decoded" in refusal(tmp_path) or "damaged" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("prefix", "shown"),
    [("IM", " (IM_002.dcm)"), ("ser 4/slice", " (ser 4/slice_002.dcm)"), ("DOEJANE", ""), ("4711081", "")],
)
def test_a_damaged_file_is_named_by_its_number_and_by_a_name_that_is_nobodys(tmp_path, prefix, shown):
    folder = tmp_path / "mri"
    (folder / prefix).parent.mkdir(parents=True)
    write_dicom(folder, volume(np.eye(3)), prefix=prefix)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    files[2].write_bytes(files[2].read_bytes()[:200])
    told = f"{folder}: file 3 of {len(files)} by name{shown}: the DICOM file is cut short or damaged;"
    assert refusal(folder).startswith(told)
    assert (files[2].name in refusal(folder)) == bool(shown)


def test_what_a_system_leaves_beside_the_slices_is_passed_over(tmp_path):
    """A Mac writes a file ._NAME beside each on disks of another kind."""
    write_dicom(tmp_path, volume(DIRECTIONS["oblique"]))
    first = min(path.name for path in tmp_path.iterdir())
    (tmp_path / f"._{first}.dcm").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X" + bytes(4000))
    (tmp_path / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    assert len(list_series(tmp_path)) == 1


def test_folders_without_images_are_refused(tmp_path):
    assert "no DICOM images" in refusal(tmp_path)
    write_dicom(tmp_path, volume(np.eye(3)), skip=(0, 1, 2, 3, 4))
    assert "at least three slices" in refusal(tmp_path)


def test_an_anonymisers_uid_per_slice_is_one_series(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    write_dicom(tmp_path, image, SeriesInstanceUID=lambda k: generate_uid())
    assert len(list_series(tmp_path)) == 1
    assert np.array_equal(read_volume(tmp_path).array, image.array)


@pytest.mark.skipif(not CALF.is_dir(), reason="the calf MRI of shared/ is missing")
def test_the_calf_is_one_oblique_stack():
    calf = read_volume(CALF)
    assert calf.size == (288, 288, 56)
    assert np.allclose(calf.spacing, [0.4861, 0.4861, 3.0], atol=1e-4)
    assert np.allclose(calf.direction[:, 2], [-0.1016, -0.1664, 0.9808], atol=1e-4)
