"""A limb under pressure: a ball of tissue around a rigid one in closed form; the surface that comes of it."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv

from limbfit.donning import build_pressed_problem, extract_outer_surface, press_limb
from limbfit.errors import ProblemError
from limbfit.fe import NeoHookean
from limbfit.mesh import TET10_EDGES, Mesh, boundary_faces, to_tet10

INNER, OUTER, LAYERS = 12.0, 30.0, 3
MU, RATIO = 0.01, 4.0


def ball() -> Mesh:
    """A shell of quadratic tetrahedra between two spheres; the inner one is held."""
    layers = np.linspace(INNER, OUTER, LAYERS + 1)
    sphere = pv.Icosphere(radius=1.0, nsub=2)
    directions, faces = np.asarray(sphere.points, dtype=float), np.sort(sphere.regular_faces, axis=1)
    points = np.vstack([r * directions for r in layers])
    n, cells = len(directions), []
    for k in range(len(layers) - 1):
        a, b = faces + k * n, faces + (k + 1) * n
        # Prisms with sorted corners: their diagonals meet.
        cells += [np.column_stack([a, b[:, 2]]), np.column_stack([a[:, :2], b[:, 1:]])]
        cells += [np.column_stack([a[:, :1], b])]
    tets = np.vstack(cells)
    mesh = Mesh.from_arrays(points, tets, np.full(len(tets), "muscle"))
    boundary = boundary_faces(mesh)
    outside = np.linalg.norm(points[boundary], axis=2).min(axis=1) > 0.5 * (INNER + OUTER)
    held = np.unique(boundary[~outside])
    mesh = to_tet10(replace(mesh, node_sets={"fixed_bone": held}, face_sets={"skin": boundary[outside]}))
    # Mid-edge nodes between nodes of one sphere go onto it.
    radius, moved = np.linalg.norm(mesh.points, axis=1), mesh.points.copy()
    ends = np.linalg.norm(mesh.points[mesh.cells[:, :4]], axis=2)
    for (first, second), middle in zip(TET10_EDGES, mesh.cells[:, 4:].T, strict=True):
        along = np.isclose(ends[:, first], ends[:, second])
        nodes = middle[along]
        moved[nodes] = mesh.points[nodes] * (ends[along, first] / radius[nodes])[:, None]
    return mesh.with_points(moved)


def test_a_ball_around_a_rigid_one_is_the_closed_form() -> None:
    """u = A (r - a^3 / r^2) with A = -p / (3 K + 4 mu a^3 / b^3): linear elasticity; 1 %."""
    mesh = ball()
    count = len(mesh.face_sets["skin"])
    pressure = 1e-3 * MU * 1e3  # kPa: a thousandth of the shear modulus
    problem = build_pressed_problem(
        mesh, {"muscle": NeoHookean(MU, kappa_ratio=RATIO)}, np.full(count, pressure), 1.0, 0.0
    )
    result = press_limb(problem)
    assert result.completed, result.reason
    bulk = RATIO * MU
    a = -1e-3 * pressure / (3 * bulk + 4 * MU * (INNER / OUTER) ** 3)
    expected = a * (OUTER - INNER**3 / OUTER**2)
    before, after = extract_outer_surface(mesh), extract_outer_surface(mesh, result.states[-1].u)
    inwards = np.linalg.norm(after.points, axis=1) - np.linalg.norm(before.points, axis=1)
    assert inwards.mean() == pytest.approx(expected, rel=0.01)
    assert np.abs(inwards - expected).max() < 0.05 * abs(expected)


def test_the_pressure_is_kept_in_levels() -> None:
    mesh = ball()
    count = len(mesh.face_sets["skin"])
    field = np.linspace(0.0, 8.0, count)
    problem = build_pressed_problem(mesh, {"muscle": NeoHookean(MU)}, field, 2.0, 10.0)
    found = np.zeros(count)
    rows = {tuple(face): i for i, face in enumerate(mesh.face_sets["skin"])}
    for one in problem.pressures:
        found[[rows[tuple(face)] for face in one.faces]] = 1e3 * one.at(12.0)
    assert np.abs(found - field).max() <= 0.5 * 8.0 / 32 + 1e-9
    with pytest.raises(ProblemError, match="no pressure is stated"):
        build_pressed_problem(mesh, {"muscle": NeoHookean(MU)}, np.zeros(count), 2.0, 0.0)


def test_the_surface_has_the_area_of_a_sphere() -> None:
    surface = extract_outer_surface(ball())
    assert surface.face_areas.sum() == pytest.approx(4 * np.pi * OUTER**2, rel=0.01)
    assert surface.volume == pytest.approx(4 / 3 * np.pi * OUTER**3, rel=0.01)  # closed, outwards
