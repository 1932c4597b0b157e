"""A shape registered from outside the package: its distance and facets, in studies, and identified."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from guide import from_the_guide, identified
from layered import build_block_site, layered_block
from limbfit import Indenter, Measure, load_study, register_shape
from limbfit.bench.timing import build_punched_block
from limbfit.errors import InputError, ProblemError, StudyError
from limbfit.extensions import load_extensions
from limbfit.fe import StepControl, solve
from limbfit.febio import FebSettings, read_feb, to_problem, write_feb, write_inp
from limbfit.indentation import SiteModel, simulate
from limbfit.indentation.simulating import _prepared
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.simulation.simulations import SimulationJob, compute_job_digest
from limbfit.pipeline.variants.sensitivity import list_other_indenters
from limbfit.shapes import RESERVED_KEYS, SHAPES, Shape
from limbfit.study import IndenterTable, SolverTable

FRAME = {"centre": (0.4, -0.3, 1.0), "axis": (0.05, 0.1, -1.0)}


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    return from_the_guide("Tapered(", tmp_path_factory.mktemp("extension") / "tapered.py")


@pytest.fixture(scope="module")
def shape(file) -> type[Shape]:
    load_extensions([file])
    return SHAPES["tapered"]


def tapered(**changes) -> Indenter:
    return Indenter(**{"shape": "tapered", "width": 20.0, "edge_radius": 2.0} | changes)


@pytest.mark.parametrize("taper", [0.0, 12.0, 20.0])
def test_its_derivatives_are_those_of_its_distance(shape, taper):
    tool, h = tapered(measures={"taper_deg": taper}), 1e-6
    points = np.random.default_rng(0).uniform([-13, -13, -6], [13, 13, 2], (600, 3))
    values, slopes, bends = tool.local_distance(points)
    keep = values > -1.8  # deeper, the way out is through the front: a jump
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1.0, atol=1e-12)
    for i, step in enumerate(h * np.eye(3)):
        ahead, back = tool.local_distance(points + step), tool.local_distance(points - step)
        change, bend = (ahead[0] - back[0]) / (2 * h), (ahead[1] - back[1]) / (2 * h)
        np.testing.assert_allclose(change[keep], slopes[keep, i], atol=1e-5)
        smooth = keep & (np.abs(ahead[1] - back[1]).max(axis=1) < 1e-4)  # no edge of a zone within the step
        assert smooth.sum() > 0.95 * keep.sum()
        np.testing.assert_allclose(bend[smooth], bends[smooth, i], atol=1e-4)


def test_without_a_taper_it_is_the_cylinder(shape):
    points = np.random.default_rng(1).uniform([-14, -14, -9], [14, 14, 3], (2000, 3))
    mine = tapered(measures={"taper_deg": 0.0}).local_distance(points)
    theirs = Indenter("cylinder", 20.0, 2.0).local_distance(points)
    for found, wanted in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_its_wall_leans_by_its_taper(shape):
    tool = tapered(measures={"taper_deg": 10.0})
    down = np.array([[0.0, 0.0, 1.0], [12.0, 0.0, -8.0]])
    values, slopes, _ = tool.local_distance(down)
    assert values[0] == pytest.approx(1.0)
    assert np.degrees(np.arctan2(slopes[1, 2], slopes[1, 0])) == pytest.approx(10.0)


def test_it_pushes_harder_than_a_cylinder_of_the_same_end_and_comes_back(shape):
    """Its wall widens: tissue is pushed aside by more."""
    control = StepControl(load_steps=4, unload_steps=3)
    problem = build_punched_block("tet4", 6)
    start = {"width": 12.0, "edge_radius": 1.5, "centre": (0.0, 0.0, 1.0)}
    results = [
        solve(replace(problem, indenter=tool), control)
        for tool in (tapered(measures={"taper_deg": 20.0}, **start), Indenter("cylinder", **start))
    ]
    assert all(result.completed for result in results)
    assert results[0].force.max() > 1.002 * results[1].force.max()
    assert results[0].force[-1] == 0.0


def test_febio_is_given_its_front(tmp_path, shape):
    """Every point of the faceted body lies on it, and ahead of it both have the same distance."""
    problem = replace(build_punched_block("tet4", 4), indenter=tapered(**FRAME))
    tool = write_feb(problem, tmp_path / "model.feb", FebSettings())
    front = tool.points[np.unique(tool.front)]
    found = to_problem(read_feb(tmp_path / "model.feb")).indenter
    assert found is not None
    start = problem.indenter.move((np.array(found.centre) - problem.indenter.centre) @ found.frame[2])
    assert np.abs(start.signed_distance(front)).max() < 1e-9
    ahead = np.random.default_rng(1).uniform([-7, -7, 0.1], [7, 7, 3], (200, 3)) @ start.frame
    ahead += np.asarray(start.centre)
    assert np.abs(found.signed_distance(ahead) - start.signed_distance(ahead)).max() < 0.05
    write_inp(problem, tmp_path / "model.inp", "abaqus", FebSettings())


def test_impossible_shapes_are_refused(shape):
    with pytest.raises(InputError, match="indenter shape 'square' exists already"):
        register_shape(SHAPES["square"])
    with pytest.raises(InputError, match="no indenter shape is named 'unheard-of'; use square, sphere"):
        Indenter("unheard-of")
    with pytest.raises(ProblemError, match="'tapered' has no angle; its own measures: taper_deg"):
        tapered(measures={"angle": 3.0})
    with pytest.raises(ProblemError, match=r"taper_deg = 60 of .* is not between 0 and 20"):
        tapered(measures={"taper_deg": 60.0})
    assert set(IndenterTable.model_fields) == set(RESERVED_KEYS)
    for measure, what in ((Measure("width_mm", 1.0, 0.0, 2.0), "is a key of every shape"),
                          (Measure("a_mm", 3.0, 0.0, 2.0), "needs lower <= value <= upper")):  # fmt: skip

        @dataclass(frozen=True)
        class Wrong(shape):  # type: ignore[valid-type,misc]
            name: ClassVar = "wrong"
            measures: ClassVar = (measure,)

        with pytest.raises(InputError, match=what):
            register_shape(Wrong)


TEXT = """
[study]
name = "own shape"
extensions = ["tapered.py"]
[surfaces]
skin = "skin.stl"
[indenter]
shape = "tapered"
width_mm = 18.0
edge_radius_mm = 2.0
taper_deg = 10.0
[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [0.0, -50.0, 10.0]
"""


@pytest.fixture
def study(tmp_path, file, shape) -> Path:
    for name in ("skin.stl", "1.csv"):
        (tmp_path / name).write_text(name)
    shutil.copy(file, tmp_path / "tapered.py")
    (tmp_path / "study.toml").write_text(TEXT, encoding="utf-8")
    return tmp_path


def changed(study: Path, old: str, new: str) -> Path:
    assert old in TEXT
    (study / "study.toml").write_text(TEXT.replace(old, new), encoding="utf-8")
    return study


def test_a_study_gives_its_measures(study):
    whole = load_study(study)
    assert whole.indenter.measures == {"taper_deg": 10.0}
    assert whole.indenter.model_dump()["taper_deg"] == 10.0
    usual = load_study(changed(study, "taper_deg = 10.0\n", ""))
    assert usual.indenter.measures == {"taper_deg": 15.0}
    before, after = compute_keys(whole), compute_keys(usual)
    stale = {name for name in before if before[name] != after[name]}
    assert {"calibrate", "predict"} <= stale
    model = SiteModel("1", Path("1.vtu"), "", (0, 0, 0), (0, 0, -1), (0, 1), (0, 1), indenter=whole.indenter)
    other = replace(model, indenter=usual.indenter)
    digests = [compute_job_digest(SimulationJob(m, ("skin",), (1.0,), (0.0, 1.0))) for m in (model, other)]
    assert digests[0] != digests[1]


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (
            '"tapered"\n',
            '"cone"\n',
            "indenter.shape: no indenter shape is named 'cone'; .*tapered",
        ),
        ('"tapered"\n', '"cylinder"\n', "indenter.taper_deg: unknown key; see docs/study"),
        ("taper_deg = 10.0", "taper = 10.0", "indenter.taper: unknown key"),
        ("taper_deg = 10.0", 'taper_deg = "steep"', "indenter.taper_deg: .*number"),
        ("taper_deg = 10.0", "taper_deg = nan", "indenter.taper_deg: .*finite"),
        ("taper_deg = 10.0", "taper_deg = 30.0", "indenter: taper_deg = 30 of .* between 0 and 20"),
        ("taper_deg = 10.0", 'file = "skin.stl"', "needs a file"),
        ("-50.0, 10.0]", "-50.0, 10.0]\nedge = [0.0, 0.0, 1.0]", "without effect: the indenter is round"),
    ],
)
def test_what_is_wrong_names_its_key(study, old, new, what):
    with pytest.raises(StudyError, match=what):
        load_study(changed(study, old, new))


def test_the_experiment_compares_it_with_the_others(study):
    own = load_study(study).indenter
    rows = list_other_indenters(own)
    assert [label for label, _, _ in rows] == [
        "tapered of the study", "square", "square, rounded edge", "sphere", "cylinder", "tapered",
    ]  # fmt: skip
    assert rows[-1][1].measures == {"taper_deg": 15.0}


def test_reports_call_it_by_its_words(shape):
    settings = {"shape": "tapered", "width_mm": 18.0, "edge_radius_mm": 2.0, "taper_deg": 10.0}
    assert (
        shape.describe(settings) == "tapered indenter of 18.0 mm (edge radius 2.0 mm, taper in degrees 10.0)"
    )


def test_a_shape_that_is_edited_between_two_simulations_of_a_session_is_simulated_anew(file, tmp_path):
    """What a process keeps of a site is that of the file as it was."""
    text = file.read_text().replace('"tapered"', '"narrowed"')
    own, mesh = tmp_path / "narrowed.py", layered_block((3.0, 12.0), ("skin", "muscle"), 24.0, 2, 8.0)
    own.write_text(text)
    load_extensions([own])
    steps = SolverTable(load_steps=2, unload_steps=2)
    model = build_block_site("a", tmp_path / "a.vtu", mesh, 2.0, steps)
    table = IndenterTable(shape="narrowed", width_mm=24.0, edge_radius_mm=2.0)
    model = replace(model, indenter=table, extensions=(own,))
    job = SimulationJob(model, mesh.region_names, 2 * (5.0, 3.0, 1.0, 1.0), (1.0, 2.0), sensitivities=False)
    before = simulate(job).force_N
    own.write_text(text.replace("self.width / 2 - self.radius", "self.width / 4 - self.radius"))
    after = simulate(job).force_N
    _prepared.clear()
    assert np.array_equal(simulate(job).force_N, after)
    assert not np.array_equal(before, after)


STATED = """
[indenter]
shape = "tapered"
width_mm = 16.0
edge_radius_mm = 2.0
"""
TRUTH = {"c_kPa": 9.0, "m": 5.0, "gamma": 2.0, "tau_s": 0.5}


@pytest.mark.slow
def test_a_study_is_identified_with_it(tmp_path, file, shape):
    identified(tmp_path, file, STATED, TRUTH, within=0.05)
