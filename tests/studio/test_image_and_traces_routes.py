"""Labels painted and times stated through the studio: what is stored, turns stale, and is refused."""

import os
import shutil
import subprocess
import sys

import nrrd
import numpy as np
import pytest
from limb_image import make_segmented
from serving_here import open_page

from editing import append, edit
from limbfit import run_study
from limbfit.anatomy.imaging import read_labels
from limbfit.pipeline.engine.store import lock
from limbfit.studio.folder import StudyFolder
from limbfit.studio.processes import find_running, stop_run
from limbfit.study import load_study
from stages import states


@pytest.fixture(scope="module")
def segmented(tmp_path_factory):
    return make_segmented(tmp_path_factory.mktemp("segmented"))


@pytest.fixture
def limb(segmented, tmp_path):
    return shutil.copytree(segmented, tmp_path / "limb")


def in_page_order(labels) -> np.ndarray:
    """Flat, counted to the right, then to the front, then up."""
    return labels.align_axes(np.diag([-1.0, -1.0, 1.0])).array.ravel()


def test_painted_voxels_and_no_others_change(limb):
    client, file = open_page(limb), limb / "results" / "segment" / "labels.seg.nrrd"
    before = read_labels(file)
    facts = client.get("/api/image").json()["labels"]
    tibia = next(row["value"] for row in facts["names"] if row["name"] == "tibia")
    start = int(np.flatnonzero(in_page_order(before) == 1)[5000])
    runs = [[start, 7, tibia], [start + 20, 3, 0]]
    answer = client.post("/api/image/labels", json={"base": facts["base"], "runs": runs}).json()
    expected = in_page_order(before).copy()
    expected[start : start + 7] = tibia
    expected[start + 20 : start + 23] = 0
    after = read_labels(file)
    assert np.array_equal(in_page_order(after), expected)
    assert answer["changed_voxels"] == (expected != in_page_order(before)).sum() > 0
    assert after.has_same_grid(before)
    assert after.names == before.names
    assert states(limb)["segment"] == "stale"
    assert client.get("/api/stages").json()["stages"][0]["state"] == "stale"
    run_study(load_study(limb), until="segment")
    kept = read_labels(limb / "results" / "by-hand" / "labels.seg.nrrd")
    assert np.array_equal(in_page_order(kept), expected)


def test_labels_painted_on_others_are_refused(limb):
    client, file = open_page(limb), limb / "results" / "segment" / "labels.seg.nrrd"
    base = client.get("/api/image").json()["labels"]["base"]
    size = read_labels(file).array.size
    for runs, why in (([[size - 1, 2, 1]], "outside of the label map"), ([[0, 1, 200]], "no label 200")):
        answer = client.post("/api/image/labels", json={"base": base, "runs": runs})
        assert answer.status_code == 422
        assert why in answer.json()["error"]
    asked = {"base": base, "runs": [[0, 1, 1]]}
    with lock(limb / "results"):
        answer = client.post("/api/image/labels", json=asked)
        assert answer.status_code == 409
        assert "a run of this study is in progress" in answer.json()["error"]
    assert client.post("/api/image/labels", json=asked).status_code == 200
    second = client.post("/api/image/labels", json=asked)
    assert second.status_code == 409
    assert "have changed since they were opened" in second.json()["error"]


def test_the_studys_own_labels_stay_as_they_are(limb):
    """Where the study names a label map, the corrected one is put beside it and named instead."""
    given = limb / "given.seg.nrrd"
    shutil.copy(limb / "results" / "segment" / "labels.seg.nrrd", given)
    file = limb / "study.toml"
    edit(limb, "[image]", '[segmentation]\nlabels = "given.seg.nrrd"\n\n[image]')
    run_study(load_study(limb), until="segment")
    client, before = open_page(limb), given.read_bytes()
    base = client.get("/api/image").json()["labels"]["base"]
    answer = client.post("/api/image/labels", json={"base": base, "runs": [[0, 1, 1]]}).json()
    assert answer["saved_to"] == "corrected.seg.nrrd"
    assert given.read_bytes() == before
    assert load_study(limb).segmentation.labels.name == "corrected.seg.nrrd"
    assert "# made for this test" in file.read_text()
    assert in_page_order(read_labels(limb / "corrected.seg.nrrd"))[0] == 1
    assert client.get("/api/image").json()["labels"]["base"] == answer["base"]


