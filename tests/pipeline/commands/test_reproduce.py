"""A study run again from its record."""

import json
import re
import resource

import numpy as np
import pytest

from conftest import COARSE
from editing import append, edit, rewritten
from limbfit import reproduce_study, run_study
from limbfit.anatomy.grid import Volume
from limbfit.anatomy.imaging import read_volume, write_volume
from limbfit.errors import InputError
from limbfit.pipeline.commands.run import run_record
from limbfit.study import load_study
from stages import StoppedError, stop_at


def test_what_is_no_record_is_refused(study, tmp_path):
    with pytest.raises(InputError, match=r"no such record.*limbfit run"):
        reproduce_study(study, tmp_path / "again")
    record = study / "results/run.json"
    record.parent.mkdir()
    for text in ("{", "[]", "{}"):
        record.write_text(text)
        with pytest.raises(InputError, match="not the record of a run"):
            reproduce_study(record, tmp_path / "again")


def test_an_image_goes_with_its_voxels_and_a_study_by_any_name_into_no_folder_of_another(study, tmp_path):
    """A header of MetaImage, whose voxels lie in a file of their own; and a name with brackets."""
    image = Volume(np.zeros((5, 6, 7), dtype=np.float32), np.ones(3), np.zeros(3), np.eye(3))
    write_volume(study / "scan [1].mhd", image)
    text = (study / "study.toml").read_text()
    text = re.sub(r"\[surfaces\].*?\n(?=\[)", '[image]\npath = "scan [1].mhd"\n', text, flags=re.DOTALL)
    (study / "study.toml").unlink()
    (study / "limb.toml").write_text(text)
    named = load_study(study / "limb.toml")
    record = run_record(named).to_plain() | {"stages": {"calibrate": {}, "predict": {}}}
    named.results.mkdir()
    (named.results / "run.json").write_text(json.dumps(record))
    for _ in ("first", "the attempt goes on"):
        with pytest.raises(StoppedError):
            reproduce_study(study / "limb.toml", tmp_path / "again", listener=stop_at())
    other = tmp_path / "another"
    other.mkdir()
    (other / "study.toml").write_text("of another patient")
    for taken in (other, other / "study.toml", study):
        with pytest.raises(InputError, match="holds something else"):
            reproduce_study(study / "limb.toml", taken, listener=stop_at())
    assert (other / "study.toml").read_text() == "of another patient"
    again = load_study(tmp_path / "again")
    assert read_volume(again.path(again.image.path)).size == (7, 6, 5)
    write_volume(study / "scan [1].mhd", image.with_array(image.array + 1.0))
    with pytest.raises(InputError, match=r"has changed since: image\.path"):
        reproduce_study(study / "limb.toml", tmp_path / "other", listener=stop_at())


def test_an_attempt_that_was_ended_while_it_copied_goes_on(study, tmp_path):
    """As by a disk that is full: the study file is small, and every input is larger than may be written."""
    record = run_record(load_study(study)).to_plain() | {"stages": {"calibrate": {}, "predict": {}}}
    (study / "results").mkdir()
    (study / "results/run.json").write_text(json.dumps(record))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # Python ignores the signal
    try:
        with pytest.raises(OSError, match="too large"):
            reproduce_study(study, tmp_path / "again", listener=stop_at())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with pytest.raises(StoppedError):
        reproduce_study(study, tmp_path / "again", listener=stop_at())
    assert (tmp_path / "again/skin.stl").read_bytes() == (study / "skin.stl").read_bytes()


@pytest.mark.slow
def test_a_study_comes_out_the_same_and_a_changed_one_is_refused(study, tmp_path):
    append(study, COARSE)
    run_study(load_study(study))
    record = study / "results/run.json"
    with rewritten(record) as known:
        known["versions"]["numpy"] = "1.0"
    found = reproduce_study(record, tmp_path / "again")
    assert found["same"]
    assert max(found["parameters"].values()) == max(found["forces"].values()) == 0.0
    assert found["versions"]["numpy"][0] == "1.0"
    with pytest.raises(InputError, match="holds something else"):
        reproduce_study(record, study / "results")
    edit(study, "max_iterations = 2", "max_iterations = 3")
    with pytest.raises(InputError, match="has changed since: calibration"):
        reproduce_study(record, tmp_path / "other")
    (study / "1.csv").write_text((study / "1.csv").read_text() + "\n")
    with pytest.raises(InputError, match=r"has changed since: sites\.1\.trace"):
        reproduce_study(record, tmp_path / "other")
