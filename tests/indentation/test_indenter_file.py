"""A study whose indenter is a surface file: read, checked, and part of what makes results stale."""

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from editing import write_study
from limbfit.errors import InputError, StudyError
from limbfit.indentation import SiteModel, read_indenter
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.provenance import Keys
from limbfit.pipeline.simulation.simulations import SimulationJob, compute_job_digest
from limbfit.study import IndenterTable, Study

TEXT = """
[study]
name = "one limb"
[surfaces]
skin = "skin.stl"
[indenter]
shape = "stl"
file = "tool.stl"
[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [0.0, -50.0, 10.0]
"""


@pytest.fixture
def study(tmp_path: Path) -> Study:
    pv.Sphere(radius=9.0).save(tmp_path / "tool.stl")
    return write_study(tmp_path, TEXT)


def table(study: Study) -> IndenterTable:
    return study.indenter.model_copy(update={"file": study.path(study.indenter.file)})


def test_surface_is_read_into_the_frame_of_the_site(study):
    tool = read_indenter(table(study), (1.0, 2.0, 3.0), (0.0, -1.0, 0.0), None)
    assert tool.width == pytest.approx(18.0, abs=0.1)
    gaps = tool.signed_distance(np.array([[1.0, 1.0, 3.0], [1.0, 3.0, 3.0], [1.0, 11.0, 14.0]]))
    np.testing.assert_allclose(gaps, [1.0, -1.0, 2.0], atol=0.15)


@pytest.mark.parametrize(
    ("surface", "what"),
    [
        (pv.Plane(i_size=10.0, j_size=10.0), "is open"),
        (pv.Sphere(radius=0.01), "0.0199.* mm wide; give it in millimetres"),
        (pv.Sphere(radius=9.0, center=(50.0, 0.0, 0.0)), "beside its axis"),
    ],
)
def test_unusable_files_are_named_in_one_line(study, surface, what):
    surface.triangulate().save(table(study).file)
    with pytest.raises(InputError, match=f"tool.stl: .*{what}"):
        read_indenter(table(study), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), None)


def test_a_file_that_is_no_stl_is_named(study):
    table(study).file.write_text("no triangles here\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"tool.stl: holds no triangles; export"):
        read_indenter(table(study), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), None)


def test_a_changed_file_makes_calibration_and_simulations_stale(study):
    def keys() -> dict[str, str]:
        chain = compute_keys(study)
        own = [one for one in EXPERIMENTS if one.run.__module__.startswith("limbfit.")]  # no test's
        return chain | {one.name: Keys(study).compute_key(one, chain).digest for one in own}

    before = keys()
    pv.Sphere(radius=8.0).save(table(study).file)
    after = keys()
    fresh = {name for name in before if before[name] == after[name]}
    assert fresh == {"surfaces", "sites", "traces", "mesh", "socket", "socket_design"}
    model = SiteModel("1", Path("1.vtu"), "", (0, 0, 0), (0, 0, -1), (0, 1), (0, 1), indenter=table(study))
    other = SiteModel(**{**vars(model), "indenter_digest": "changed"})
    moved = SiteModel(**{**vars(model), "indenter": study.indenter})
    digests = [
        compute_job_digest(SimulationJob(m, ("skin", "muscle"), (1.0,), (0.0, 1.0)))
        for m in (model, other, moved)
    ]
    assert digests[0] != digests[1]
    assert digests[0] == digests[2]


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('"tool.stl"', '"none.stl"', "indenter.file: none.stl does not exist"),
        ('file = "tool.stl"\n', "", "needs a file"),
        ('shape = "stl"\n', "", "needs a file"),
    ],
)
def test_the_study_says_what_is_missing(study, old, new, what):
    with pytest.raises(StudyError, match=what):
        write_study(study.folder, TEXT.replace(old, new))
