"""Every site of the phantom is meshed and simulated to its end, without a setting of its own."""

from __future__ import annotations

import numpy as np
import pytest

from limbfit.anatomy.surfaces.surfaces import save_anatomy
from limbfit.phantom.build import _ramp, _triple, true_parameters
from limbfit.phantom.forces import MESHES, ForceJob, site_force
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
    flat = tuple(value for tissue in true_parameters(0).values() for value in tissue.values())
    job = ForceJob(
        name, folder, _triple(site.position), _triple(site.axis), _ramp(site), flat, MESHES["coarse"]
    )
    found = site_force(job)
    peak = int(np.argmax(found.force))
    assert 2.0 < found.force[peak] < 20.0
    assert found.times[peak] == pytest.approx(site.depth / site.speed, rel=0.02)
    assert np.all(np.diff(found.force[:peak]) > -0.02)
    assert found.force[-1] == pytest.approx(0.0, abs=0.05)
