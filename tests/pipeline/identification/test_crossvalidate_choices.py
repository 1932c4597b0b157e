"""Cross-validation of studies that fix and tie parameters, or fit every site, on bars of known truth."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "identify"))
from bars import PAPER, TRUTH, Bars

from limbfit.cli.experiments import show_crossvalidation
from limbfit.identify.checks.crossvalidation import list_choices, rank_fold, spread_points
from limbfit.identify.fit.objective import MeasuredCurve
from limbfit.identify.fit.parameters import build_space
from limbfit.identify.uncertainty.emulator import Emulator
from limbfit.pipeline.engine.context import Context, ignore_progress
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.identification.crossvalidation import _build_result, _check_folds, _fit_choices
from limbfit.pipeline.identification.search import build_problem
from limbfit.report.sections.uncertainty import make_crossvalidation_section
from limbfit.results.uncertainty import FoldEmulator
from limbfit.study import load_study

STUDY = """
[study]
name = "choices"
[surfaces]
skin = "skin.stl"
[calibration]
fixed = ["skin.m"]
tied = [["skin.tau_s", "muscle.tau_s"]]
force_error_percent = 3.0
""" + "".join(
    f'[[sites]]\nname = "{k}"\nfitted = true\ntrace = "{k}.csv"\nposition = [0.0, 0.0, {10.0 * k}]\n'
    for k in range(3)
)
BARS = [
    Bars((400 * (1 - h) + 60, 400 * h + 60), (10 + 10 * h, 16 + 8 * h), 3.2 + 3.5 * h) for h in (0, 0.5, 1)
]
MEASURED = [MeasuredCurve(str(k), bar.force(TRUTH)) for k, bar in enumerate(BARS)]
ANSWER = PAPER.with_start(np.where(np.isin(PAPER.names, ["skin.m"]), 3.0, TRUTH * 1.1))


@pytest.fixture
def found(tmp_path):
    """The study, its problem at the answer, its emulator, and the fits of all choices of two sites."""
    (tmp_path / "study.toml").write_text(STUDY)
    for name in ("skin.stl", "0.csv", "1.csv", "2.csv"):
        (tmp_path / name).touch()
    study = load_study(tmp_path)
    context = Context(study, Store(study.results), None, ignore_progress)
    problem = build_problem(study)
    best = ANSWER.start.copy()
    best[[3, 7]] = 0.4  # tied
    problem = replace(problem, unknowns=problem.unknowns.with_start(best))
    space = build_space(problem.unknowns, problem.stages[-1])
    points = [best, *spread_points(best, 0.01 * np.eye(8), space, 12, seed=0)]
    emulator = Emulator(np.array(points), [[bar.respond(p) for bar in BARS] for p in points])
    chosen = list_choices(3, 2)
    fits = _fit_choices(context, emulator, problem, MEASURED, [(0,), (1,), (2,)], ((0, 1, 2), chosen, {}))
    return study, problem, emulator, fits


def test_choices_keep_what_the_study_fixes_and_tie_what_it_ties(found):
    _, problem, emulator, fits = found
    assert np.all(emulator.points[:, 1] == problem.unknowns.start[1])
    assert np.array_equal(emulator.points[:, 3], emulator.points[:, 7])
    for fold in (fits.own, *fits.folds):
        assert fold.parameters[1] == problem.unknowns.start[1]
        assert fold.parameters[3] == fold.parameters[7]


def test_a_study_that_fits_every_site_has_no_held_out_error_of_its_own_choice(found, capsys):
    study, problem, emulator, fits = found
    assert rank_fold(fits.own, fits.folds)["share_better"] is None
    solved = [[bar.respond(fold.parameters) for bar in BARS] for fold in fits.folds]
    checks = _check_folds(1, fits.folds, solved, emulator, MEASURED, {"0": (0,), "1": (1,), "2": (2,)})
    summary = FoldEmulator(runs=13, loo_percent=0.1, checks=checks)
    result = _build_result(study, problem.unknowns.names, ("0", "1", "2"), fits, 2, 3, summary)
    assert "The study itself fits every site." in str(make_crossvalidation_section(None, result))
    show_crossvalidation(result)
    assert "3 of 3 choices of 2 sites" in (said := capsys.readouterr().out)
    assert "own choice" not in said
    stored = result.to_plain()
    assert stored["own"]["mean_error_heldout_percent"] is stored["own"]["share_better"] is None
    assert [row["left_out_of"] for row in stored["sites"]] == [1, 1, 1]
