"""Relaxation as a power of time: its terms, a study that asks for it, FEBio's files."""

import os
from dataclasses import replace

import numpy as np
import pytest

from completing import complete
from editing import list_stale
from guide import identified
from layered import block_context, block_study, check_derivative
from limbfit.bench.timing import build_punched_block
from limbfit.errors import InputError, StudyError
from limbfit.fe import OgdenPower, OgdenQLV, solve
from limbfit.febio import (
    FebSettings,
    build_result,
    find_febio,
    read_feb,
    run_febio,
    to_problem,
    write_feb,
    write_inp,
)
from limbfit.indentation import SimulationJob, simulate
from limbfit.indentation.sites import build_site_materials
from limbfit.laws import LAWS, POWER, TissueLaw
from limbfit.pipeline.commands.other_solvers import check_export
from limbfit.pipeline.engine.store import write_json
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.simulation.simulations import compute_job_digest
from limbfit.relaxation import DEFAULT_SPAN_S, choose_relaxation_times, compute_power_law_terms
from limbfit.report.sections.methods import write_method_parts
from limbfit.report.store import load_store
from limbfit.results.identification import CalibrationResult

LAW = f'law = "{POWER}"\n'
SPAN = "relaxation_span_s = [0.05, 50.0]\n"
VALUES = {"c_kPa": 4.0, "m": 5.0, "gamma": 0.4, "slope": 0.2}
TRUTH = {"skin": VALUES | {"c_kPa": 7.0}, "muscle": VALUES}


@pytest.mark.parametrize(("last_s", "count"), [(30.0, 5), (300.0, 5), (301.0, 6), (3000.0, 6), (3e5, 6)])
def test_times_are_even_in_the_logarithm_and_no_more_than_febio_takes(last_s, count):
    times = choose_relaxation_times(0.03, last_s)
    assert len(times) == count
    assert (times[0], times[-1]) == pytest.approx((0.03, last_s))
    np.testing.assert_allclose(np.diff(np.log(times), 2), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("first_s", "last_s"), [(3.0, 1.0), (0.0, 1.0), (1.0, 2e7), (1.0, np.inf), (np.nan, 1.0)]
)
def test_times_that_span_no_range_are_refused(first_s, last_s):
    with pytest.raises(InputError, match="span no range; give two that are positive and grow"):
        choose_relaxation_times(first_s, last_s)


@pytest.mark.parametrize("slope", [0.05, 0.2, 0.4])
def test_a_term_a_decade_relaxes_as_the_spectrum_that_it_stands_for(slope):
    """Beside a thousand terms a decade, from half a decade before the first time to as far after the last."""
    few = choose_relaxation_times(*DEFAULT_SPAN_S)
    many = few[:, None] * 10.0 ** ((np.arange(1000) - 499.5) / 1000.0)
    times = np.geomspace(0.3, 300.0, 200)

    def relaxation(tau):
        return np.exp(-times[:, None] / tau.ravel()) @ compute_power_law_terms(0.4, slope, tau.ravel())

    np.testing.assert_allclose(1.0 + relaxation(few), 1.0 + relaxation(many) / 1000.0, rtol=0.02)


def test_terms_without_end_are_a_power_of_time():
    times, tau = np.geomspace(0.1, 1e3, 50), 10.0 ** np.arange(-8.0, 40.0)
    found = np.exp(-times[:, None] / tau) @ compute_power_law_terms(1.0, 0.25, tau)
    assert np.ptp(np.log(found * times**0.25)) < 0.04  # waves of 1.5 % either way


def test_a_study_has_its_times_and_tissues(tmp_path):
    study = block_study(tmp_path, LAW + SPAN)
    assert [key for tissue, key in study.parameters if tissue == "skin"] == list(VALUES)
    assert study.law.relaxation_times_s == pytest.approx((0.05, 0.281, 1.581, 8.89, 50.0), rel=1e-3)
    assert TissueLaw.of_record(study.law.record()) == study.law
    assert "relaxation_times_s" not in LAWS["ogden"].record()
    wide = block_study(tmp_path, LAW)
    assert wide.law.relaxation_times_s == pytest.approx((0.03, 0.3, 3.0, 30.0, 300.0, 3000.0))
    assert list_stale(wide, study) == {"calibrate", "predict", "report"}


