"""Tissue under an indenter, where it is known."""

import numpy as np
import pytest
import pyvista as pv

from limbfit.anatomy.sites.sites import MAX_DEPTH_MM, measure_tissue_under
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface
from limbfit.anatomy.surfaces.triangles import from_pyvista


def cylinder(radius: float, offset: float = 0.0) -> Surface:
    mesh = pv.Cylinder(center=(offset, 0, 0), direction=(0, 0, 1), radius=radius, height=200, resolution=200)
    return from_pyvista(mesh.triangulate().clean())


@pytest.fixture(scope="module")
def limb() -> Anatomy:
    """A leg of 50 mm radius with a bone of 10 mm radius, 25 mm off its axis."""
    return Anatomy(
        cylinder(50.0), {"tibia": cylinder(10.0, 25.0)}, np.array([0, 0, 100.0]), np.array([0, 0, 1.0])
    )


def test_it_is_the_distance_along_the_axis(limb):
    assert measure_tissue_under(limb, (50, 0, 0), (-1, 0, 0), 1.0) == pytest.approx(15.0, abs=0.1)


def test_the_thinnest_place_under_the_footprint_counts(limb):
    # Beside the bone's top the skin falls away slower than the bone: the middle is thinnest.
    assert measure_tissue_under(limb, (50, 0, 0), (-1, 0, 0), 20.0) == pytest.approx(15.0, abs=0.1)
    # 8 mm to the side the centre sees 16.9 mm, the edge of the footprint the bone's top.
    place = (np.sqrt(50**2 - 8**2), 8, 0)
    assert measure_tissue_under(limb, place, (-1, 0, 0), 20.0) < measure_tissue_under(
        limb, place, (-1, 0, 0), 1.0
    )


def test_without_bone_below_it_is_deep(limb):
    assert measure_tissue_under(limb, (0, 50, 0), (0, -1, 0), 20.0) == MAX_DEPTH_MM
    assert measure_tissue_under(limb, (-50, 0, 0), (1, 0, 0), 20.0) == MAX_DEPTH_MM
