"""What a study that states no tuning is solved with; the one knob, and what goes before it."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from layered import build_block_site, layered_block
from limbfit.bench.timing import SPEED
from limbfit.errors import StudyError
from limbfit.indentation import SimulationJob, simulate
from limbfit.indentation.sites import PENETRATION_FACTOR
from limbfit.pipeline.engine.provenance import record_settings
from limbfit.pipeline.identification.search import is_moved
from limbfit.pipeline.limb.mesh import build_coarse_settings, mesh_settings
from limbfit.study import Study, load_study
from limbfit.study.meshing import ACCURACIES, estimate_cells
from limbfit.study.tables import SolverTable

EDGES = ("edge_near_mm", "edge_far_mm", "near_radius_mm", "growth", "flatness")
STUDY = """\
[study]
name = "bare"
[surfaces]
skin = "skin.stl"
[[sites]]
name = "1"
trace = "1.csv"
fitted = true
position = [0.0, 0.0, 0.0]
"""


@pytest.fixture
def stated(tmp_path: Path) -> Any:
    """The study with a further table."""
    for name in ("skin.stl", "1.csv"):
        (tmp_path / name).write_text(name)

    def load(more: str = "") -> Study:
        (tmp_path / "study.toml").write_text(STUDY + more)
        return load_study(tmp_path)

    return load


def accuracy(study: Study) -> Any:
    return record_settings(study, dict.fromkeys(study.inputs, "0" * 64))["mesh"]["accuracy"]


def edges(settings: object) -> tuple[float, ...]:
    return tuple(asdict(settings)[key] for key in EDGES)  # type: ignore[call-overload]


RECORD = '[[records]]\nsite = "1"\nname = "fast"\ntrace = "1.csv"\n'
STATED = '[calibration]\nanswer = "{}"\n'


@pytest.mark.parametrize(
    ("more", "moves"),
    [
        ("", False),
        (RECORD, True),
        ('ultrasound = "1.csv"\n', True),
        (STATED.format("most probable"), True),
        (RECORD + STATED.format("least squares"), False),
        (RECORD + '[calibration]\nobjective = "paper"\n', False),
    ],
)
def test_the_answer_goes_by_the_records(stated: Any, more: str, moves: bool) -> None:
    """One record of force per site: the least squares; more: what is most probable, but for the paper."""
    assert is_moved(stated(more)) is moves


def test_a_bare_study_is_searched_on_less_and_corrected(stated: Any) -> None:
    study = stated()
    assert edges(mesh_settings(study)) == (3.5, 30.0, 14.0, 0.6, 1.6)
    assert mesh_settings(study).element == "tet10"
    assert study.mesh.element == "tet10p0"
    assert build_coarse_settings(study) is None
    assert study.within_mm == 65.0
    assert study.is_searched_apart
    assert (study.solver.load_steps, study.solver.unload_steps, study.solver.penalty_per_mm) == (8, 10, None)
    assert accuracy(study) == "standard"


def test_a_finer_accuracy_has_more_cells(stated: Any) -> None:
    counts = []
    for name in ("fast", "standard", "fine"):
        table = stated(f'[mesh]\naccuracy = "{name}"\n').mesh
        assert table.find_accuracy([20.0]) == name
        counts.append(
            estimate_cells(table.edge_near_mm, table.edge_far_mm, table.near_radius_mm, table.growth)
        )
    assert counts[0] < 0.75 * counts[1] < 0.75**2 * counts[2]


def test_fine_meshes_are_corrected_on_coarser_ones(stated: Any) -> None:
    coarse = build_coarse_settings(stated('[mesh]\naccuracy = "fine"\n'))
    assert coarse is not None
    assert edges(coarse) == tuple((ACCURACIES["fine"][1] or {})[key] for key in EDGES)


def test_what_is_stated_goes_before_the_knob(stated: Any) -> None:
    study = stated('[mesh]\naccuracy = "fine"\nedge_near_mm = 2.5\ngrowth = 0.5\n')
    assert edges(mesh_settings(study)) == (2.5, 24.0, 14.0, 0.5, 1.6)
    assert build_coarse_settings(study) is not None  # it is the knob's still
    assert accuracy(study) is None
    other = stated('[mesh]\naccuracy = "fine"\n[mesh.coarse]\nedge_near_mm = 4.5\n')
    assert edges(build_coarse_settings(other)) == (4.5, 30.0, 12.0, 0.9, 1.6)
    assert accuracy(other) is None


@pytest.mark.parametrize(
    ("widths", "near", "radius"), [((12.0,), 2.1, 8.4), ((16.0, 12.0), 2.1, 11.2), ((30.0, 20.0), 3.5, 14.0)]
)
def test_edges_suit_the_indenters(stated: Any, widths: tuple[float, ...], near: float, radius: float) -> None:
    """As much shorter as the narrowest is, as far as the widest; what is stated stays."""
    first, *more = widths
    indenters = f"[indenter]\nwidth_mm = {first}\n"
    indenters += "".join(f'[indenters.ball]\nshape = "sphere"\nwidth_mm = {width}\n' for width in more)
    study = stated(indenters)
    assert edges(mesh_settings(study)) == pytest.approx((near, 30.0, radius, 0.6, 1.6))
    assert accuracy(study) == "standard"
    fine = build_coarse_settings(stated('[mesh]\naccuracy = "fine"\n' + indenters))
    assert fine is not None
    assert fine.edge_near_mm == pytest.approx(5.5 * min(1.0, min(widths) / 20.0))
    own = stated("[mesh]\nedge_near_mm = 3.0\n" + indenters)
    assert own.mesh.edge_near_mm == 3.0
    assert accuracy(own) is None


def test_no_coarse_mesh_is_finer_than_the_own(stated: Any) -> None:
    assert build_coarse_settings(stated('[mesh]\naccuracy = "fine"\nedge_near_mm = 6.0\n')) is None
    narrow = "[indenter]\nwidth_mm = 12.0\n"  # its coarse edges are 3.3 mm
    assert build_coarse_settings(stated('[mesh]\naccuracy = "fine"\nedge_near_mm = 4.0\n' + narrow)) is None


def test_an_unknown_accuracy_is_refused(stated: Any) -> None:
    with pytest.raises(StudyError, match=r"mesh\.accuracy: .*'fast', 'standard' or 'fine'"):
        stated('[mesh]\naccuracy = "best"\n')


def test_contact_is_as_stiff_as_the_site_needs(tmp_path: Path) -> None:
    """Reference tissue takes half of the allowed penetration; on a part of the mesh more."""
    tissues, depth = ("skin", "muscle"), 5.0
    mesh = layered_block((3.0, 12.0), tissues)
    whole = build_block_site("a", tmp_path / "a.vtu", mesh, depth, SolverTable(load_steps=4, unload_steps=2))
    found = {}
    for name, model in (("whole", whole), ("part", replace(whole, within_mm=60.0))):
        job = SimulationJob(model, tissues, (5.0, 5.0, 1.0, 1.0) * 2, (depth / SPEED,), sensitivities=False)
        found[name] = simulate(job)
        assert "sunk" not in [doubt.kind for doubt in found[name].doubts]
    own, rough = (found[name].facts["penalty_per_mm"] for name in ("whole", "part"))
    assert own > 100.0  # 2000 over the width of 20 mm: thin tissue needs more
    assert max(100.0, own / PENETRATION_FACTOR) == pytest.approx(rough)
    assert found["whole"].penetration_mm == pytest.approx(0.005 * depth, rel=0.15)
    assert found["part"].force_N == pytest.approx(found["whole"].force_N, rel=0.03)
