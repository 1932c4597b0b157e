"""A bone thinner than the grid that is cut along it stays whole, and a mesh that lost it says so."""

from dataclasses import replace

import numpy as np
import pytest

from bodies import limb, revolved
from limbfit.anatomy.meshing import meshing
from limbfit.anatomy.meshing.background import compute_volumes
from limbfit.anatomy.meshing.layers import build_limb_fields
from limbfit.anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface

RADIUS, AT = 4.0, np.array([-17.0, 0.0, 0.0])
COARSE = MeshSettings(edge_near_mm=6.0, edge_far_mm=30.0, near_radius_mm=14.0, growth=0.9, flatness=1.6)


@pytest.fixture(scope="module")
def thin() -> Anatomy:
    """A limb with a thick bone and an oblique thin one, 11 mm below its skin."""
    whole = limb()
    rise = np.array([-60.0, -59.0, -45.0, -30.0, -15.0, 0.0, 6.0])
    rod = revolved(RADIUS * np.array([0.7, 1, 1, 1, 1, 1, 1]), rise, 24)
    lean = np.outer(rod.points[:, 2], [0.03, 0.06, 0.0])
    fibula = Surface(whole.cut_point + AT + rod.points + lean, rod.faces)
    return Anatomy(whole.skin, {**whole.bones, "fibula": fibula}, whole.cut_point, whole.cut_normal)


@pytest.fixture(scope="module")
def base(thin: Anatomy) -> BaseMesh:
    return build_base_mesh(thin, COARSE)


def test_the_base_keeps_a_bone_half_as_thick_as_its_grid_is_wide(thin: Anatomy, base: BaseMesh) -> None:
    """The volume that it takes from the core is three quarters of its own; an even grid keeps a third."""
    assert COARSE.base_spacing_mm > 1.85 * RADIUS
    without = Anatomy(thin.skin, {"tibia": thin.bones["tibia"]}, thin.cut_point, thin.cut_normal)
    core = [
        np.abs(compute_volumes(made.grid.points, made.grid.tets)).sum()
        for made in (build_base_mesh(without, COARSE), base)
    ]
    own = np.pi * RADIUS**2 * 60.0
    assert 0.75 * own < core[0] - core[1] < 1.05 * own


def test_only_thin_bone_is_found_thin(thin: Anatomy) -> None:
    fields = build_limb_fields(thin, COARSE.layers, COARSE.bone_clearance_mm)
    places = fields.frame.to_patient(meshing.find_thin_bone(fields, COARSE.base_spacing_mm))
    assert len(places) > 50
    assert (places[:, 0] < thin.cut_point[0] - 8.0).all()  # none of the bone of 9 mm radius at x = 8 mm
    assert (meshing.find_thin_bone(fields, 2.0)[:, 2] < -58.0).all()  # its tip at most


def test_a_mesh_that_lost_a_bone_says_so(
    thin: Anatomy, base: BaseMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    position, axis = thin.cut_point + np.array([-31.0, 0.0, -30.0]), np.array([1.0, 0.0, 0.0])
    settings = replace(COARSE, element="tet4")
    _, report = mesh_site(thin, position, axis, settings, base)
    assert "loses" not in " ".join(report.warnings)
    monkeypatch.setattr(meshing, "MAX_HALVINGS", 0)
    _, report = mesh_site(thin, position, axis, settings)
    assert any("the mesh loses part of the fibula" in line for line in report.warnings)
