"""The notebooks of the documentation, run as plain Python in a folder of their own, and what they say."""

import os
import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import pyvista as pv

PAGES = Path(__file__).parents[2] / "docs" / "notebooks"
SHARED = Path(__file__).parents[3] / "shared" / "reference" / "cube"


def cells(page: str) -> list[str]:
    text = (PAGES / f"{page}.md").read_text(encoding="utf-8")
    return re.findall(r"^```\{code-cell\} ipython3\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """All cells of a page in order; what they leave behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pv, "OFF_SCREEN", True)
    matplotlib.use("Agg")

    def running(page: str) -> dict[str, Any]:
        left: dict[str, Any] = {"__name__": "notebook"}
        for number, code in enumerate(cells(page), start=1):
            exec(compile(code, f"{page}, cell {number}", "exec", dont_inherit=True), left)
        return left

    yield running
    matplotlib.pyplot.close("all")


def test_every_notebook_is_run_here() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for page in PAGES.glob("*.md"):
        assert f'run("{page.stem}")' in here


@pytest.mark.slow
def test_a_block_relaxes_and_the_square_is_the_stiffest_indenter(run, capsys) -> None:
    left = run("indent-a-block")
    assert left["after_hold"] < 0.8 * left["at_peak"]
    peaks = {shape: found.peak_force for shape, found in left["shapes"].items()}
    assert peaks["square"] > peaks["cylinder"] > peaks["sphere"]
    assert "region 'muscle' has no material; name it in materials" in capsys.readouterr().out


def test_an_own_mesh_is_stiffer_over_its_bone(run, capsys) -> None:
    left = run("your-own-mesh")
    peaks = {place: found.peak_force for place, found in left["results"].items()}
    assert peaks["over bone"] > 1.1 * peaks["over muscle"]
    assert "count nodes from 0" in capsys.readouterr().out


@pytest.mark.slow
def test_an_own_curve_tells_the_tissue_that_made_it(run) -> None:
    left = run("your-own-curve")
    truth = {"skin.c": 0.012, "muscle.c": 0.005, "muscle.gamma": 2.0}
    for name, (low, high) in zip(left["known"].names, left["known"].intervals_95, strict=True):
        assert low < truth[name] < high
    assert left["error"] < 1.0
    widths = [np.ptp(np.log(found.intervals_95[0])) for found in (left["known"], left["alone"].uncertainty)]
    assert widths[1] > 3 * widths[0]


@pytest.mark.slow
def test_a_study_from_python_predicts_its_held_out_site(run) -> None:
    left = run("study-from-python")
    assert left["found"]["mean_error_fitted_percent"] < 1.0
    assert left["found"]["mean_error_heldout_percent"] < 1.5
    assert {row["state"] for row in left["study_status"](left["study"])} == {"done"}


def test_febio_reads_what_limbfit_wrote(run, capsys, monkeypatch) -> None:
    monkeypatch.setenv("FEBIO_CASES", str(SHARED))
    left = run("compare-with-febio")
    assert np.abs(left["gap"]).max() < 0.05 * left["direct"].peak_force
    if not SHARED.is_dir():
        assert "set FEBIO_CASES" in capsys.readouterr().out
        pytest.skip(f"no logs of FEBio in {os.path.relpath(SHARED, PAGES.parents[1])}")
    worst = max(percent for columns in left["differences"].values() for percent in columns.values())
    assert len(left["differences"]) == 5
    assert worst < 0.01
