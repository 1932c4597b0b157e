"""Parts of `limbfit uncertainty`: its tables, one material against several, intervals of predictions."""

import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from completing import complete
from layered import block_context, block_study

sys.path.append(str(Path(__file__).parents[2] / "identify"))
from bars import PAPER, TRUTH, estimate, records, simulate

from limbfit.identify.fit.objective import SiteResponse
from limbfit.identify.fit.parameters import build_space
from limbfit.identify.fit.prediction import RelaxationSpread
from limbfit.identify.uncertainty.emulator import Emulator
from limbfit.identify.uncertainty.likelihood import Likelihood
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.uncertainty import ResidualModel
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.search import build_problem
from limbfit.pipeline.records.records import estimate_site_noise, load_site_record
from limbfit.pipeline.uncertainty.uncertainty import (
    Findings,
    _compare_groupings,
    _summarise_parameters,
    _write_flat,
    _write_prediction,
)
from limbfit.results.base import read_curves
from limbfit.results.identification import CalibrationResult, PredictResult
from limbfit.results.uncertainty import ParameterUncertainty
from limbfit.study import load_study

STUDY = """
[study]
name = "given"
[surfaces]
skin = "skin.stl"
[calibration]
fixed = ["skin.tau_s", "muscle.tau_s"]
[[sites]]
name = "1"
depth_mm = 5.0
position = [0.0, 0.0, 0.0]
"""


def test_every_row_of_a_table_has_its_values_under_their_heads(tmp_path):
    """A parameter that is fixed or tied has no profile of its own."""
    facts = {"name": "skin.m", "verdict": "given", "with_sources_95": [2.0, 3.0]}
    given = ParameterUncertainty.model_validate(complete(ParameterUncertainty, dict(facts)))
    profile = {"profile_95": [1.0, 4.0], "profile_verdict": "open", "profile_extrapolated": [False, True]}
    free = ParameterUncertainty.model_validate(complete(ParameterUncertainty, facts | profile))
    for rows in ([given, free], [free, given]):
        _write_flat(tmp_path / "parameters.csv", rows)
        lines = list(csv.DictReader((tmp_path / "parameters.csv").open()))
        assert [line["verdict"] for line in lines] == ["given", "given"]
        assert [line["with_sources_95_high"] for line in lines] == ["3", "3"]
        assert sorted(line["profile_95_low"] for line in lines) == ["", "1"]


HELD_OUT = [
    {"site": site, "fitted": False, "error_one_material_percent": one, "error_percent": 1.0}
    for site, one in (("2", 2.0), ("2", 2.1), ("2", 2.2), ("3", 1.5))
]


def test_one_material_keeps_what_the_study_fixes_and_is_judged_at_each_site_once(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "skin.stl").touch()
    study = load_study(tmp_path)
    answer = study.by_tissue(TRUTH)
    stage = {"parameters": answer}
    for model, content in (
        (CalibrationResult, {"stages": [stage, stage]}),
        (PredictResult, {"sites": HELD_OUT}),
    ):
        file = study.results / model.FILE
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(complete(model, content)))
    problem, data = build_problem(study), records(0.01)
    unknowns = PAPER.with_start(TRUTH)
    known = estimate(TRUTH, simulate(TRUTH), data, unknowns, grouping=problem.stages[-1])
    space = build_space(unknowns, problem.stages[-1])
    shifts = 0.2 * np.random.default_rng(0).uniform(-1, 1, (16, len(space.lower)))
    points = [space.expand(space.reduce(np.log(TRUTH)) + shift) for shift in shifts]
    emulator = Emulator(np.array(points), [simulate(point) for point in points])
    likelihood = Likelihood(emulator, data, known.residual_model, unknowns, space)
    explored = SimpleNamespace(likelihood=likelihood, best=likelihood.find_best([TRUTH]))
    context = Context(study, Store(study.results), None, lambda event: None)
    found = _compare_groupings(context, problem, explored)
    assert found.second.parameters - found.first.parameters == 3  # c, m and gamma of one tissue more
    assert (found.heldout["sites"], found.heldout["first_percent"]) == pytest.approx((2.0, 1.8))
    assert "at 2 held-out sites both predict alike" in found.verdict


