"""Enhanced multi-frame DICOM, and the list of series."""

import json

import numpy as np
import pydicom
import pytest
from damaging import enhanced
from pydicom.dataset import Dataset
from pydicom.uid import EnhancedCTImageStorage

from limbfit.anatomy.images.dicom import describe_series
from limbfit.anatomy.imaging import read_volume
from limbfit.errors import ImageError
from limbs import DIRECTIONS, IDENTITY, volume, write_dicom

ORDER = [4, 0, 6, 2, 5, 1, 3]


@pytest.mark.parametrize("name", ["straight", "oblique", "permuted"])
def test_frames_are_sorted_by_position(tmp_path, name):
    image = volume(DIRECTIONS[name])
    back = read_volume(enhanced(tmp_path, image, ORDER))
    assert np.abs(back.affine - image.affine).max() < 1e-4
    assert np.array_equal(back.array, image.array)


def test_enhanced_ct_with_a_rescale_of_each_frame(tmp_path):
    image = volume(DIRECTIONS["oblique"])
    folder = enhanced(tmp_path, image, ORDER, Modality="CT", SOPClassUID=EnhancedCTImageStorage)
    data = pydicom.dcmread(folder / "frames")
    del data.SharedFunctionalGroupsSequence[0].PixelValueTransformationSequence
    stored = data.pixel_array.copy()
    for n, group in enumerate(data.PerFrameFunctionalGroupsSequence):
        values = Dataset()
        values.RescaleSlope, values.RescaleIntercept = str(0.5 / (n + 1)), "-3"
        group.PixelValueTransformationSequence = [values]
        stored[n] = stored[n] * (n + 1)
    data.PixelData = stored.tobytes()
    data.save_as(folder / "frames")
    assert np.allclose(read_volume(folder).array, image.array - 3, rtol=1e-6)


@pytest.mark.parametrize(
    ("order", "changes", "expected"),
    [
        ([0, 1, 2, 4, 5, 6], {}, "gap of 5.8 mm"),
        ([0, 1, 2, 2, 3, 4, 5, 6], {}, "same place"),
        (ORDER, {"NumberOfFrames": 6}, "where each of its frames lies"),
        (ORDER, {"PerFrameFunctionalGroupsSequence": []}, "where each of its frames lies"),
        (ORDER, {"PixelData": b"\0\0" * 12}, "cannot be decoded"),
        (ORDER, {"Modality": "US"}, "modality US"),
    ],
)
def test_incomplete_files_are_refused(tmp_path, order, changes, expected):
    with pytest.raises(ImageError, match=expected) as caught:
        read_volume(enhanced(tmp_path, volume(DIRECTIONS["oblique"]), order, **changes))
    assert not [secret for secret in IDENTITY.values() if secret in str(caught.value)]


def test_series_are_listed_with_what_is_wrong_and_without_identity(tmp_path):
    whole = write_dicom(tmp_path / "a", volume(DIRECTIONS["oblique"]), number=4)
    torn = write_dicom(tmp_path / "b" / "c", volume(np.eye(3)), number=5, skip=(3,))
    enhanced(tmp_path / "d", volume(np.eye(3)), ORDER, SeriesInstanceUID="1.2.9", Modality="CT")
    found = {row["uid"]: row for row in describe_series(tmp_path)}
    assert found[whole] | {"uid": ""} == {
        "uid": "",
        "number": "4",
        "modality": "MR",
        "slices": 7,
        "rows": 6,
        "columns": 5,
        "spacing_mm": [0.7, 1.3, 2.9],
        "whole": True,
        "why_not": None,
    }
    assert not found[torn]["whole"]
    assert "gap of 5.8 mm" in found[torn]["why_not"]
    assert (found["1.2.9"]["modality"], found["1.2.9"]["slices"], found["1.2.9"]["whole"]) == ("CT", 7, True)
    told = json.dumps(found)
    assert not [secret for secret in [*IDENTITY.values(), "DOEJANE"] if secret in told]


def test_the_command_lists_them_too(tmp_path, limbfit):
    uid = write_dicom(tmp_path, volume(DIRECTIONS["oblique"]), number=4)
    code, listed, _ = limbfit("series", tmp_path, "--json")
    assert code == 0
    assert json.loads(listed) == {"series": describe_series(tmp_path)}
    _, told, _ = limbfit("series", tmp_path)
    assert "series 4: MR, 7 slices of 6 x 5, 0.7 x 1.3 x 2.9 mm, whole" in told
    assert uid in told


def test_text_in_the_place_of_a_uid_is_not_told(tmp_path):
    write_dicom(tmp_path, volume(np.eye(3)), SeriesInstanceUID="JANEDOE", SeriesNumber="77", Modality="JANE")
    (row,) = describe_series(tmp_path)
    assert "JANE" not in json.dumps(row)
    with pytest.raises(ImageError, match="modality unknown"):
        read_volume(tmp_path, row["uid"])


def test_no_series_is_said(tmp_path):
    with pytest.raises(ImageError, match="no DICOM images"):
        describe_series(tmp_path)
    with pytest.raises(ImageError, match="no such folder"):
        describe_series(tmp_path / "none")
