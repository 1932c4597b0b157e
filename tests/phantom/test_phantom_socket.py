"""The phantom's socket: it fits any limb, and is read back from its file as deep as its truth says."""

from pathlib import Path

import numpy as np
import pytest
from small_phantoms import cubic_law

from limbfit.anatomy.grid import build_limb_frame
from limbfit.anatomy.surfaces.surfaces import load_anatomy, write_surface
from limbfit.phantom import make_limb, make_phantom
from limbfit.phantom.build import LINER_MM, make_socket
from limbfit.phantom.geometry import build_outer_surface, build_true_anatomy
from limbfit.pipeline.socket.shape import build_socket
from limbfit.socket import read_socket
from limbfit.study import load_study


@pytest.mark.slow
def test_a_socket_beside_the_patient(tmp_path: Path) -> None:
    def simulate(function, jobs):
        assert list(tmp_path.glob(".study-*/socket/socket.stl"))  # made before anything is simulated
        return cubic_law(function, jobs)

    truth = make_phantom(tmp_path / "study", seed=2, socket=True, sites=["01"], mapping=simulate)["socket"]
    study = load_study(tmp_path / "study")
    assert study.socket.file == Path(truth["file"])
    assert study.socket.liner.thickness_mm == truth["liner_mm"]
    anatomy = load_anatomy(tmp_path / "study" / "truth")
    liner = build_outer_surface(make_limb(2), LINER_MM)
    socket = build_socket(study, anatomy, liner)
    assert socket.notes == ()
    assert socket.volume_mm3 == pytest.approx(truth["volume_mm3"], rel=1e-4)
    depth = socket.offset(liner)
    for area in truth["areas"]:
        near = np.linalg.norm(socket.points - area["position_mm"], axis=1).argmin()
        if area["depth_mm"] > 0:
            assert depth[near] > 0.6 * area["depth_mm"]
    assert 1.0 < np.median(depth) < 2.5  # 3 % of a radius of some 60 mm


def check_socket(seed: int, file: Path | None = None) -> None:
    """The socket of a coarse limb, where it decides as on the fine one; read back from a file, if given."""
    anatomy, liner = (
        build_true_anatomy(make_limb(seed), 8.0),
        build_outer_surface(make_limb(seed), LINER_MM, 8.0),
    )
    socket, areas = make_socket(anatomy, liner)
    assert anatomy.height(socket.points).max() < -20.0  # below the cut, with the brim's flare
    depth = socket.offset(liner)
    depths = [depth[np.linalg.norm(socket.points - a.position, axis=1).argmin()] for a in areas]
    assert np.all(np.array(depths[:3]) > [5.0, 4.0, 5.0])  # pressed in, besides 3 % of some 60 mm
    assert np.all(np.array(depths[3:]) < 0.5)  # relieved
    if file is not None:
        write_surface(file, socket.surface)
        frame = build_limb_frame(anatomy.cut_point, anatomy.cut_normal)
        assert not read_socket(file, outer=liner, frame=frame, bones=anatomy.bones).notes


def test_its_bar_bears_on_the_patellar_tendon(tmp_path: Path) -> None:
    check_socket(4, tmp_path / "socket.stl")


@pytest.mark.slow
def test_every_seed_has_a_socket_that_is_read_back(tmp_path: Path) -> None:
    for seed in range(100):
        check_socket(seed, tmp_path / "socket.stl")
