"""Several relaxation terms in a study: named, bounded, searched, shown."""

from itertools import pairwise

import pytest

from editing import write_study
from guide import identified
from limbfit.errors import StudyError
from limbfit.fe import OgdenQLV
from limbfit.indentation import build_materials
from limbfit.laws import LAWS, MAX_RELAXATION_TERMS, TissueLaw, is_ogden
from limbfit.report.formats import format_symbol, format_unit

TEXT = """
[study]
name = "terms"
[surfaces]
skin = "skin.stl"
[material]
law = "{law}"
{more}
[calibration]
priors = "population"
tied = [["skin.tau2_s", "muscle.tau2_s"]]
[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [0.0, 0.0, 0.0]
"""
TRUTH = {"c_kPa": 6.0, "m": 5.0, "gamma1": 1.6, "tau1_s": 0.12, "gamma2": 0.9, "tau2_s": 2.2}


def study_of(folder, law="ogden-prony2", more=""):
    return write_study(folder, TEXT.format(law=law, more=more))


@pytest.mark.parametrize("terms", range(1, MAX_RELAXATION_TERMS + 1))
def test_terms_share_out_the_times_and_the_amplitude_of_one(terms):
    law, one = LAWS["ogden" if terms == 1 else f"ogden-prony{terms}"], LAWS["ogden"]
    assert is_ogden(law.name)
    times = [p for p in law.parameters if p.name.startswith("tau")]
    amplitudes = [p for p in law.parameters if p.name.startswith("gamma")]
    assert len(times) == len(amplitudes) == terms
    assert (times[0].lower, times[-1].upper) == (one.parameters[3].lower, one.parameters[3].upper)
    assert all(a.upper == b.lower for a, b in pairwise(times))
    assert all(p.lower < p.start < p.upper for p in law.parameters)
    assert sum(p.start for p in amplitudes) == pytest.approx(one.parameters[2].start)
    assert TissueLaw.of_record(law.record()) == law


def test_a_study_with_two_terms_has_their_parameters_and_materials(tmp_path):
    study = study_of(tmp_path, more="start = { tau2_s = 3.0 }")
    assert [name for tissue, name in study.parameters if tissue == "skin"] == list(TRUTH)
    assert study.material.get("skin", "start")["tau2_s"] == 3.0
    assert {"skin.c_kPa", "muscle.m"} <= study.priors.keys()  # what is known of people holds for all of them
    made = build_materials({"skin": TRUTH}, 80.0, study.law.name)["skin"]
    assert made == OgdenQLV(0.006, 5.0, (1.6, 0.9), (0.12, 2.2), 80.0)
    assert made.parameter_names == tuple(p.name for p in study.law.parameters)


@pytest.mark.parametrize(
    ("law", "more", "what"),
    [
        ("ogden-prony7", "", "no tissue law is named 'ogden-prony7'; use ogden, ogden-prony2"),
        ("ogden-prony2", "start = { tau_s = 1.0 }", "tau_s is no parameter of the law"),
        ("ogden-prony2", "start = { tau1_s = 1.0 }", "start.tau1_s lies outside its bounds"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, law, more, what):
    with pytest.raises(StudyError, match=what) as refused:
        study_of(tmp_path, law, more)
    assert "study.toml" in str(refused.value)


def test_symbols_have_their_numbers_below():
    assert [format_symbol(key) for key in ("tau_s", "tau2_s", "gamma1", "c_kPa")] == ["τ", "τ₂", "γ₁", "c"]
    assert format_unit("tau2_s") == "s"


@pytest.mark.slow
def test_a_study_identifies_two_terms(tmp_path):
    found = identified(tmp_path, None, '[material]\nlaw = "ogden-prony2"\n', TRUTH, within=0.1)
    assert found["law"]["words"] == "second-order Ogden with 2 relaxation terms"
