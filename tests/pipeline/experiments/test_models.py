"""Other models of the same records: what is changed, what stays, how they are weighed and mixed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from layered import block_study
from limbfit.errors import InputError, StudyError
from limbfit.identify.uncertainty.model_comparison import compute_mixture_interval, weigh_models
from limbfit.laws import FUNG, LAWS
from limbfit.pipeline.commands.models import (
    MODELS,
    OWN,
    compare_models,
    derive_study,
    fit_socket_of_models,
    select_models,
)
from limbfit.pipeline.commands.run import compute_keys
from limbfit.study import Study

STATED = """
start = { m = 4.0 }
[material.tissues.skin]
upper = { c_kPa = 30.0, tau_s = 5.0 }
[calibration]
fixed = ["skin.tau_s", "skin.m"]
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
        ("power", {"calibrate", "predict", "report"}),
        (FUNG, {"calibrate", "predict", "report"}),
        ("fibres", {"calibrate", "predict", "report"}),
        ("thinner", {"surfaces", "sites", "mesh", "calibrate", "predict", "report"}),
        ("thicker", {"surfaces", "sites", "mesh", "calibrate", "predict", "report"}),
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
    assert derived.material.of("skin", "upper") == {"c_kPa": 30.0, "b": 20.0, "gamma": 10.0, "tau_s": 5.0}
    assert derived.fixed == ("skin.tau_s",)
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


def test_impossible_models_are_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match="no model is named 'yeti'; use all, or some of two-terms, power"):
        select_models(["yeti"])
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
    assert OWN not in MODELS
