"""Pre-stretch in a study: in which tissue, along what, what it decides, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from editing import list_stale
from layered import block_context, block_study, check_derivative
from limbfit.errors import InputError, ProblemError, StudyError
from limbfit.indentation import SimulationJob, build_problem, simulate
from limbfit.mesh import read_vtu
from limbfit.pipeline.design.protocol import check_protocol
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.simulation.simulations import compute_job_digest
from limbfit.pipeline.socket.socket import check_socket

TAUT = "prestretch = { skin = 1.1 }\n"
VALUES = {"c_kPa": 6.0, "m": 5.0, "gamma": 1.2, "tau_s": 0.5}
TRUTH = {"skin": VALUES | {"c_kPa": 9.0}, "muscle": VALUES}


@pytest.fixture(scope="module")
def context(tmp_path_factory) -> Context:
    return block_context(block_study(tmp_path_factory.mktemp("taut"), TAUT), TRUTH)


def test_a_layer_is_stretched_in_its_plane_and_fibres_along_themselves(context):
    model = replace(build_model(context, context.study.recorded[0]))
    assert model.prestretch == (("skin", 1.1),)
    mesh = read_vtu(model.mesh)
    G = np.asarray(build_problem(model, mesh, TRUTH).prestretch)
    skin = mesh.regions == mesh.region_names.index("skin")
    np.testing.assert_allclose(G[skin], np.tile(np.diag([1.1, 1.1, 1.1**-2]), (skin.sum(), 1, 1)))
    np.testing.assert_array_equal(G[~skin], np.tile(np.eye(3), ((~skin).sum(), 1, 1)))
    along = replace(model, fibres=(("muscle", (1.0, 0.0, 0.0)),), prestretch=(("muscle", 1.2),))
    G = np.asarray(build_problem(along, mesh, TRUTH).prestretch)
    expected = np.diag([1.2, 1.2**-0.5, 1.2**-0.5])
    np.testing.assert_allclose(G[~skin], np.tile(expected, ((~skin).sum(), 1, 1)), atol=1e-12)


def test_it_decides_the_calibration_on_whole_meshes(tmp_path):
    plain, taut = block_study(tmp_path, ""), block_study(tmp_path, TAUT)
    assert list_stale(plain, taut) == {"calibrate", "predict", "report"}
    assert plain.within_mm == 65.0
    assert taut.within_mm is None


def test_what_would_count_from_its_equilibrium_is_refused_before_it_is_simulated(context):
    model = replace(build_model(context, context.study.recorded[0]), layers=("skin",))
    job = SimulationJob(model, context.study.tissues, tuple(context.study.vector(TRUTH)), (1.0,))
    with pytest.raises(ProblemError, match="waves of pre-stretched tissue"):
        simulate(job)


def test_a_protocol_that_plans_what_sees_no_pre_stretch_is_refused(context):
    options = {"determine": (), "minutes": 25.0, "setup_s": 60.0, "rest_s": 30.0, "holds_s": ()}
    check_protocol(context.study, None, options)
    with pytest.raises(InputError, match="surface_sd_mm is planned, which sees no pre-stretch"):
        check_protocol(context.study, None, options | {"surface_sd_mm": 0.2})


def test_force_follows_tissue_by_its_derivatives(context):
    study, model = context.study, build_model(context, context.study.recorded[0])
    flat, times = study.vector(TRUTH), (0.5 * model.knots_s[1], model.knots_s[1], 1.5 * model.knots_s[1])
    jobs = [
        SimulationJob(one, study.tissues, tuple(flat), times)
        for one in (model, replace(model, prestretch=()))
    ]
    assert compute_job_digest(jobs[0]) != compute_job_digest(jobs[1])
    found, slack = (simulate(job) for job in jobs)
    assert found.completed, found.reason
    assert np.abs(found.force_N - slack.force_N).max() > 0.02 * slack.force_N.max()
    own = [name == ("skin", "c_kPa") for name in study.parameters]
    check_derivative(jobs[0], found, 2e-3 * flat * own, 1e-3)


def test_a_socket_takes_none(context):
    with pytest.raises(InputError, match=r"study.toml: material.prestretch: the limb in a socket is at rest"):
        check_socket(context.study, None, {})


@pytest.mark.parametrize(
    ("stated", "more", "site", "what"),
    [
        ("prestretch = { muscle = 1.1 }", "", "", "material.prestretch.muscle: no layer, and no tissue with"),
        ("prestretch = { hide = 1.1 }", "", "", "material.prestretch.hide: no layer"),
        (
            "prestretch = { skin = 2.0 }",
            "",
            "",
            "material.prestretch.skin: Input should be less than or equal",
        ),
        (TAUT, "", "ultrasound = 'a.csv'\n", "a has ultrasound, which sees no pre-stretch; leave it out"),
        (TAUT, "", "control = 'force'\n", 'a has control = "force", which goes without pre-stretch'),
        (TAUT, "[calibration]\nsearch_radius_mm = 50.0", "", "calibration.search_radius_mm: without effect"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, stated, more, site, what):
    with pytest.raises(StudyError, match=f"study.toml: .*{what}"):
        block_study(tmp_path, stated, more, site)
