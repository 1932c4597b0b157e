"""Indenters as signed distances: derivatives, triangle surfaces against the other shapes, refusals."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv
from blocks import punch

from limbfit.errors import ProblemError
from limbfit.fe import Indenter, Problem, RigidSurface, StepControl, System, solve

BOX_FACES = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5],
                      [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])  # fmt: skip


def box(width: float = 20.0, height: float = 30.0) -> RigidSurface:
    h = width / 2
    square = np.array([[-h, -h], [h, -h], [h, h], [-h, h]])
    points = np.vstack([np.column_stack([square, np.full(4, z)]) for z in (-height, 0.0)])
    return RigidSurface(points, BOX_FACES)


def of_pyvista(poly: pv.PolyData) -> RigidSurface:
    poly = poly.triangulate().clean()
    return RigidSurface(np.asarray(poly.points, dtype=float), poly.regular_faces)


def ball(level: int) -> RigidSurface:
    return of_pyvista(pv.Icosphere(radius=10.0, nsub=level))


def tent() -> RigidSurface:
    """A ridge along x towards the tissue with a slanted end: edges and corners of all angles."""
    points = [[-8, -6, -9], [8, -6, -9], [8, 6, -9], [-8, 6, -9], [-7, 0, -1], [5, 1, 0.0]]
    faces = [[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4]]
    return RigidSurface(np.array(points, dtype=float), np.array(faces))


TOOLS = {
    "square": Indenter("square"),
    "rounded square": Indenter("square", 20.0, 2.0),
    "sphere": Indenter("sphere"),
    "cylinder": Indenter("cylinder"),
    "rounded cylinder": Indenter("cylinder", 20.0, 2.0),
    "box": Indenter("stl", edge_radius=2.0, surface=box()),
    "plate": Indenter("stl", surface=box(height=1.0)),
    "ball": Indenter("stl", surface=ball(3)),
    "tent": Indenter("stl", edge_radius=1.0, surface=tent()),
}


@pytest.mark.parametrize("name", TOOLS)
def test_distance_derivatives(name):
    tool, h = TOOLS[name], 1e-6
    radius = tool.body.radius
    points = np.random.default_rng(0).uniform([-13, -13, -6], [13, 13, 2], (400, 3))
    values, slopes, bends = tool.local_distance(points)
    keep = values > -0.9 * radius  # deeper, the way out is through the front: a jump
    np.testing.assert_allclose(np.linalg.norm(slopes, axis=1), 1.0, atol=1e-12)
    for i, step in enumerate(h * np.eye(3)):
        ahead, back = tool.local_distance(points + step), tool.local_distance(points - step)
        change, bend = (ahead[0] - back[0]) / (2 * h), (ahead[1] - back[1]) / (2 * h)
        np.testing.assert_allclose(change[keep], slopes[keep, i], atol=1e-5)
        smooth = keep & (np.abs(ahead[1] - back[1]).max(axis=1) < 1e-4)  # no edge of a zone within the step
        assert smooth.sum() > 0.95 * keep.sum()
        np.testing.assert_allclose(bend[smooth], bends[smooth, i], atol=1e-4)


@pytest.mark.parametrize("radius", [0.0, 2.0])
def test_box_of_triangles_is_the_square(radius):
    points = np.random.default_rng(1).uniform([-14, -14, -12], [14, 14, 3], (2000, 3))
    points = np.vstack([points, [[0, 0, -0.1], [1, 1, -3], [10, 10, 0], [9.9, 9.9, -0.1], [-10, 10, -0.05]]])
    mine = Indenter("stl", edge_radius=radius, surface=box()).local_distance(points)
    theirs = Indenter("square", 20.0, radius).local_distance(points)
    for found, wanted in zip(mine, theirs):
        np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_deep_points_go_back_out_of_the_front():
    deep = np.array([[9.0, 0.0, -6.0], [0, -9.7, -4]])
    values, slopes, _ = Indenter("stl", surface=box()).local_distance(deep)
    np.testing.assert_allclose(values, [-6.0, -4.0])
    np.testing.assert_allclose(slopes, [[0, 0, 1], [0, 0, 1]], atol=1e-12)


def test_fine_ball_is_the_sphere():
    points = np.random.default_rng(2).uniform([-9, -9, -9], [9, 9, 2], (500, 3))
    mine = Indenter("stl", surface=ball(4)).local_distance(points)
    theirs = Indenter("sphere").local_distance(points)
    near = (np.abs(theirs[0]) < 2.0) & (points[:, 2] > -8.0)
    assert near.sum() > 50
    np.testing.assert_allclose(mine[0][near], theirs[0][near], atol=0.02)
    np.testing.assert_allclose(mine[1][near], theirs[1][near], atol=0.05)


def test_surface_is_put_with_its_foremost_point_at_the_origin_and_outwards():
    points, faces = box().points + np.array([0, 0, 7.0]), BOX_FACES[:, ::-1]
    surface = RigidSurface(points, faces)
    assert surface.points[:, 2].max() == 0.0
    values = Indenter("stl", surface=surface).local_distance(np.array([[0.0, 0, 1.0], [0, 0, -1.0]]))[0]
    np.testing.assert_allclose(values, [1.0, -1.0])


@pytest.mark.parametrize("name", TOOLS)
def test_starts_just_touching(name):
    tool = TOOLS[name]
    far = replace(tool, centre=(0.4, 0.3, 37.0), axis=(0.02, 0.01, -1.0))
    system = System(punch("hex8", 4, 1, indenter=far))
    assert abs(system.bodies.first_body.surface.gaps_at_rest(system.indenter).min()) < 1e-6
    ahead = far.move(0.9 * np.linalg.norm(system.indenter.centre - np.array(far.centre)))
    assert system.bodies.first_body.surface.gaps_at_rest(ahead).min() > 0


def test_force_under_a_box_of_triangles_is_that_under_the_square():
    """Beside the middle: there, points below the edge make two equilibria, and rounding chooses."""
    control, at = StepControl(load_steps=3, unload_steps=3, tolerance=1e-7), (0.3, -0.4, 0.0)
    box_of_triangles = Indenter("stl", edge_radius=1.0, centre=at, surface=box())
    square = solve(punch("tet4", 2, 1, indenter=Indenter("square", 20.0, 1.0, centre=at)), control)
    triangles = solve(punch("tet4", 2, 1, indenter=box_of_triangles), control)
    assert square.completed
    np.testing.assert_allclose(triangles.force, square.force, rtol=1e-6, atol=1e-9)


def test_tent_of_triangles_pushes_in_and_comes_back():
    tool = Indenter("stl", centre=(0, 0, 1.0), surface=tent())
    result = solve(punch("tet4", 4, 1, indenter=tool), StepControl(load_steps=4, unload_steps=3))
    assert result.completed, result.reason
    assert result.penetration.max() <= 0.06
    assert result.force[-1] == 0.0


def within(depth: float) -> Problem:
    return punch("tet10", 2, 1, indenter=Indenter(centre=(0.5, 0.0, -depth)), start="as-given")


def test_start_inside_the_tissue_is_refused():
    with pytest.raises(ProblemError, match=r"starts 1\.3 mm inside the tissue, deepest at .*; move it out"):
        solve(within(1.3))
    assert System(within(0.0)).bodies.all


@pytest.mark.parametrize(
    ("points", "faces", "what"),
    [
        (box().points, BOX_FACES[1:], "is open"),
        (box().points, np.vstack([BOX_FACES[:1, ::-1], BOX_FACES[1:]]), "is open or not oriented"),
        (box().points, np.vstack([BOX_FACES, BOX_FACES]), "more than two faces"),
        (box().points * [1, 1, 0], BOX_FACES, "encloses no volume"),
        (box().points, BOX_FACES[:, [0, 1, 2, 2]], "not made of triangles"),
        (box().points, BOX_FACES + 1, "do not|does not have"),
        (box().points * np.nan, BOX_FACES, "finite"),
        (box().points * 1e-3, BOX_FACES, "0.02 mm wide.*millimetres"),
        (box().points * 1e3, BOX_FACES, "20000 mm wide"),
        (box().points + np.array([100, 0, 0]), BOX_FACES, "beside its axis"),
    ],
)
def test_unusable_surfaces_are_refused(points, faces, what):
    with pytest.raises(ProblemError, match=what):
        RigidSurface(points, faces)


def test_rounding_that_swallows_the_surface_is_refused_but_a_sharp_edge_takes_what_fits():
    with pytest.raises(ProblemError, match="cannot be rounded by 2 mm; give a smaller"):
        Indenter("stl", edge_radius=2.0, surface=box(height=3.0))
    assert Indenter("stl", surface=box(height=0.3)).body.radius == pytest.approx(0.1)


def test_shape_and_surface_belong_together():
    with pytest.raises(ProblemError, match="needs a surface"):
        Indenter("stl")
    with pytest.raises(ProblemError, match="'square' has no surface"):
        Indenter("square", surface=box())
