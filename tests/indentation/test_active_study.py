"""Muscle that contracts in a study: its law, when it acts, what follows, what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from editing import list_stale
from layered import block_context, block_study, check_derivative
from limbfit.errors import InputError, StudyError
from limbfit.fe import ContractileMaterial, OgdenQLV
from limbfit.indentation import SimulationJob, build_materials, build_problem, simulate
from limbfit.mesh import read_vtu
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.socket.socket import check_socket
from limbfit.study import Study

ALONG = "fibres = { muscle = [1.0, 0.0, 0.0] }\n"
COURSE = "activation = { time_s = [0.0, 2.0], share = [0.5, 1.0] }\n"
VALUES = {"c_kPa": 6.0, "m": 5.0, "gamma": 1.2, "tau_s": 0.5, "k1_kPa": 3.0, "k2": 3.0, "active_kPa": 6.0}
TRUTH = {"skin": VALUES | {"c_kPa": 9.0}, "muscle": VALUES}


def study_of(folder: Path, stated: str = "", law: str = "ogden-active", site: str = "") -> Study:
    return block_study(folder, f'law = "{law}"\n{stated}', site=site)


@pytest.fixture(scope="module")
def context(tmp_path_factory) -> Context:
    return block_context(study_of(tmp_path_factory.mktemp("active"), ALONG), TRUTH)


def test_the_core_contracts_and_no_other_tissue(tmp_path):
    study = study_of(tmp_path)
    assert study.fixed == ("skin.k1_kPa", "skin.k2", "skin.active_kPa")
    made = build_materials(TRUTH, 100.0, study.law.name, study.fibres)
    assert isinstance(made["skin"], OgdenQLV)
    assert isinstance(made["muscle"], ContractileMaterial)
    assert made["muscle"].active == pytest.approx(0.006)
    assert study.material.course == ((0.0, 1.0),)
    assert study_of(tmp_path, law="ogden-fibres").material.course == ()


def test_its_course_decides_the_calibration(tmp_path):
    stale = list_stale(study_of(tmp_path), study_of(tmp_path, COURSE))
    assert stale == {"calibrate", "predict", "report"}


def test_it_tenses_before_touch_down_and_as_stated_from_there(context):
    model = replace(build_model(context, context.study.recorded[0]), course=((0.0, 0.5), (2.0, 1.0)))
    problem = build_problem(model, read_vtu(model.mesh), TRUTH)
    assert problem.touch_down_s == model.waits_s == 7.0
    shares = [problem.activation_at(t) for t in (0.0, 1.0, 2.0, 7.0, 8.0, 9.0, 12.0)]
    np.testing.assert_allclose(shares, [0.0, 0.25, 0.5, 0.5, 0.75, 1.0, 1.0])
    assert problem.history.at(8.0) == pytest.approx(model.history.at(1.0))


def test_force_follows_the_active_stress_by_its_derivative(context):
    """And the tensed block is not as the passive one is."""
    study, model = context.study, build_model(context, context.study.recorded[0])
    flat, times = study.vector(TRUTH), (0.5 * model.knots_s[1], model.knots_s[1], 1.5 * model.knots_s[1])
    job = SimulationJob(model, study.tissues, tuple(flat), times)
    loose = np.where([key == "active_kPa" for _, key in study.parameters], 1e-9, flat)
    found, passive = (simulate(replace(job, parameters=tuple(values))) for values in (flat, loose))
    assert found.completed, found.reason
    assert np.abs(found.force_N - passive.force_N).max() > 0.02 * passive.force_N.max()
    own = [name == ("muscle", "active_kPa") for name in study.parameters]
    check_derivative(job, found, 2e-3 * flat * own, 1e-3)
    assert not found.jacobian[:, study.parameters.index(("skin", "active_kPa"))].any()


def test_a_socket_takes_no_muscle_that_contracts(context):
    with pytest.raises(InputError, match=r"study.toml: material.law: the limb in a socket is at rest"):
        check_socket(context.study, None, {})


@pytest.mark.parametrize(
    ("stated", "law", "what"),
    [
        (COURSE, "ogden-fibres", "without effect: the tissues' law has no active"),
        ("activation = { time_s = [0.0], share = [1.0] }", "ogden-active", "give two or more times"),
        ("activation = { time_s = [0, 1], share = [1] }", "ogden-active", "as many shares"),
        ("activation = { time_s = [1, 2], share = [1, 1] }", "ogden-active", "does not grow from 0"),
        (
            "activation = { time_s = [0, 1], share = [1, -1] }",
            "ogden-active",
            "share.2: Input should",
        ),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, stated, law, what):
    with pytest.raises(StudyError, match=f"study.toml: material.activation.*{what}"):
        study_of(tmp_path, stated, law)


def test_a_record_under_force_takes_none(tmp_path):
    with pytest.raises(StudyError, match='a has control = "force", which goes without contraction'):
        study_of(tmp_path, site="control = 'force'")
