"""Every site of the phantom is meshed and simulated to its end, without a setting of its own."""

from __future__ import annotations

import numpy as np
import pytest

from limbfit.anatomy.surfaces.surfaces import save_anatomy
from limbfit.phantom.build import _ramp, _triple, true_parameters
from limbfit.phantom.forces import DISCRETISATIONS, ForceJob, TruthMeshJob, site_force, site_mesh
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.sites import true_sites
from limbfit.phantom.surfaces import true_anatomy

NAMES = [f"{number:02d}" for number in range(1, 19)]


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    limb = make_limb(0)
    folder = tmp_path_factory.mktemp("anatomy")
    save_anatomy(folder, true_anatomy(limb))
    return folder, {site.name: site for site in true_sites(limb, 0)}


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_site_is_simulated_to_its_end(phantom, name):
    folder, sites = phantom
    site = sites[name]
    made, at, axis = DISCRETISATIONS["coarse"], _triple(site.position), _triple(site.axis)
    mesh = site_mesh(TruthMeshJob(name, folder, at, axis, made.mesh, made.within_mm))
    steps = made.steps(site.thickness)
    found = site_force(ForceJob(name, mesh, at, axis, _ramp(site), steps, true_parameters(0)))
    peak = int(np.argmax(found.force))
    assert 2.0 < found.force[peak] < 20.0
    assert found.times[peak] == pytest.approx(site.depth / site.speed, rel=0.02)
    assert np.all(np.diff(found.force[:peak]) > -0.02)
    assert found.force[-1] == pytest.approx(0.0, abs=0.05)
