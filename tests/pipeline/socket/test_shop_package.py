"""The package of a socket for the shop: its files are those of the socket, its sheet names nobody."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from trimesh import load_mesh

from limbfit import compare_shapes, load_study, run_study
from limbfit.anatomy.surfaces.files import read_surface, write_surface
from limbfit.execution import SerialExecutor
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store
from limbfit.pipeline.socket.design import build_undeformed_socket
from limbfit.pipeline.socket.fabrication import write_shop_package
from limbfit.pipeline.socket.shape import build_socket_wall
from limbfit.pipeline.socket.simulation import SocketLimb
from small_limb import small_limb

SOCKET = "liner = { thickness_mm = 4.0 }\n[socket.design]\nwall_mm = 3.0\nadapter_diameter_mm = 30.0\n"


def test_the_package_holds_the_socket(tmp_path: Path) -> None:
    study = load_study(small_limb(tmp_path, SOCKET))
    run_study(study, until="surfaces")
    context = Context(study, Store(study.results), SerialExecutor(), lambda event: None)
    limb = SocketLimb.from_store(study, context.store, print)
    _, face = build_undeformed_socket(study, limb.anatomy, limb.outer.skin, ())
    wall = build_socket_wall(study, limb.anatomy, face)
    package = write_shop_package(tmp_path, limb, face, wall)
    shop = tmp_path / "shop"
    assert {file.name for file in shop.iterdir()} == set(package.files)
    assert not package.left_out
    assert load_mesh(shop / "wall.3mf").is_watertight
    assert compare_shapes(shop / "wall.stl", shop / "wall.3mf").max_mm < 1e-3
    write_surface(tmp_path / "face.stl", face.surface)
    assert compare_shapes(tmp_path / "face.stl", shop / "shape.aop").max_mm < 0.1
    assert read_surface(shop / "shape.aop").volume > 0.0
    with (shop / "trim-line.csv").open() as stream:
        trim = np.array([[float(value) for value in row.values()] for row in csv.DictReader(stream)])
    np.testing.assert_allclose(trim, face.points[face.brim], atol=1e-6)
    assert package.volumes_cm3[1] == pytest.approx(face.volume_mm3 / 1000.0)
    row = package.circumferences[1]
    assert row.second_mm == pytest.approx(row.first_mm, abs=0.5)  # nothing is reduced
    clearance = min(least for _, least, _ in package.depths_mm.values())
    assert clearance == pytest.approx(-3.0, abs=0.1)  # socket.distal_clearance_mm
    sheet = (shop / "check-sheet.html").read_text()
    assert (
        len(re.findall("<tr>", sheet))
        == 4 + len([*package.files, *package.circumferences, *package.depths_mm]) + 5
    )
    assert not any(word in sheet for word in (study.study.name, str(tmp_path), "20" + "26"))
