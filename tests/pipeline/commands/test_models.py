"""Other models of the same records: what is changed, what stays, how they are weighed and mixed."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from layered import block_study
from limbfit.errors import InputError, StudyError
from limbfit.identify.uncertainty.likelihood import compute_mixture_interval, weigh_models
from limbfit.laws import FUNG, LAWS
from limbfit.pipeline.commands.models import (
    MODELS,
    OWN_MODEL,
    _mix_predictions,
    _mix_pressures,
    _share_stages,
    compare_models,
    derive_study,
    fit_socket_of_models,
    select_models,
)
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.store import write_curves, write_result
from limbfit.report.sections.uncertainty import make_models_section
from limbfit.report.store import load_store
from limbfit.results.identification import PredictResult
from limbfit.results.socket import SocketResult
from limbfit.results.uncertainty import ModelsResult, ModelWeight, SocketOfModels
from limbfit.study import Study, load_study

STATED = """
start = { m = 4.0 }
[material.tissues.skin]
upper = { c_kPa = 30.0, tau_s = 5.0 }
[calibration]
fixed = ["skin.tau_s", "skin.m"]
tied = [["skin.gamma", "muscle.gamma"], ["skin.c_kPa", "muscle.c_kPa"]]
prior = { "muscle.c_kPa" = { median = 5.0, factor = 1.5 }, "muscle.m" = { median = 4.0, factor = 2.0 } }
"""


def study_of(folder: Path, material: str = STATED) -> Study:
    folder.mkdir(exist_ok=True)
    return block_study(folder, material)


def changed(study: Study, name: str) -> set[str]:
    """Stages whose keys another model changes."""
    before, after = compute_keys(study), compute_keys(derive_study(study, name))
    return {stage for stage in before if before[stage] != after[stage]}


@pytest.mark.parametrize(
    ("name", "stages"),
    [
        ("two-terms", {"calibrate", "predict", "report"}),
        ("fibres", {"calibrate", "predict", "report"}),
        ("thinner", {"surfaces", "sites", "mesh", "calibrate", "predict", "report"}),
        ("friction", {"sites", "mesh", "calibrate", "predict", "report"}),
    ],
)
def test_a_model_changes_only_the_stages_that_it_concerns(tmp_path, name, stages):
    """The inputs stand at the same places, so that what was segmented, placed and read serves the model."""
    assert changed(study_of(tmp_path / "s"), name) == stages


def test_a_law_keeps_what_is_stated_of_the_parameters_that_it_has(tmp_path):
    derived = derive_study(study_of(tmp_path / "s"), FUNG)
    assert derived.law.name == FUNG
    assert derived.material.start["b"] == LAWS[FUNG].parameters[1].start
    assert derived.material.get("skin", "upper") == {"c_kPa": 30.0, "b": 20.0, "gamma": 10.0, "tau_s": 5.0}
    assert derived.fixed == ("skin.tau_s",)
    assert derived.calibration.tied == (("skin.gamma", "muscle.gamma"), ("skin.c_kPa", "muscle.c_kPa"))
    two = derive_study(study_of(tmp_path / "t"), "two-terms")
    assert two.calibration.tied == (("skin.c_kPa", "muscle.c_kPa"),)
    assert set(derived.priors) == {"muscle.c_kPa"}


def test_a_layer_is_thicker_by_a_millimetre(tmp_path):
    study = study_of(tmp_path / "s")
    thinner, thicker = (derive_study(study, name) for name in ("thinner", "thicker"))
    own, less, more = (one.geometry.model_layers[0].thickness_mm for one in (study, thinner, thicker))
    assert (less, more) == (own - 1.0, own + 1.0)


def test_the_model_of_a_study_is_a_study_with_the_same_inputs(tmp_path):
    study = study_of(tmp_path / "s")
    (study.folder / "a.csv").write_text("a record", encoding="utf-8")
    derived = derive_study(study, "friction")
    assert derived.folder == study.results / "models" / "friction"
    assert derived.path(derived.recorded[0].trace).read_text(encoding="utf-8") == "a record"
    assert derived.indenter.friction == 0.4


@pytest.mark.parametrize("spelled", ["../records/a.csv", "../records/./a.csv", "..//records/a.csv"])
def test_an_input_beside_the_study_is_the_same_of_a_model_however_its_path_is_spelled(tmp_path, spelled):
    file = study_of(tmp_path / "s").file
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "a.csv").write_text("a record", encoding="utf-8")
    file.write_text(file.read_text(encoding="utf-8").replace('"a.csv"', f'"{spelled}"'), encoding="utf-8")
    derived = derive_study(load_study(tmp_path / "s"), "friction")
    assert derived.path(derived.recorded[0].trace).read_text(encoding="utf-8") == "a record"


def test_labels_corrected_by_hand_are_those_of_the_study_each_time(tmp_path):
    study = study_of(tmp_path)
    derived = derive_study(study, "fung")
    given, taken = (one.results / "by-hand" / "labels.seg.nrrd" for one in (study, derived))
    given.parent.mkdir(parents=True)
    for content in ("once", "again"):
        given.write_text(content)
        _share_stages(study, derived)
        assert taken.read_text() == content
    given.unlink()
    _share_stages(study, derived)
    assert not taken.exists()


def test_impossible_models_are_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="no model is named 'yeti'; use all, or some of two-terms, power"):
        select_models(["yeti"])
    with pytest.raises(InputError, match="no model is named 'yeti'"):
        select_models(["all", "yeti"])
    with pytest.raises(InputError, match="no model is named"):
        select_models([])
    assert select_models(["fung", "all"]) == tuple(MODELS)
    other = study_of(tmp_path / "s", f'law = "{FUNG}"')
    with pytest.raises(InputError, match='model power: the study\'s law is "fung"; only "ogden" has'):
        compare_models(other, ["power"])
    thin = block_study(study_of(tmp_path / "t").folder, "", "[geometry]\nskin_layer_mm = 1.2")
    with pytest.raises(InputError, match=r"model thinner: the layer is only 1\.2 mm thick"):
        derive_study(thin, "thinner")
    with pytest.raises((InputError, StudyError), match="no other models were compared; limbfit uncertainty"):
        fit_socket_of_models(other)


def test_weights_are_the_probabilities_of_models_that_were_alike_before():
    weights = weigh_models([10.0, 10.0 + 2 * np.log(3.0), 500.0])
    np.testing.assert_allclose(weights, [0.75, 0.25, 0.0], atol=1e-12)


def test_the_interval_of_a_mixture_holds_95_percent_of_it():
    means, sds, weights = np.array([[0.0, 1.0], [4.0, 1.0]]), np.array([[1.0, 2.0], [0.5, 2.0]]), [0.7, 0.3]
    low, high = compute_mixture_interval(means, sds, np.array(weights))
    for k in range(2):
        below = [
            sum(w * norm.cdf(end, m, s) for w, m, s in zip(weights, means[:, k], sds[:, k], strict=True))
            for end in (low[k], high[k])
        ]
        np.testing.assert_allclose(below, [0.025, 0.975], atol=1e-9)
    assert (low[1], high[1]) == pytest.approx(norm.interval(0.95, 1.0, 2.0))
    assert OWN_MODEL not in MODELS


STORED = Path(__file__).parents[2] / "results" / "stored"  # of real runs


def test_predictions_of_models_are_mixed_and_read_back(tmp_path):
    """A model that is as likely as the study's own, and predicts forces that are 1 N larger."""
    study = study_of(tmp_path / "s")
    derived = {FUNG: derive_study(study, FUNG)}
    time = np.linspace(0.0, 6.0, 31)
    for one, more in ((study, 0.0), (derived[FUNG], 1.0)):
        for stage in ("calibrate", "predict"):
            shutil.copytree(STORED / stage, one.results / stage)
        for row in PredictResult.read(one.results).sites:
            force = 4.0 * np.sin(np.pi * time / 6.0)
            curves = {"time_s": time, "force_measured_N": force, "force_simulated_N": force + more}
            ends = {"force_low_N": force + more - 0.2, "force_high_N": force + more + 0.2}
            write_curves(one.results / "predict" / f"{row.record}.csv", **curves, **ends)
    content = _mix_predictions(study, derived, {"thinner": "the layer is thin"})
    write_result(study.results / ModelsResult.FILE, content)
    assert ModelsResult.read(study.results) == content
    assert [one.weight for one in content.models] == pytest.approx([0.5, 0.5])
    record = content.records[0]
    assert record.own_interval_95 == pytest.approx((3.8, 4.2))
    assert record.interval_95 == pytest.approx((3.83, 5.17), abs=0.01)
    assert record.sd_between_models == pytest.approx(0.5)
    section = make_models_section(load_store(study.results), content)
    assert "Fung" in section.blocks[1].rows[1].cells[0].text


def test_pressures_of_models_are_mixed_and_read_back(tmp_path):
    own = SocketResult.read(STORED)
    loads = _mix_pressures([own, own], np.array([0.3, 0.7]))
    assert [load.name for load in loads] == ["donning", *(load.name for load in own.loads)]
    region, mixed = own.donning.regions[0], loads[0].regions[0]
    assert mixed.mean_kPa == [region.mean_kPa] * 2
    assert mixed.interval_kPa == pytest.approx(region.interval_kPa or 2 * (region.mean_kPa,), abs=1e-6)
    weights = [
        ModelWeight(model=OWN_MODEL, words="", weight=0.3),
        ModelWeight(model=FUNG, words="", weight=0.7),
    ]
    content = SocketOfModels(models=weights, loads=loads)
    (tmp_path / "models").mkdir()
    write_result(tmp_path / SocketOfModels.FILE, content)
    assert SocketOfModels.read(tmp_path) == content