def test_intervals_of_predictions_widen_beyond_the_longest_load_as_those_of_a_run(tmp_path):
    """No record shows the moduli later on: they may have fallen by half."""
    tissue = {"c_kPa": 8.0, "m": 5.0, "gamma": 2.0, "tau_s": 0.5}
    context = block_context(block_study(tmp_path, "", ""), {"skin": tissue, "muscle": tissue})
    record = load_site_record(context, context.study.recorded[0])
    times, n = record.times_s, len(record.times_s)
    parameters = context.study.vector({"skin": tissue, "muscle": tissue})
    response = SiteResponse(np.full(n, 3.0), 3.0 / np.tile(8 * parameters, (n, 1)))
    no_spread, half = np.zeros((8, 8)), np.full((2, 8), np.log(2.0))
    relaxation = RelaxationSpread(
        0.6 * times[-1], 1.0, np.array([0.1, 100.0]), 0.0 * half, np.zeros((2, 8, 8)), half
    )
    noise = estimate_site_noise(context.study, record, response.force_N)
    model = ResidualModel((noise,), np.array([3.0]), np.array([0.01]), 0.2, 10.0)
    known = SimpleNamespace(residual_model=model, parameters=parameters, covariance=no_spread)
    explored = SimpleNamespace(posterior=SimpleNamespace(covariance=no_spread, median=parameters))
    rows, curves = [], []
    for one in (None, relaxation):
        stated = one and SimpleNamespace(beyond=one)
        found = Findings(known, explored, None, None, (), stated)
        folder = tmp_path / str(len(rows))
        (folder / "predictions").mkdir(parents=True)
        rows.append(_write_prediction(folder, context.study, found, record, response))
        curves.append(read_curves(folder / "predictions" / f"{record.name}.csv"))
    (low, wide), later = (one["force_low_N"] for one in curves), times > 0.6 * times[-1]
    np.testing.assert_array_equal(wide[~later], low[~later])
    np.testing.assert_allclose(wide[later], 0.5 * low[later], atol=1e-6)
    assert rows[1].half_width_percent > rows[0].half_width_percent + 5.0


def test_verdicts_count_relaxation_beyond_the_records_as_those_of_a_run():
    known = estimate(TRUTH, simulate(TRUTH), records(0.01))
    posterior = SimpleNamespace(
        covariance=1e-4 * np.eye(8),
        median=TRUTH,
        intervals_95=TRUTH[:, None] * np.exp([[-0.02, 0.02]]),
    )
    explored = SimpleNamespace(
        posterior=posterior, profiles=(), likelihood=SimpleNamespace(space=known.space)
    )
    moduli = [
        SimpleNamespace(tissue=tissue, time_s=time, interval_95=(5.0, 5.0 * factor))
        for tissue in ("skin", "muscle")
        for time, factor in ((1.0, 1.1), (10.0, 1.1), (3600.0, 8.0 if tissue == "skin" else 1.1))
    ]
    relaxation = SimpleNamespace(prefers="a power law", moduli=moduli)
    found = SimpleNamespace(
        known=known, explored=explored, source_covariance=np.zeros((8, 8)), relaxation=relaxation
    )
    verdicts = {row.name: row.verdict for row in _summarise_parameters(found)}
    assert verdicts["skin.c_kPa"] == "determined at 1 s and 10 s; its long-term value not"
    assert verdicts["skin.gamma"] == "not determined: another relaxation fits as well"
    assert verdicts["muscle.c_kPa"] == verdicts["skin.m"] == "determined"


def test_an_interval_covers_what_is_most_probable_beside_the_answer(tmp_path):
    data, response = records(0.01)[0], simulate(TRUTH)[0]
    (noise, *_) = estimate_curve_noise([response], [data])
    known = estimate(TRUTH, simulate(TRUTH), records(0.01))
    likely = TRUTH * np.exp(0.3)
    posterior = SimpleNamespace(covariance=1e-6 * np.eye(len(TRUTH)), median=likely)
    found = SimpleNamespace(
        known=known,
        explored=SimpleNamespace(posterior=posterior),
        source_covariance=0 * posterior.covariance,
        relaxation=None,
    )
    record = SimpleNamespace(
        name=data.name,
        site=SimpleNamespace(name=data.name, fitted=True),
        compared=data.force_N,
        record=SimpleNamespace(forced=False, unit="N"),
        times_s=noise.times_s,
        touch_down_sd_mm=0.0,
        displacement_mm=noise.times_s,
        seen=SimpleNamespace(noise=lambda *_: noise),
    )
    (tmp_path / "predictions").mkdir()
    row = _write_prediction(tmp_path, None, found, record, response)
    curves = read_curves(tmp_path / "predictions" / f"{data.name}.csv")
    elsewhere = response.force_N + response.jacobian @ (0.3 * TRUTH)
    for force in (response.force_N, elsewhere):
        assert np.all(curves["force_low_N"] <= np.maximum(force, 0.0) + 1e-3)
        assert np.all(curves["force_high_N"] >= force - 1e-3)
    assert row.half_width_percent > 50 * np.abs(elsewhere - response.force_N).mean() / response.force_N.max()
