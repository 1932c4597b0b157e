"""The phantom's socket is read back from its file around the true limb, as deep as its truth says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_phantom_folder import cubic_law

from limbfit.anatomy.surfaces.surfaces import load_anatomy
from limbfit.phantom import make_limb, make_phantom
from limbfit.phantom.socket import LINER_MM
from limbfit.phantom.surfaces import outer_surface
from limbfit.pipeline.shared.socket_shape import socket_of
from limbfit.study import load_study


def test_a_socket_beside_the_patient(tmp_path: Path) -> None:
    truth = make_phantom(tmp_path / "study", seed=2, socket=True, sites=["01"], mapping=cubic_law)["socket"]
    study = load_study(tmp_path / "study")
    assert study.socket.file == Path(truth["file"])
    assert study.socket.liner.thickness_mm == truth["liner_mm"]
    anatomy = load_anatomy(tmp_path / "study" / "truth")
    liner = outer_surface(make_limb(2), LINER_MM)
    socket = socket_of(study, anatomy, liner)
    assert socket.notes == ()
    assert socket.volume_mm3 == pytest.approx(truth["volume_mm3"], rel=1e-4)
    depth = socket.offset(liner)
    for area in truth["areas"]:
        near = np.linalg.norm(socket.points - area["position_mm"], axis=1).argmin()
        if area["depth_mm"] > 0:
            assert depth[near] > 0.6 * area["depth_mm"]
    assert 1.0 < np.median(depth) < 2.5  # 3 % of a radius of some 60 mm
