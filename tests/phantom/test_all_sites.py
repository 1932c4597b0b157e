"""Sites of the phantom: all are simulated to their end on defaults; one shows what is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from layered import layered_block
from limbfit.anatomy.surfaces.surfaces import save_anatomy
from limbfit.phantom.build import draw_true_parameters
from limbfit.phantom.geometry import build_true_anatomy, make_limb
from limbfit.phantom.robot import (
    DISCRETISATIONS,
    ForceJob,
    SecondaryMeasurements,
    TrueSite,
    build_true_sites,
    mesh_true_site,
    simulate_true_force,
)
from small_limb import limb

NAMES = [f"{number:02d}" for number in range(1, 19)]


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    limb = make_limb(0)
    folder = tmp_path_factory.mktemp("anatomy")
    save_anatomy(folder, build_true_anatomy(limb))
    return folder, {site.name: site for site in build_true_sites(limb, 0)}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_site_is_simulated_to_its_end(phantom, name):
    folder, sites = phantom
    site = sites[name]
    made = DISCRETISATIONS["coarse"]
    mesh = mesh_true_site(site, folder, made.mesh, made.within_mm)
    found = simulate_true_force(ForceJob(site, mesh, made.steps(site.thickness), draw_true_parameters(0)))
    peak = int(np.argmax(found.force))
    assert 2.0 < found.force[peak] < 20.0
    assert found.times[peak] == pytest.approx(site.depth / site.speed, rel=0.02)
    assert np.all(np.diff(found.force[:peak]) > -0.02)
    assert found.force[-1] == pytest.approx(0.0, abs=0.05)


def test_only_the_tissue_about_a_site_is_kept(tmp_path):
    anatomy = limb()
    save_anatomy(tmp_path, anatomy)
    place, axis = anatomy.cut_point + np.array([31.0, 0.0, -35.0]), np.array([-1.0, 0.0, 0.0])
    site = TrueSite("05", "tibia", True, place, axis, 3.0, 0.96, 15.0, hint=place)
    edges = replace(DISCRETISATIONS["coarse"].mesh, edge_near_mm=8.0, element="tet4")
    mesh = mesh_true_site(site, tmp_path, edges, 25.0)
    away = np.linalg.norm(mesh.points[mesh.cells].mean(axis=1) - place, axis=1)
    assert len(mesh.cells) > 50
    assert 15.0 < away.max() < 40.0
    assert set(mesh.region_names) == {"skin", "muscle"}


def test_a_site_shows_what_is_asked_for_and_no_more():
    """The force is the same whatever is seen beside it."""
    top, axis = np.zeros(3), np.array([0.0, 0.0, -1.0])
    site = TrueSite("05", "tibia", True, top, axis, 3.0, 0.96, 15.0, hint=top)
    steps = replace(DISCRETISATIONS["coarse"].steps(site.thickness), load_steps=3, unload_steps=2)
    mesh = layered_block((3.0, 12.0), ("skin", "muscle"), half_mm=30.0, divisions=5)
    job = ForceJob(site, mesh, steps, draw_true_parameters(0))
    plain, found = (
        simulate_true_force(job),
        simulate_true_force(replace(job, measurements=SecondaryMeasurements(True, True, True))),
    )
    assert found.force == pytest.approx(plain.force, abs=1e-6 * plain.force.max())
    assert (plain.layers, len(plain.skin_points)) == ({}, 0)
    assert set(found.layers) == set(found.speeds) == {"skin", "muscle"}
    for tissue, speed in found.speeds.items():
        known = job.parameters[tissue]
        assert speed[0] == pytest.approx(np.sqrt(known["c_kPa"] * (1.0 + known["gamma"])), rel=1e-6)
    for thickness, lost in found.layers.values():
        assert 0.0 < lost.max() < thickness
    peak = int(np.argmax(found.force))
    assert found.skin_moves.shape == (len(found.skin_points), 3, len(found.times))
    assert np.linalg.norm(found.skin_moves[:, :, peak], axis=1).max() > 0.1
