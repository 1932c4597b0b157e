"""A study run again from its record."""

from __future__ import annotations

import json

import pytest

from conftest import COARSE
from limbfit import Progress, reproduce_study, run_study
from limbfit.errors import InputError
from limbfit.study import load_study


def quiet(event: Progress) -> None:
    """A listener that does nothing."""


def test_what_is_no_record_is_refused(study, tmp_path):
    with pytest.raises(InputError, match=r"no such record.*limbfit run"):
        reproduce_study(study, tmp_path / "again", listener=quiet)
    record = study / "results/run.json"
    record.parent.mkdir()
    for text in ("{", "[]", "{}"):
        record.write_text(text)
        with pytest.raises(InputError, match="not the record of a run"):
            reproduce_study(record, tmp_path / "again", listener=quiet)


@pytest.mark.slow
def test_a_study_comes_out_the_same_and_a_changed_one_is_refused(study, tmp_path):
    file = study / "study.toml"
    file.write_text(file.read_text() + COARSE)
    run_study(load_study(study), listener=quiet)
    record = study / "results/run.json"
    known = json.loads(record.read_text())
    known["versions"]["numpy"] = "1.0"
    record.write_text(json.dumps(known))
    found = reproduce_study(record, tmp_path / "again", listener=quiet)
    assert found["same"]
    assert max(found["parameters"].values()) == max(found["forces"].values()) == 0.0
    assert found["versions"]["numpy"][0] == "1.0"
    with pytest.raises(InputError, match="holds something else"):
        reproduce_study(record, study / "results", listener=quiet)
    file.write_text(file.read_text().replace("max_iterations = 2", "max_iterations = 3"))
    with pytest.raises(InputError, match="has changed since: calibration"):
        reproduce_study(record, tmp_path / "other", listener=quiet)
    (study / "1.csv").write_text((study / "1.csv").read_text() + "\n")
    with pytest.raises(InputError, match=r"has changed since: sites\.1\.trace"):
        reproduce_study(record, tmp_path / "other", listener=quiet)