def test_force_of_a_study_follows_its_law_by_its_derivatives(tmp_path):
    study = block_study(tmp_path, LAW + SPAN)
    context = block_context(study, TRUTH)
    model = build_model(context, study.recorded[0])
    made = build_site_materials(model, TRUTH)["muscle"]
    assert made == OgdenPower(0.004, 5.0, 0.4, 0.2, study.law.relaxation_times_s)
    times = (0.5 * model.knots_s[1], model.knots_s[1], 1.5 * model.knots_s[1])
    flat, names = study.vector(TRUTH), [name for _, name in study.parameters]
    job = SimulationJob(model, study.tissues, tuple(flat), times)
    other = replace(job, model=replace(model, relaxation_span_s=DEFAULT_SPAN_S))
    assert compute_job_digest(job) != compute_job_digest(other)
    found = simulate(job)
    assert found.completed, found.reason
    step = np.where(np.isin(names, ("gamma", "slope")), 1e-4 * flat, 0.0)
    check_derivative(job, found, step, 2e-3)


@pytest.mark.parametrize(
    ("material", "what"),
    [
        (LAW + "start = { slope = -0.2 }", r"start\.slope: Input should be greater than 0"),
        (LAW + "start = { slope = 0.7 }", r"start\.slope lies outside its bounds"),
        (
            LAW + "start = { tau_s = 1.0 }",
            "tau_s is no parameter of the law; they are c_kPa, m, gamma, slope",
        ),
        (LAW + "relaxation_span_s = [50.0, 0.05]", "relaxation times from 50 to 0.05 s span no range"),
        (SPAN, r"the tissues' law does not relax as a power of time.*ogden-power"),
        ('law = "ogden-powers"', "no tissue law is named 'ogden-powers'; use .*ogden-power"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, material, what):
    with pytest.raises(StudyError, match=what) as refused:
        block_study(tmp_path, material)
    assert "study.toml" in str(refused.value)


def test_people_are_described_by_another_law(tmp_path):
    with pytest.raises(StudyError, match='people are described by the law "ogden"'):
        block_study(tmp_path, LAW, '[calibration]\npriors = "population"')


def exported(folder, tissue, divisions=4):
    problem = build_punched_block("tet4", divisions)
    problem = replace(problem, materials={"skin": tissue, "muscle": OgdenQLV(0.006, 4.0, 0.5, 1.1)})
    write_feb(problem, folder / "model.feb", FebSettings())
    return problem


def test_its_terms_are_written_for_other_programs(tmp_path):
    tissue = OgdenPower(0.004, 5.0, 0.4, 0.2)
    problem = exported(tmp_path, tissue)
    back = to_problem(read_feb(tmp_path / "model.feb")).materials["skin"]
    gamma, tau = zip(*tissue.prony, strict=True)
    assert len(tau) == 6
    assert back == OgdenQLV(0.004, 5.0, gamma, tau)
    write_inp(problem, tmp_path / "model.inp", "abaqus", FebSettings())
    text = (tmp_path / "model.inp").read_text(encoding="utf-8")
    ours = text.split("*VISCOELASTIC, TIME=PRONY\n")[1].split("*")[0].split()
    assert len(ours) == 3 * 6
    assert float(ours[0].rstrip(",")) == pytest.approx(gamma[0] / (1.0 + sum(gamma)))


def test_febio_does_not_fit_it(tmp_path):
    study = block_study(tmp_path, LAW)
    with pytest.raises(InputError, match='not for "ogden-power"; identify with limbfit'):
        check_export(study, "febio-optimize")


@pytest.mark.slow
@pytest.mark.skipif("FEBIO_CMD" not in os.environ, reason="FEBIO_CMD names no FEBio")
def test_febio_finds_the_same_force(tmp_path):
    problem = exported(tmp_path, OgdenPower(0.004, 5.0, 0.4, 0.2), 10)
    run = run_febio(
        find_febio(), tmp_path, float(problem.history.times[-1]), "forces.txt", time_limit_s=600.0
    )
    assert run.verdict.is_completed, run.verdict.reason
    found = build_result(problem, run.log, run.verdict)
    assert solve(problem).peak_force == pytest.approx(found.peak_force, rel=0.01)


@pytest.mark.slow
def test_a_study_identifies_it(tmp_path):
    found = identified(tmp_path, None, f"[material]\n{LAW}{SPAN}", VALUES, within=0.1)
    assert found["law"]["words"] == "second-order Ogden with relaxation as a power of time"
    assert len(found["law"]["relaxation_times_s"]) == 5


def test_the_report_states_its_times(tmp_path):
    (tmp_path / "calibrate").mkdir()
    law = block_study(tmp_path, LAW).law
    write_json(
        tmp_path / "calibrate" / "calibration.json", complete(CalibrationResult, {"law": law.record()})
    )
    (text,) = (text for head, text in write_method_parts(load_store(tmp_path)) if head == "Constitutive law")
    assert "γ Σ (τᵢ/1 s)^(−slope) exp(−t/τᵢ) acting" in text
    assert "with τᵢ = 0.0300, 0.300, 3.00, 30.0, 300, 3 000 s. The bulk" in text
