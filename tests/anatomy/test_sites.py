"""Sites: the nearest skin point, and the mean inward normal under a square footprint."""

import json
from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv

from bodies import limb
from limbfit.anatomy.sites.sites import compute_indenter_axis, compute_square_edges, project_to_skin
from limbfit.anatomy.surfaces.surfaces import Anatomy, read_surface
from limbfit.anatomy.surfaces.triangles import from_pyvista
from limbfit.errors import SiteError
from limbs import OPENLIMB


@pytest.fixture(scope="module")
def ball() -> Anatomy:
    skin = from_pyvista(pv.Sphere(radius=50.0, theta_resolution=90, phi_resolution=90).triangulate().clean())
    return Anatomy(skin, {}, np.array([0, 0, 50.0]), np.array([0, 0, 1.0]))


def test_projection_finds_the_nearest_skin_point(ball: Anatomy) -> None:
    direction = np.array([0.6, -0.64, 0.48])
    point, distance = project_to_skin(ball, 53.0 * direction)
    assert distance == pytest.approx(3.0, abs=0.05)
    np.testing.assert_allclose(point, 50 * direction, atol=0.1)


def test_a_site_off_the_skin_is_refused(ball: Anatomy) -> None:
    with pytest.raises(SiteError, match=r"lies 6\.\d mm off the skin; .*RAS"):
        project_to_skin(ball, [56.5, 0, 0])
    with pytest.raises(SiteError, match="finite"):
        project_to_skin(ball, [np.nan, 0, 0])


def test_axis_of_a_ball_points_to_its_centre(ball: Anatomy) -> None:
    position = 50.0 * np.array([0.6, -0.64, 0.48])
    axis = compute_indenter_axis(ball.skin, position, 20.0)
    assert np.linalg.norm(axis) == pytest.approx(1.0)
    np.testing.assert_allclose(axis, -position / 50.0, atol=0.01)


def test_axis_is_the_area_mean_over_a_ridge() -> None:
    """A roof of two planes, 10 and 40 degrees steep: the mean of area vectors, not of the faces' normals."""
    rise = np.tan(np.radians([10.0, 40.0]))
    points = [(x, y, -abs(x) * rise[int(x > 0)]) for x in (-40.0, 0.0, 40.0) for y in (-40.0, 40.0)]
    roof = pv.PolyData(np.array(points), faces=[3, 0, 2, 1, 3, 1, 2, 3, 3, 2, 4, 3, 3, 3, 4, 5]).subdivide(1)
    axis = compute_indenter_axis(from_pyvista(roof), [0.0, 0.0, 0.0], 20.0, edge=[0, 1, 0])
    slope = np.degrees(np.arctan2(-axis[0], -axis[2]))
    # Under a tilted square each plane is cut off at the same distance across the axis.
    areas = 1 / np.cos(np.radians([10.0 + slope, 40.0 - slope]))
    normals = np.array(
        [[-np.sin(np.radians(10)), np.cos(np.radians(10))], [np.sin(np.radians(40)), np.cos(np.radians(40))]]
    )
    mean = areas @ normals
    assert slope == pytest.approx(np.degrees(np.arctan2(mean[0], mean[1])), abs=1.0)


def test_square_edges_are_an_orthonormal_frame_with_the_axis() -> None:
    for axis in (np.array([0.6, 0.0, 0.8]), np.array([0, 0, 1.0])):
        frame = np.vstack([compute_square_edges(axis), axis])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(compute_square_edges(np.array([0, 1.0, 0]))[0], [1.0, 0, 0])
    with pytest.raises(SiteError, match="parallel"):
        compute_square_edges(np.array([0, 0, 1.0]), [0, 0, 2.0])


@pytest.mark.skipif(not OPENLIMB.is_dir(), reason="the shared mean limb is not beside the repository")
def test_axes_of_the_mean_limb_agree_with_those_given() -> None:
    anatomy = Anatomy(read_surface(OPENLIMB / "skin.stl"), {}, np.array([0, 0, 5.0]), np.array([0, 0, 1.0]))
    sites = json.loads((OPENLIMB / "sites.json").read_text(encoding="utf-8"))["sites"]
    for site in sites.values():
        point, distance = project_to_skin(anatomy, site["position"])
        assert distance < 0.5
        angle = np.degrees(
            np.arccos(compute_indenter_axis(anatomy.skin, point, 20.0) @ np.array(site["axis"]))
        )
        assert angle < 1.0


def test_a_site_at_the_cut_or_beyond_it_is_refused() -> None:
    """Where a skin goes on beyond the cut, as one from a file does, and where a cap closes it there."""
    for cut in (limb(), replace(limb(), cut_point=[12.0, -80.0, 280.0])):
        here, up = cut.cut_point + np.array([33.0, 0.0, 0.0]), cut.cut_normal
        for height in (0.0, 2.0):
            with pytest.raises(SiteError, match="lies on the proximal cut or beyond it; move the site"):
                project_to_skin(cut, here + height * up)
        assert cut.height(project_to_skin(cut, here - 2.0 * up)[0]) < -1.0


def test_the_cap_at_the_cut_does_not_tilt_the_axis_of_a_site_near_it() -> None:
    """On a limb that is narrower proximally the cap is seen from the side of the indenter."""
    whole, taper = limb(), -0.008
    points = whole.skin.points - whole.cut_point
    points[:, :2] *= 1.0 + taper * np.maximum(points[:, 2:] + 70.0, 0.0)
    cut = replace(whole, skin=replace(whole.skin, points=points + whole.cut_point))
    radius, slope = 34.0 - 3.0 * 6.0 / 70.0, 6.0 / 70.0  # of the limb without that taper, 3 mm below the cut
    where = np.array([radius * (1.0 + 67.0 * taper), 0.0, -3.0])
    place, _ = project_to_skin(cut, cut.cut_point + where)
    axis = compute_indenter_axis(cut.open_skin, place, 20.0)
    expected = np.degrees(np.arctan(slope * (1.0 + 67.0 * taper) + radius * taper))
    assert np.degrees(np.arcsin(axis[2])) == pytest.approx(expected, abs=1.0)
    assert np.degrees(np.arcsin(compute_indenter_axis(cut.skin, place, 20.0)[2])) < expected - 20.0
