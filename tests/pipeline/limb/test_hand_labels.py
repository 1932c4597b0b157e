"""Label maps corrected by hand, contours and seeds of a study: what the segment stage makes of them."""

import json
from pathlib import Path

import numpy as np
import pytest

from limbfit import run_study
from limbfit.anatomy.grid import LabelMap, Volume
from limbfit.anatomy.imaging import read_labels, write_labels, write_volume
from limbfit.errors import StudyError
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import make_grid
from limbfit.study import Study, load_study
from scanned import build_image
from stages import states

TEXT = """
[study]
name = "hand"
[image]
path = "image.nrrd"
{more}
[[sites]]
name = "a"
position = [0.0, 0.0, 0.0]
depth_mm = 5.0
"""


@pytest.fixture(scope="module")
def image() -> Volume:
    limb = make_limb(3)
    fine = build_image(limb, make_grid(limb, "coarse", 3), seed=3)
    return Volume(fine.array[30:100], fine.spacing, fine.index_to_point([0, 0, 30]), fine.direction)


@pytest.fixture
def folder(tmp_path: Path, image: Volume) -> Path:
    write_volume(tmp_path / "image.nrrd", image)
    return tmp_path


def study_of(folder: Path, more: str = "") -> Study:
    (folder / "study.toml").write_text(TEXT.format(more=more))
    return load_study(folder)


def segmented(study: Study) -> LabelMap:
    run_study(study, until="segment")
    return read_labels(study.results / "segment" / "labels.seg.nrrd")


def facts(study: Study) -> dict:
    return json.loads((study.results / "segment" / "segment.json").read_text())


def with_a_notch(labels: LabelMap) -> LabelMap:
    """The tibia as a user may correct it: its outermost third along i is soft tissue."""
    array = labels.array.copy()
    where = np.flatnonzero(labels.mask("tibia").any(axis=(0, 1)))
    notch = labels.mask("tibia")
    notch[:, :, : where[len(where) * 2 // 3]] = False
    array[notch] = labels.soft_value
    return labels.with_array(array)


@pytest.mark.slow
def test_hand_work_in_the_results_wins_and_survives(folder):
    """Saved over the stored map it is used through changed settings and repeated runs, and kept as it is."""
    study = study_of(folder)
    first = segmented(study)
    assert states(folder)["segment"] == "done"
    file = study.results / "segment" / "labels.seg.nrrd"
    corrected = with_a_notch(first)
    write_labels(file, corrected)
    saved = file.read_bytes()
    assert states(folder)["segment"] == "stale"
    for more in ("", "", "[segmentation]\nmin_bone_volume_mm3 = 900.0\n"):
        study = study_of(folder, more)
        assert np.array_equal(segmented(study).array, corrected.array)
        assert facts(study)["method"] == "corrected by hand"
        assert states(folder)["segment"] == "done"
    assert (study.results / "by-hand" / "labels.seg.nrrd").read_bytes() == saved
    (study.results / "by-hand" / "labels.seg.nrrd").unlink()
    assert np.array_equal(segmented(study).array, first.array)
    assert facts(study)["method"] == "automatic"


def test_hand_work_is_kept_where_the_study_names_labels(tmp_path):
    """What was corrected of the first is laid aside where it names others."""
    y, x = np.indices((20, 20)) - 9.5
    leg = np.repeat([np.where(np.hypot(x, y) < 9, 1, 0) + np.where(np.hypot(x, y) < 4, 1, 0)], 16, axis=0)
    made = LabelMap(leg, [4.0] * 3, np.zeros(3), np.eye(3), {1: "soft tissue", 2: "tibia"})
    write_volume(tmp_path / "image.nrrd", Volume(leg, *made.geometry))
    found = {}
    for name, labels in (("first", made), ("second", with_a_notch(with_a_notch(made)))):
        write_labels(tmp_path / f"{name}.seg.nrrd", labels)
        study = study_of(tmp_path, f'[segmentation]\nlabels = "{name}.seg.nrrd"\n')
        found[name] = segmented(study)
        assert np.array_equal(found[name].array, labels.array)
        if name == "first":
            write_labels(study.results / "segment" / "labels.seg.nrrd", with_a_notch(made))
    kept = read_labels(study.results / "by-hand" / "labels.seg.nrrd")
    assert np.array_equal(kept.array, with_a_notch(made).array)


@pytest.mark.slow
def test_contours_of_the_results_make_the_same_labels(folder):
    study = study_of(folder)
    first = segmented(study)
    (folder / "mine.csv").write_bytes((study.results / "segment" / "contours.csv").read_bytes())
    study = study_of(folder, '[segmentation]\ncontours = "mine.csv"\n')
    again = segmented(study)
    assert np.array_equal(again.array, first.array)
    assert facts(study)["method"] == "corrected by hand"
    assert (study.results / "segment" / "quality.png").stat().st_size > 10_000


@pytest.mark.slow
def test_seeds_choose_and_name_the_bones(folder):
    first = segmented(study_of(folder))
    k, j, i = np.argwhere(first.mask("fibula")).mean(axis=0)
    x, y, z = first.index_to_point([i, j, k])
    found = segmented(study_of(folder, f'[segmentation.seeds]\n"second bone" = [[{x}, {y}, {z}]]\n'))
    assert found.bone_names == ("second bone",)
    assert np.array_equal(found.mask("second bone"), first.mask("fibula"))


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ('[segmentation]\nlabels = "a.nrrd"\ncontours = "b.csv"\n', "either labels or contours"),
        ("[segmentation.seeds]\ntibia = []\n", "at least one point"),
        ('[segmentation]\ncontours = "b.csv"\n', "does not exist"),
        ('[segmentation]\ncontrast = "T2"\n', "segmentation.contrast"),
    ],
)
def test_what_contradicts_itself_is_refused(folder, more, expected):
    with pytest.raises(StudyError, match=expected):
        study_of(folder, more)
