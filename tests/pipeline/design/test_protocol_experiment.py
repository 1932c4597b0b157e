"""The records of a session, chosen by the solver's derivatives, stored and written as a study's tables."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

import limbfit
from conftest import COARSE
from limbfit.errors import InputError
from limbfit.identify.checks.design import sample_tissues
from limbfit.pipeline.design.protocol import DESIGNED, PLAIN, UNSEEN
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.search import build_problem
from limbfit.report.sections.design import make_protocol_section
from limbfit.report.store import load_store

SESSION = {"minutes": 6, "depths_mm": (3.0,), "holds_s": (0, 10), "draws": 1}
BALL = '[indenters.ball]\nshape = "sphere"\nwidth_mm = 12.0\n[acquire]\nforce_limit_N = 45.0\n'


@pytest.fixture(scope="module")
def found(pristine: Path):
    """A site, two indenters, two speeds, held or not: what fits into six minutes, and its study."""
    file = pristine / "study.toml"
    one, _, _ = file.read_text().rpartition("[[sites]]")
    file.write_text(one + COARSE + BALL)
    study = limbfit.load_study(pristine)
    return study, limbfit.plan_protocol(study, **SESSION)


def test_the_session_keeps_its_time_and_tells_more_than_plain_ramps(found) -> None:
    _, content = found
    rows = {row["design"]: row for row in content["protocols"]}
    places = {(row["site"], row["indenter"]) for row in content["records"]}
    seconds = sum(row["seconds"] for row in content["records"]) + 60.0 * len(places)
    assert rows[DESIGNED]["minutes"] == pytest.approx(seconds / 60.0)
    assert seconds <= 360.0 < sum(row["seconds"] for row in content["candidates"]) + 120.0
    designed, plain = rows[DESIGNED], rows[PLAIN]
    assert plain["records"] == 1
    assert all(designed["factor_95"][name] < plain["factor_95"][name] for name in plain["factor_95"])
    for name in ("without holds", "at one speed", "with one indenter"):
        assert designed["cost"] <= rows[name]["cost"] + 1e-9


def test_several_depths_are_chosen_from(found) -> None:
    """A plain ramp is at the depth that is nearest to the site's own."""
    study, _ = found
    more = limbfit.plan_protocol(
        study, minutes=6, depths_mm=(3.0, 9.0), speeds_mm_s=(0.96,), holds_s=(0,), draws=1
    )
    assert sorted({row["depth_mm"] for row in more["candidates"]}) == [3.0, 9.0]
    rows = {row["design"]: row for row in more["protocols"]}
    assert rows[DESIGNED]["cost"] <= rows["at one depth"]["cost"] + 1e-9
    assert rows[PLAIN]["records"] == 1
    (plain,) = (row for row in more["candidates"] if (row["indenter"], row["depth_mm"]) == ("indenter", 3.0))
    assert rows[PLAIN]["minutes"] == pytest.approx(1.0 + plain["seconds"] / 60.0)


def test_what_is_to_be_determined_is_determined_better(found) -> None:
    study, content = found
    name = "muscle.tau_s"
    own = limbfit.plan_protocol(study, **SESSION, determine=(name,), criterion="A")
    best, every = own["protocols"][0], content["protocols"][0]
    assert best["design"] == every["design"] == DESIGNED
    assert best["factor_95"][name] <= every["factor_95"][name] + 1e-9
    assert own["determine"] == [name]


def test_the_records_are_a_study_s_own(found, tmp_path) -> None:
    study, _ = found
    content = limbfit.plan_protocol(study, **SESSION)
    text = (Path(content["folder"]) / "records.toml").read_text()
    tables = tomllib.loads(text)["records"]
    assert len(tables) == len(content["records"])
    whole = study.file.read_text().replace('trace = "1.csv"\n', "")
    planned = study.file.with_name("planned.toml")
    planned.write_text(whole + text)
    again = limbfit.load_study(planned, recorded=False)
    assert [one.name for one in limbfit.waiting(again)] == [f"1-{row['name']}" for row in tables]
    for row, one in zip(content["records"], again.recorded, strict=True):
        assert (one.indenter or "indenter", one.hold_s) == (row["indenter"], row["hold_s"])
        assert one.depth_mm == pytest.approx(row["depth_mm"], abs=1e-3)


def test_the_tissues_lie_within_bounds_and_about_what_is_known(found) -> None:
    study, _ = found
    problem = build_problem(study)
    known = problem.unknowns
    tissues = sample_tissues(known, problem.space, known.start, 64, seed=1)
    assert np.array_equal(tissues[0], known.start)
    assert (tissues >= known.lower).all()
    assert (tissues <= known.upper).all()
    assert np.median(np.log(tissues[1:] / known.start), axis=0) == pytest.approx(0.0, abs=0.4)
    assert len(np.unique(tissues, axis=0)) == 64


def test_what_cannot_be_planned_is_one_line(found) -> None:
    study, _ = found
    same = SESSION | {"depths_mm": np.array([3.0]), "holds_s": np.array([0, 10])}
    with pytest.raises(InputError, match="no record fits into 1 min"):
        limbfit.plan_protocol(study, **same | {"minutes": 1})
    with pytest.raises(InputError, match=r"no parameter is named 'bone\.c_kPa'"):
        limbfit.plan_protocol(study, determine=("bone.c_kPa",), **same)
    with pytest.raises(InputError, match=r"no current socket.*run limbfit socket"):
        limbfit.plan_protocol(study, determine=("socket",), **same)


def test_it_is_in_the_report(found) -> None:
    study, _ = found
    content = limbfit.plan_protocol(study, **SESSION)
    section = make_protocol_section(load_store(study.results), Store(study.results).results.protocol)
    assert section.title == "Which records to make"
    assert any(
        content["verdict"].split(";")[0] in block.text for block in section.blocks if block.kind == "prose"
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "sd", "end"),
    [
        ("ultrasound_sd_mm", 0.1, "layers"),
        ("surface_sd_mm", 0.05, "surface"),
        ("shear_waves_sd_m_s", 0.1, "waves"),
    ],
)
def test_what_is_seen_tells_more_in_the_same_time(found, key: str, sd: float, end: str) -> None:
    study, content = found
    seen = limbfit.plan_protocol(study, **SESSION | {"holds_s": (0,), key: sd})
    rows = {row["design"]: row for row in seen["protocols"]}
    assert rows[DESIGNED]["cost"] < rows[UNSEEN]["cost"]
    plain = {row["design"]: row for row in content["protocols"]}[PLAIN]
    assert rows[PLAIN]["factor_95"] == pytest.approx(plain["factor_95"], rel=1e-6)
    (record, *_) = tomllib.loads((Path(seen["folder"]) / "records.toml").read_text())["records"]
    assert (record[key.partition("_sd")[0]], record[key]) == (f"records/1-1-{end}.csv", sd)
