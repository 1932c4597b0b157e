"""`limbfit uncertainty` of a study that fixes parameters: its tables, and one material against several."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from completing import complete

sys.path.append(str(Path(__file__).parents[2] / "identify"))
from bars import PAPER, TRUTH, records, simulate

from limbfit.identify.fit.parameters import build_space
from limbfit.identify.uncertainty.emulator import Emulator
from limbfit.identify.uncertainty.likelihood import Likelihood
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.uncertainty import estimate_uncertainty
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.problem import build_problem
from limbfit.pipeline.uncertainty.result import _write_flat
from limbfit.pipeline.uncertainty.uncertainty import _compare_groupings
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


def test_one_material_keeps_what_the_study_fixes(tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    (tmp_path / "skin.stl").touch()
    study = load_study(tmp_path)
    answer = study.by_tissue(TRUTH)
    stage = {"parameters": answer}
    for model, content in ((CalibrationResult, {"stages": [stage, stage]}), (PredictResult, {})):
        file = study.results / model.FILE
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(complete(model, content)))
    problem, data = build_problem(study), records(0.01)
    unknowns = PAPER.with_start(TRUTH)
    noise = estimate_curve_noise(simulate(TRUTH), data)
    known = estimate_uncertainty(TRUTH, simulate(TRUTH), data, unknowns, noise, problem.stages[-1])
    space = build_space(unknowns, problem.stages[-1])
    shifts = 0.2 * np.random.default_rng(0).uniform(-1, 1, (16, len(space.lower)))
    points = [space.expand(space.reduce(np.log(TRUTH)) + shift) for shift in shifts]
    emulator = Emulator(np.array(points), [simulate(point) for point in points])
    likelihood = Likelihood(emulator, data, known.residual_model, unknowns, space)
    explored = SimpleNamespace(likelihood=likelihood, best=likelihood.find_best([TRUTH]))
    context = Context(study, Store(study.results), None, lambda event: None)
    found = _compare_groupings(context, problem, explored)
    assert found.second.parameters - found.first.parameters == 3  # c, m and gamma of one tissue more
