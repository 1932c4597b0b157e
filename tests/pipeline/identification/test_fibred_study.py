"""Fibres in a study: which tissue has them, along what, what is searched, what is refused."""

from pathlib import Path

import numpy as np
import pytest

from guide import identified
from layered import block_context, block_study
from limbfit.errors import InputError, StudyError
from limbfit.fe import FibredMaterial, OgdenQLV
from limbfit.indentation import SimulationJob, build_materials, build_problem, simulate
from limbfit.mesh import read_vtu
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.identification.search import build_groupings, build_unknowns
from limbfit.pipeline.records.records import build_model
from limbfit.pipeline.simulation.limb_geometry import find_fibre_directions
from limbfit.pipeline.variants.cube import check_cube
from limbfit.study import Study

VALUES = {"c_kPa": 6.0, "m": 5.0, "gamma": 1.2, "tau_s": 0.5, "k1_kPa": 30.0, "k2": 3.0}
TRUTH = {"skin": VALUES | {"c_kPa": 9.0}, "muscle": VALUES}


def study_of(folder: Path, fibres: str = "", law: str = "ogden-fibres") -> Study:
    return block_study(folder, f'law = "{law}"\n{fibres}')


@pytest.fixture(scope="module")
def context(tmp_path_factory) -> Context:
    folder = tmp_path_factory.mktemp("fibres")
    return block_context(study_of(folder, "fibres = { muscle = [2.0, 0.0, 0.0] }"), TRUTH)


def test_the_core_has_fibres_along_the_limb_and_no_other_tissue(tmp_path):
    study = study_of(tmp_path)
    assert study.fibres == {"muscle": "axis"}
    assert study.fixed == ("skin.k1_kPa", "skin.k2")
    made = build_materials(TRUTH, 100.0, study.law.name, study.fibres)
    assert isinstance(made["skin"], OgdenQLV)
    assert isinstance(made["muscle"], FibredMaterial)
    assert made["muscle"].parameters == pytest.approx((0.006, 5.0, 1.2, 0.5, 0.03, 3.0))
    names = build_unknowns(study).names
    still = [name for name, group in zip(names, build_groupings(study)[-1], strict=True) if group < 0]
    assert still == ["skin.k1_kPa", "skin.k2"]


def test_their_direction_decides_the_calibration(tmp_path):
    before = compute_keys(study_of(tmp_path))
    after = compute_keys(study_of(tmp_path, "fibres = { muscle = [0.0, 1.0, 0.0] }"))
    assert {stage for stage in before if before[stage] != after[stage]} == {"calibrate", "predict", "report"}


def test_the_axis_is_the_normal_of_the_proximal_cut(context):
    assert find_fibre_directions(context.study, context.results) == (("muscle", (1.0, 0.0, 0.0)),)
    along = study_of(context.study.folder)
    axis = find_fibre_directions(along, context.results)
    assert axis == (("muscle", (0.0, 0.0, -1.0)),)


def test_a_flow_is_known_site_by_site(context):
    """The study names it; the directions follow from each mesh."""
    study = study_of(context.study.folder, 'fibres = { muscle = "flow" }')
    assert find_fibre_directions(study, context.results) == (("muscle", "flow"),)


def test_a_site_s_problem_has_them_and_its_force_their_derivatives(context):
    model = build_model(context, context.study.recorded[0])
    problem = build_problem(model, read_vtu(model.mesh), TRUTH)
    inside = problem.mesh.regions == problem.mesh.region_names.index("muscle")
    np.testing.assert_array_equal(problem.fibres[inside], np.tile([1.0, 0.0, 0.0], (inside.sum(), 1)))
    study = context.study
    flat = study.vector(TRUTH)
    times = (model.knots_s[1],)
    job = SimulationJob(model, study.tissues, tuple(flat), times, True)
    found = simulate(job)
    assert found.completed
    names = [f"{tissue}.{key}" for tissue, key in study.parameters]
    slopes = dict(zip(names, found.jacobian[0], strict=True))
    assert slopes["skin.k1_kPa"] == slopes["skin.k2"] == 0.0
    for name in ("muscle.k1_kPa", "muscle.k2"):
        forces = []
        for sign in (1, -1):
            moved = np.where([name == n for n in names], flat * (1.0 + 0.02 * sign), flat)
            forces.append(
                simulate(SimulationJob(model, study.tissues, tuple(moved), times, False)).force_N[0]
            )
        difference = (forces[0] - forces[1]) / (0.04 * flat[names.index(name)])
        assert slopes[name] == pytest.approx(difference, rel=0.01)


@pytest.mark.parametrize(
    ("fibres", "law", "what"),
    [
        ("fibres = { bone = 'axis' }", "ogden-fibres", "material.fibres.bone: no such tissue"),
        ("fibres = { muscle = [0.0, 0.0, 0.0] }", "ogden-fibres", "muscle: a direction of no length"),
        ("fibres = { muscle = 'across' }", "ogden-fibres", "material.fibres"),
        ("fibres = { muscle = 'axis' }", "ogden", "without effect: the tissues' law has no fibres"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, fibres, law, what):
    with pytest.raises(StudyError, match=what):
        study_of(tmp_path, fibres, law)


def test_the_cube_takes_no_fibres(context):
    with pytest.raises(InputError, match="the cube compares isotropic tissues"):
        check_cube(context.study, None, {"compression_percent": 10.0})


@pytest.mark.slow
def test_a_study_identifies_fibres_beside_what_is_known(tmp_path):
    """Of one tissue with fibres in all of it, its exponents known; forces alone tell them not apart."""
    stated = '[material]\nlaw = "ogden-fibres"\nfibres = { skin = [1, 0, 0], muscle = [1, 0, 0] }\n'
    for key in ("m", "k2"):
        stated += f'[calibration.prior."muscle.{key}"]\nmedian = {VALUES[key]}\nfactor = 1.03\n'
    identified(tmp_path, None, stated, VALUES, within=0.15)
