"""Trees of surfaces: distances against closed forms, kept from query to query, left behind when sent."""

import pickle

import numpy as np
import pytest
import pyvista as pv

from limbfit.anatomy.meshing.improving import OPPOSITE, compute_worst_angles
from limbfit.anatomy.surfaces.triangles import Surface, from_pyvista
from limbfit.mesh import compute_dihedral_angles


@pytest.fixture(scope="module")
def cube() -> Surface:
    """Of 20 mm around the origin."""
    return from_pyvista(pv.Cube(x_length=20.0, y_length=20.0, z_length=20.0).triangulate().clean())


def test_signed_distance_of_a_cube(cube) -> None:
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (500, 3))
    beyond = np.abs(points) - 10.0
    wanted = np.where(
        (beyond < 0).all(axis=1), beyond.max(axis=1), np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    )
    distance, face, foot = cube.find_signed(points)
    np.testing.assert_allclose(distance, wanted, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), np.abs(wanted), atol=1e-12)
    corners = cube.triangles[face]
    assert np.abs(np.linalg.det(corners - foot[:, None])).max() < 1e-9  # the foot is in its face's plane
    assert [len(part) for part in cube.find_signed(np.zeros((0, 3)))] == [0, 0, 0]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(cube)).signed_distance(points), distance)


@pytest.mark.parametrize("corner", range(4))
def test_smallest_angles_are_those_of_the_mesh(corner) -> None:
    """Whichever corner is the tip; an inverted tetrahedron counts as -1."""
    random = np.random.default_rng(corner)
    points = random.normal(size=(200, 4, 3))
    volume = np.linalg.det(points[:, 1:] - points[:, :1])
    flat = points.reshape(-1, 3)
    wanted = compute_dihedral_angles(flat, np.arange(800).reshape(-1, 4)).min(axis=1)
    found = compute_worst_angles(points[:, corner, None], points[:, OPPOSITE[corner]])[:, 0]
    assert (volume > 0).sum() > 50
    np.testing.assert_allclose(found[volume > 0], wanted[volume > 0], atol=1e-6)
    assert (found[volume < 0] == -1.0).all()
