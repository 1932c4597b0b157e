"""What is extrapolated looks so."""

import numpy as np
from matplotlib.figure import Figure
from stored_results import write_results

from completing import complete
from limbfit.report.sections.uncertainty import _draw_profile, draw_profile_figure
from limbfit.report.store import load_store
from limbfit.report.words import write_columns
from limbfit.results.uncertainty import (
    LikelihoodProfile,
    ParameterUncertainty,
    ProfileCheck,
    UncertaintyResult,
)

PROFILE = LikelihoodProfile.model_validate(
    {
        "values": [1.0, 2.0, 3.0, 4.0, 6.0, 9.0],
        "rise": [8.0, 4.0, 0.5, 0.0, 1.0, 2.0],
        "threshold": 3.84,
        "interval_95": [2.04, 9.0],
        "closed": [True, False],
        "verdict": "determined on one side",
        "extrapolated": [True, False, False, False, True, True],
        "ends_extrapolated": [False, True],
    }
)
CHECKS = [
    ProfileCheck.model_validate(
        {
            "name": "skin.m",
            "why": "widest",
            "emulated": [3.84, 2.0],
            "solved": [3.5, None],
            "extrapolated": [False, True],
        }
    )
]


def test_extrapolated_parts_of_a_profile_are_dashed():
    ax = Figure().add_subplot()
    _draw_profile(ax, PROFILE)
    lines = {line.get_linestyle(): np.asarray(line.get_ydata()) for line in ax.get_lines()}
    assert np.isnan(lines["-"]).tolist() == PROFILE.extrapolated
    # The neighbours of what is extrapolated belong to the dashed line, so that nothing is left out between.
    assert np.isnan(lines["--"]).tolist() == [False, False, True, False, False, False]
    assert lines["None"].tolist() == [8.0, 1.0, 2.0]


def test_the_figure_of_profiles_says_what_dashes_mean_and_what_the_solver_said(tmp_path):
    store = load_store(write_results(tmp_path, geometry=False))
    figure = draw_profile_figure(
        store, UncertaintyResult.model_construct(profiles={"skin.m": PROFILE}, checks=CHECKS)
    )
    assert "beyond the emulator's simulations" in figure.caption
    assert "0.34 (the widest, not simulated at each end)" in figure.caption


def test_the_table_names_the_ends_that_are_extrapolated():
    def describe(verdict: str | None, ends: tuple[bool, bool] | None) -> str:
        stated = {"profile_verdict": verdict, "profile_extrapolated": ends}
        row = complete(ParameterUncertainty, stated)
        columns = write_columns("table uncertainty-parameters", row=ParameterUncertainty(**row))
        return next(text for head, _, text, _ in columns if head == "Profile says")

    assert (
        describe("determined on one side", (False, True)) == "determined on one side; high end extrapolated"
    )
    assert describe("determined on one side", (False, False)) == "determined on one side"
    assert describe("open", (True, True)) == "open; low and high ends extrapolated"
    assert describe(None, None) == "–"
