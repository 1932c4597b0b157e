"""Fibres along a flow: straight in a bar, around in a ring, the same in a part of a mesh; what has no way."""

from dataclasses import replace

import numpy as np
import pytest

from limbfit.errors import ProblemError
from limbfit.indentation import build_fibre_field, cut_neighbourhood
from limbfit.indentation.sites import compute_flow_directions
from limbfit.mesh import Mesh
from limbfit.mesh.cells import HEX, SIX_TETS, build_boxes
from tetrahedra import turn_upright


def bar(bent: bool = False) -> Mesh:
    """Muscle of 12 x 6 x 60 mm under 3 mm of skin: from the cut at z = 60 to bone at z = 0; or bent into a
    quarter of a ring around the x axis."""
    x, y, z = np.linspace(0.0, 12.0, 4), np.linspace(0.0, 9.0, 7), np.linspace(0.0, 60.0, 13)
    points, corners = build_boxes(x, y, z)
    cells = turn_upright(points, corners[:, SIX_TETS].reshape(-1, 4))
    skin = points[cells][:, :, 1].mean(axis=1) > 6.0
    height = points[:, 2].copy()
    if bent:
        angle, radius = 0.5 * np.pi * height / 60.0, 30.0 + points[:, 1]
        points = np.column_stack([points[:, 0], radius * np.cos(angle), radius * np.sin(angle)])
        cells = turn_upright(points, cells)
    cut, bone = np.flatnonzero(height > 59.9), np.flatnonzero(height < 0.1)
    sets = {"fixed_proximal": cut, "fixed_bone": bone}
    return Mesh(points, cells, "tet4", (~skin).astype(int), ("skin", "muscle"), sets, {"skin": cells[:0, :3]})


def test_a_straight_bar_has_straight_fibres_in_its_muscle_only():
    mesh = bar()
    found = build_fibre_field([("muscle", "flow")], mesh)
    inside = mesh.regions == 1
    np.testing.assert_allclose(found[inside], np.tile([0.0, 0.0, -1.0], (inside.sum(), 1)), atol=1e-6)
    np.testing.assert_array_equal(found[~inside], np.tile([1.0, 0.0, 0.0], ((~inside).sum(), 1)))


def test_a_bent_one_has_fibres_that_go_around():
    """The potential falls with the angle, so fibres are circles: within 4 degrees in linear tetrahedra."""
    mesh = bar(bent=True)
    found = compute_flow_directions(mesh, "muscle")
    middle = mesh.points[mesh.cells[mesh.regions == 1]].mean(axis=1)
    around = np.column_stack([np.zeros(len(middle)), middle[:, 2], -middle[:, 1]])
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    assert np.degrees(np.arccos((found * around).sum(axis=1))).max() < 4.0


def test_a_part_of_the_mesh_keeps_the_fibres_of_the_whole():
    mesh = bar(bent=True)
    whole = build_fibre_field([("muscle", "flow")], mesh)
    part = cut_neighbourhood(mesh, np.array([6.0, 30.0, 20.0]), 20.0)
    assert 0 < part.cells.sum() < len(mesh.cells)
    np.testing.assert_array_equal(part.mesh.points[part.mesh.cells], mesh.points[mesh.cells[part.cells]])
    assert len(whole[part.cells]) == len(part.mesh.cells)


@pytest.mark.parametrize(
    ("name", "what"), [("fixed_proximal", "proximal cut"), ("fixed_bone", "end of the bone")]
)
def test_a_flow_without_a_way_is_refused(name, what):
    mesh = bar()
    with pytest.raises(ProblemError, match=what):
        compute_flow_directions(
            replace(mesh, node_sets={**mesh.node_sets, name: np.zeros(0, dtype=int)}), "muscle"
        )


def test_a_flow_needs_tetrahedra():
    points, corners = build_boxes(*[np.linspace(0.0, 1.0, 2)] * 3)
    mesh = Mesh(points, corners[:, HEX], "hex8", np.zeros(1, dtype=int), ("muscle",))
    with pytest.raises(ProblemError, match="tetrahedra"):
        compute_flow_directions(mesh, "muscle")
