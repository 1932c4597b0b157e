"""Sensitivities have the signs that mechanics gives them, and extrapolation finds what was put in."""

import numpy as np
import pytest

from completing import complete
from conftest import coarse_mesh
from limbfit import run_study
from limbfit.cli.experiments import show_sensitivity
from limbfit.errors import InputError
from limbfit.execution import SerialExecutor
from limbfit.pipeline.engine.context import Context, Progress
from limbfit.pipeline.engine.store import Store, read_json, write_json
from limbfit.pipeline.identification.answer import extrapolate_richardson
from limbfit.pipeline.variants.sensitivity import (
    list_other_indenters,
    run_contact,
    run_indenter,
    run_kappa,
    run_stiffness,
    summarise_volumes,
)
from limbfit.pipeline.variants.variants import choose_sites
from limbfit.results.identification import CalibrationResult
from limbfit.results.variants import RefinementResult
from limbfit.study import IndenterTable, load_study

SETTINGS = coarse_mesh("tet4", 9.0) + "[indenter]\nedge_radius_mm = 2.0\n"
SKIN = {"c_kPa": 6.0, "m": 6.0, "gamma": 1.0, "tau_s": 0.5}
MUSCLE = {"c_kPa": 4.0, "m": 3.0, "gamma": 1.0, "tau_s": 0.5}


def quiet(event: Progress) -> None:
    """A listener that does nothing."""


@pytest.fixture(scope="module")
def context(pristine, tmp_path_factory):
    """The stump meshed, with parameters as a calibration stores them."""
    folder = pristine
    text = (folder / "study.toml").read_text() + SETTINGS
    (folder / "study.toml").write_text(text.replace("[0.0, 40.0, 50.0]", "[0.0, 33.0, 20.0]"))
    study = load_study(folder)
    run_study(study, until="mesh", listener=quiet)
    store = Store(study.results)
    store["calibrate"].mkdir()
    parameters = {"skin": SKIN, "muscle": MUSCLE}
    content = complete(CalibrationResult, {"stages": [{"parameters": parameters}]})
    write_json(store["calibrate"] / "calibration.json", content)
    return Context(study, store, SerialExecutor(), quiet)


def runs(folder, name: str, site: str) -> dict[str, dict]:
    rows = read_json(folder / f"{name}.json")["runs"]
    return {row["label"]: row for row in rows if row["site"] == site}


def test_thin_and_thick_sites_are_chosen_unless_named(context):
    thin, thick = choose_sites(context, [])
    assert (thin.summary.role, thick.summary.role) == ("thin", "thick")
    assert 15.0 < thin.summary.tissue_mm < thick.summary.tissue_mm < 30.0
    assert [one.model.site for one in choose_sites(context, ["2", "1"])] == ["2", "1"]
    with pytest.raises(InputError):
        choose_sites(context, ["no such site"])


@pytest.mark.slow
def test_force_grows_with_c_of_each_tissue(context, tmp_path):
    run_stiffness(context, tmp_path, sites=["1"])
    found = runs(tmp_path, "sensitivity-c", "1")
    for tissue in ("skin", "muscle"):
        less, more = (found[f"{tissue} c x {factor}"]["peak_change_percent"] for factor in ("0.5", "2"))
        assert -50.0 < less < -5.0
        assert 5.0 < more < 100.0
    content = read_json(tmp_path / "sensitivity-c.json")
    assert content["equal_m"] == pytest.approx(np.sqrt(18.0))
    slopes = content["local"][0]["peak_percent_per_percent"]
    assert sum(slopes.values()) == pytest.approx(1.0, abs=0.03)  # all stresses scale with c


def test_a_higher_bulk_modulus_stiffens_and_keeps_volumes(context, tmp_path):
    run_kappa(context, tmp_path, sites=["1"], ratios=[10.0, 400.0])
    found = runs(tmp_path, "sensitivity-kappa", "1")
    soft, own, stiff = (found[f"kappa = {ratio} c"] for ratio in (10, 100, 400))
    assert soft["peak_force_N"] < own["peak_force_N"] < stiff["peak_force_N"]
    spread = [row["J_high"] - row["J_low"] for row in (soft, own, stiff)]
    assert spread[0] > spread[1] > spread[2]
    assert soft["J_min"] < soft["J_low"] < 1.0
    assert stiff["beyond_percent"] < soft["beyond_percent"]


def test_sticking_skin_pushes_back_harder(context, tmp_path):
    run_contact(context, tmp_path, sites=["1"])
    found = runs(tmp_path, "sensitivity-contact", "1")
    assert found["frictionless"]["base"]
    assert 0.0 < found["sticky"]["peak_change_percent"] < 30.0


def test_a_sphere_pushes_less_than_the_square(context, tmp_path):
    run_indenter(context, tmp_path, sites=["1"])
    found = runs(tmp_path, "sensitivity-indenter", "1")
    assert found["square of the study"]["base"]
    assert found["sphere"]["peak_change_percent"] < -15.0
    table = np.genfromtxt(tmp_path / "1.csv", delimiter=",", names=True)
    assert table["sphere_N"].max() == pytest.approx(found["sphere"]["peak_force_N"])


def test_other_indenters_have_the_studys_width_and_are_not_its_own():
    own = IndenterTable(shape="sphere", width_mm=12.0)
    found = list_other_indenters(own)
    assert [label for label, _, base in found if base] == ["sphere of the study"]
    assert [label for label, _, base in found if not base] == ["square", "square, rounded edge", "cylinder"]
    assert {table.width_mm for _, table, _ in found} == {12.0}


@pytest.mark.parametrize("order", [1.0, 2.0, 3.5])
def test_extrapolation_finds_limit_and_order(order):
    edges = np.array([4.0, 5.6, 2.8])
    found = extrapolate_richardson(edges, 10.0 + 0.05 * edges**order, 2.0)
    assert found.measured
    assert found.order == pytest.approx(order, rel=1e-6)
    assert found.limit == pytest.approx(10.0)
    assert found.error_percent(10.5) == pytest.approx(5.0)


def test_extrapolation_assumes_an_order_where_none_shows():
    swinging = extrapolate_richardson([4.0, 2.8, 2.0], [10.1, 9.9, 10.05], 2.0)
    two = extrapolate_richardson([4.0, 2.0], [10.4, 10.1], 2.0)
    assert not swinging.measured
    assert not two.measured
    assert two.limit == pytest.approx(10.0)


def test_the_command_says_that_nothing_is_extrapolated_where_an_element_has_no_order(capsys):
    site = {"site": "01", "limit_N": 5.1, "order": None, "error_percent": -2.0}
    show_sensitivity(
        "mesh", RefinementResult.model_validate(complete(RefinementResult, {"sites": [site], "runs": []}))
    )
    told = capsys.readouterr().out
    assert "site 01: 5.100 N on the finest mesh" in told
    assert "-2.00 % off" in told


def test_volumes_are_weighed():
    J, volumes = np.array([0.95, 1.0, 1.0, 1.02]), np.array([1.0, 50.0, 48.0, 1.0])
    found = summarise_volumes(J, volumes)
    assert found["J_min"] == 0.95
    assert found["J_max"] == 1.02
    assert found["beyond_percent"] == pytest.approx(2.0)