def test_image_and_labels_lie_where_the_study_has_them(limb, tmp_path):
    """What the page is given is LPS of the study turned to RAS, voxel for voxel."""
    client = open_page(limb)
    for what in ("volume", "labels"):
        (tmp_path / f"{what}.nii").write_bytes(client.get(f"/api/image/{what}").content)
    shown = read_labels(tmp_path / "labels.nii")
    stored = read_labels(limb / "results" / "segment" / "labels.seg.nrrd")
    assert np.array_equal(shown.array, stored.align_axes(np.diag([-1.0, -1.0, 1.0])).array)
    corner = [0.0, 0.0, 0.0]
    assert np.allclose(
        shown.index_to_point(corner),
        stored.align_axes(np.diag([-1.0, -1.0, 1.0])).index_to_point(corner),
        atol=1e-3,
    )
    header = nrrd.read_header(str(limb / "image.nrrd"))
    assert sorted(header["sizes"]) == sorted(shown.size)


def test_stated_times_are_stored_beside_the_comments(study):
    file = study / "study.toml"
    edit(study, 'trace = "1.csv"', 'trace = "1.csv"  # by the robot')
    append(study, "[traces]\nsmoothing = 0.1\n")
    run_study(load_study(study), until="traces")
    client = open_page(study)
    found = client.get("/api/traces/1").json()
    later = found["facts"]["touch_down_s"] + 0.25
    seen = client.post("/api/traces/1/preview", json={"touch_down_s": later}).json()
    assert seen["facts"]["touch_down_s"] == pytest.approx(later, abs=1e-4)
    assert load_study(study).site("1").touch_down_s is None
    client.post("/api/traces/1", json={"touch_down_s": later, "peak_s": 5.7})
    stored = load_study(study).site("1")
    assert stored.touch_down_s == pytest.approx(later, abs=1e-4)
    assert stored.peak_s == 5.7
    assert "# by the robot" in file.read_text()
    assert states(study)["traces"] == "stale"
    run_study(load_study(study), until="traces")
    facts = StudyFolder(file).store.results.traces.to_plain()["sites"]["1"]
    assert facts["touch_down_s"] == stored.touch_down_s
    assert facts["peak_s"] == pytest.approx(5.7)
    client.post("/api/traces/1", json={})
    assert "touch_down_s" not in file.read_text()


def test_times_off_the_record_leave_the_study_as_it_is(study):
    before, client = (study / "study.toml").read_bytes(), open_page(study)
    for times in ({"touch_down_s": 99.0}, {"peak_s": 0.0}, {"touch_down_s": 5.0, "peak_s": 4.0}):
        answer = client.post("/api/traces/1", json=times)
        assert answer.status_code == 422, times
        assert "\n" not in answer.json()["error"]
    assert (study / "study.toml").read_bytes() == before


def test_who_runs_a_study_is_read_from_its_lock(study):
    """Whoever holds it, also without the studio; what is no limbfit command is not interrupted."""
    folder = StudyFolder(study / "study.toml")
    assert find_running(folder) is None
    with lock(study / "results"):
        assert find_running(folder)["process"] == os.getpid()
        if "limbfit" not in " ".join(sys.argv[:2]):
            with pytest.raises(Exception, match="is no limbfit command; end it where it runs"):
                stop_run(folder)
    assert find_running(folder) is None
    (study / "results" / ".lock").touch()
    holder = study / "results" / ".holder"
    holder.write_text(f"process {os.getpid()} (since 2026-01-01 00:00 UTC)")
    assert find_running(folder) is None  # it lives, and holds nothing
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    holder.write_text(f"process {ended.pid} (since 2026-01-01 00:00 UTC)")
    assert find_running(folder) is None
