"""A socket's simulation that goes on from a kept part is the one that went through, to the last bit.

With one thread: what several add up comes in any order.
"""

from dataclasses import asdict

import numpy as np
import pytest

from bodies import limb
from limbfit.anatomy.meshing.layers import LayerSpec
from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_limb
from limbfit.donning import Load, SocketFit, build_socket_problem, pack, simulate_donning, unpack
from limbfit.errors import ProblemError
from limbfit.fe import Checkpoints, OgdenQLV, StepControl, solve
from limbfit.pipeline.engine.store import ResultFiles
from limbfit.socket import Recipe, rectify_limb
from limbfit.socket.rectify import Trim

UP = np.array([0.0, 0.0, 1.0])
TISSUES = {"skin": OgdenQLV(0.009, 6.0, 2.0, 0.5), "muscle": OgdenQLV(0.004, 4.0, 3.0, 0.3)}


@pytest.fixture(scope="module")
def donned(tmp_path_factory):
    """The arguments of a simulation with derivatives, its outcome, and what was kept of each part."""
    anatomy, folder = limb(), tmp_path_factory.mktemp("parts")
    trim = Trim([(anatomy.cut_point - 26.0 * anatomy.cut_normal, anatomy.cut_normal)])
    socket = rectify_limb(
        anatomy.skin, anatomy.frame, Recipe(trim=trim, reduction_percent=3.0, distal_clearance_mm=3.0)
    )
    settings = MeshSettings(edge_near_mm=14.0, edge_far_mm=24.0, growth=0.6, layers=(LayerSpec("skin", 3.0),))
    mesh, _ = mesh_limb(anatomy, settings, 10.0)
    loads = [
        Load(name, force * UP, np.zeros(3), anatomy.cut_point, 1.0, hold)
        for name, force, hold in (("stance", 60.0, 0.0), ("walk", 90.0, 1.0))
    ]
    fit = SocketFit(anatomy.cut_point, UP, np.array([0.0, -1.0, 0.0]), 0.3, 1.0, 0.5, loads=loads)
    problem = build_socket_problem(mesh, TISSUES, socket, fit)
    middles = mesh.points[mesh.face_sets["skin"][:, :3]].mean(axis=1)
    given = problem, fit, {"front": middles[:, 1] < anatomy.cut_point[1] - 20.0}
    kept, places = ResultFiles(folder), []

    def keep(part):
        kept.put(str(len(places)), pack(part))
        places.append(kept.find(str(len(places))))

    return given, simulate_donning(*given, sensitivities=True, threads=1, keep=keep), places


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_what_goes_on_from_a_part_is_what_went_through(donned, which):
    """After donning, and after the first load: rows, fields and derivatives."""
    given, whole, places = donned
    assert len(places) == 2
    told: list[float] = []
    begin = unpack(*places[which])
    found = simulate_donning(
        *given,
        sensitivities=True,
        threads=1,
        keep=lambda part: None,
        begin=begin,
        on_row=lambda row: told.append(row.time),
    )
    assert list(begin.held) == ["donning", "stance"][: which + 1]
    assert min(told) > [1.5, 2.5][which]  # nothing before is done again
    assert len(told) < len(whole.rows)
    assert found.result.completed
    np.testing.assert_equal([asdict(row) for row in found.rows], [asdict(row) for row in whole.rows])
    np.testing.assert_equal(
        {name: asdict(one) for name, one in found.held.items()},
        {name: asdict(one) for name, one in whole.held.items()},
    )
    assert found.result.doubts == whole.result.doubts
    for count in ("steps", "cuts", "newton_iterations"):
        assert found.result.statistics[count] == whole.result.statistics[count]


def test_what_is_put_last_is_kept_until_it_is_dropped(tmp_path):
    kept = ResultFiles(tmp_path / "runs")
    assert kept.find("a") is None
    kept.put("a", ({"n": 1}, {"x": np.arange(3.0)}))
    kept.put("a", ({"n": 2}, {"x": np.arange(4.0)}))
    facts, arrays = kept.find("a")
    assert (facts, arrays["x"].tolist()) == ({"n": 2}, [0.0, 1.0, 2.0, 3.0])
    kept.drop("a")
    assert kept.find("a") is None
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.slow
def test_only_stated_times_can_be_gone_on_with(donned):
    (problem, *_), _, _ = donned
    with pytest.raises(ProblemError, match="with stated times"):
        solve(problem, StepControl(), checkpoints=Checkpoints([1.0], print))
