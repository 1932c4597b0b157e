"""Clamping pins in a study: what they decide, hold and change, and what of them is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from editing import edit, list_stale
from layered import check_derivative
from limbfit.errors import ProblemError, StudyError
from limbfit.execution import SerialExecutor
from limbfit.febio import read_feb, to_problem
from limbfit.indentation import SimulationJob, SiteModel, simulate
from limbfit.pipeline.commands.check import check_study
from limbfit.pipeline.commands.other_solvers import export_study
from limbfit.pipeline.commands.run import run_study
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.limb.mesh import build_coarse_settings, mesh_settings
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.simulation.simulations import compute_job_digest
from limbfit.study import ClampsTable, Study, load_study
from small_limb import small_limb

COARSE = "\n[mesh]\nedge_near_mm = 8.0\nelement = 'tet10'\n[solver]\nload_steps = 3\nunload_steps = 3\n"
GENTLE = COARSE + "[clamps]\nforce_N = 4.0\n"


def study_of(folder: Path, text: str) -> Study:
    return load_study(small_limb(folder, text))


@pytest.fixture(scope="module")
def context(tmp_path_factory) -> Context:
    study = study_of(tmp_path_factory.mktemp("clamped"), GENTLE)
    run_study(study, until="mesh")
    return Context(study, Store(study.results), SerialExecutor(), lambda event: None)


def test_the_table_alone_turns_them_on(tmp_path):
    assert study_of(tmp_path, COARSE).clamps is None
    clamps = study_of(tmp_path, COARSE + "[clamps]\n").clamps
    assert clamps is not None
    assert clamps.force_N == 15.0
    np.testing.assert_allclose(clamps.angles, 360.0 / 14.0 * np.arange(2, 13))


def test_their_force_decides_simulations_and_their_width_the_mesh_too(tmp_path):
    plain = study_of(tmp_path, COARSE + "[clamps]\n")
    later = {"calibrate", "predict", "report"}
    assert list_stale(plain, study_of(tmp_path, COARSE)) == {"mesh", *later}
    for text, changed in (("force_N = 9.0", later), ("width_mm = 12.0", {"mesh", *later})):
        assert list_stale(plain, study_of(tmp_path, f"{COARSE}[clamps]\n{text}\n")) == changed


def test_the_mesh_is_no_coarser_than_they_are_wide_and_searched_as_a_whole(tmp_path):
    study = study_of(tmp_path, COARSE + "[mesh.coarse]\nedge_near_mm = 9.0\n[clamps]\nwidth_mm = 15.0\n")
    coarse = build_coarse_settings(study)
    assert coarse is not None
    assert mesh_settings(study).edge_far_mm == coarse.edge_far_mm == 15.0
    assert study.within_mm is None


@pytest.mark.slow
def test_a_clamped_site_is_indented_from_where_its_skin_is_then(context):
    """Force and its derivatives, which follow the place where the indenter touches too.

    Pins on so coarse a skin can come to rest in several places: differences are taken in that of the start,
    as a search goes from one simulation to the next.
    """
    study = context.study
    model = build_model(context, study.sites[0])
    start = np.array([study.material.get(tissue, "start")[key] for tissue, key in study.parameters])
    times = (0.0, 0.5 * model.knots_s[1], model.knots_s[1])  # the way in
    job = SimulationJob(model, study.tissues, tuple(start), times)
    found, bare = (simulate(replace(job, model=one)) for one in (model, replace(model, clamps=None)))
    assert found.completed, found.reason
    assert found.force_N[0] == 0.0
    assert np.abs(found.force_N - bare.force_N).max() > 0.03 * bare.force_N.max()
    step = 0.002 * start * [name == ("muscle", "c_kPa") for name in study.parameters]
    check_derivative(replace(job, starts=(tuple(start),)), found, step, 1e-3)


@pytest.mark.slow
def test_a_clamped_site_goes_to_febio(context, tmp_path):
    """Eleven pins on rails and the test pin, which stands clear until the pins have pressed for 7 s."""
    export_study(context.study, "feb", site="1", output=tmp_path)
    model = read_feb(tmp_path / "1.feb")
    assert len(model.rails) == 11
    problem = to_problem(model)
    test_pin, *pins = problem.bodies
    assert test_pin.name == "indenter"
    assert len(pins) == 11
    for pin in pins:
        values, forced, _ = pin.motion.at(7.0)
        assert forced.tolist() == [False, False, True, False, False, False]
        assert values[2] == pytest.approx(4.0)
    ways = np.linalg.norm([test_pin.motion.at(t)[0][:3] for t in (6.0, 7.0, 7.0 + 3.125)], axis=1)
    assert ways[0] == 0.0
    assert ways[1] > 40.0
    assert ways[2] - ways[1] == pytest.approx(3.0)


def test_they_are_among_what_decides_a_kept_simulation():
    model = SiteModel("1", Path("1.vtu"), "", (0, 0, 0), (0, 0, -1), (0, 1), (0, 1))
    clamps = (None, ClampsTable(force_N=4.0), ClampsTable(force_N=5.0))
    jobs = [SimulationJob(replace(model, clamps=one), ("muscle",), (1.0,), (0.0,)) for one in clamps]
    assert len({compute_job_digest(job) for job in jobs}) == 3


def test_the_check_says_how_many_hold_the_limb(commands_unasked, tmp_path):
    facts = check_study(study_of(tmp_path, GENTLE))["facts"]
    assert "clamps: 11 pins of 4 N, 7 s before touch-down; 11 at site 1 meet the skin" in facts


@pytest.mark.parametrize(
    ("stated", "what"),
    [
        ("angles_degrees = [10.0]", "the clamp at 10 degrees would lie on the test pin"),
        ("levels_mm = [300.0]", "no clamping pin meets the skin; give clamps.angles_degrees"),
    ],
)
def test_the_check_refuses_pins_with_the_study_s_file(commands_unasked, tmp_path, stated, what):
    with pytest.raises(ProblemError, match=f"study.toml: clamps: site 1: {what}"):
        check_study(study_of(tmp_path, f"{COARSE}[clamps]\n{stated}\n"))


@pytest.mark.slow
def test_pins_that_miss_are_refused_with_the_study_s_file(context):
    clamps = context.study.clamps
    assert clamps is not None
    above = context.study.model_copy(update={"clamps": clamps.model_copy(update={"levels_mm": (300.0,)})})
    what = "study.toml: clamps: site 1: no clamping pin meets the skin; give clamps.angles_degrees"
    with pytest.raises(ProblemError, match=what):
        build_model(replace(context, study=above), above.sites[0])


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[clamps]\nforce_N = 0.0", "clamps.force_N: Input should be greater than 0"),
        ("[clamps]\nangles_degrees = [0.0, 90.0]", "clamps.angles_degrees: 0 is where the test pin is"),
        ("[clamps]\nangles_degrees = [90.0, 90.0]", "clamps.angles_degrees: two pins are at one angle"),
        ("[clamps]\nangles_degrees = [180.0, -180.0]", "clamps.angles_degrees: two pins are at one angle"),
        ("[clamps]\nlevels_mm = [0.0, 5.0]", "clamps: levels_mm has 2 levels for 11 pins"),
        ("[clamps]\nforce = 1.0", "clamps.force: unknown key"),
        ("[calibration]\nsearch_radius_mm = 50.0\n[clamps]", "calibration.search_radius_mm: without effect"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, text, what):
    with pytest.raises(StudyError, match=f"study.toml: .*{what}"):
        study_of(tmp_path, f"{COARSE}{text}\n")


def test_a_record_under_force_is_not_clamped(tmp_path):
    (tmp_path / "1.csv").touch()
    text = "[clamps]\n[[records]]\nsite = '1'\nname = 'creep'\ntrace = '1.csv'\ncontrol = 'force'\n"
    edit(small_limb(tmp_path, f"{COARSE}{text}"), "depth_mm = 3.0\n", "")
    with pytest.raises(StudyError, match='1-creep has control = "force", which goes without clamps'):
        load_study(tmp_path)
