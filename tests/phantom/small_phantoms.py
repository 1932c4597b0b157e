"""Phantoms in a fraction of the time: large voxels and triangles, and a formula in the place of the solver.

The formula takes the way of the ``mapping`` that `make_phantom` is given anyway.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest

from limbfit.phantom import geometry
from limbfit.phantom.mri import DETAIL_GRIDS
from limbfit.phantom.robot import TrueForce, simulate_true_force

SPACING_MM = 8.0  # of the grids on which surfaces are contoured
VOXELS = ((44, 30, 30), (5.9, 5.8, 6.0))


@contextmanager
def few_voxels() -> Iterator[None]:
    """What `make_phantom` makes meanwhile covers the same limb with voxels and triangles of 6 to 8 mm."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(DETAIL_GRIDS, "coarse", VOXELS)
        patch.setattr(
            geometry, "build_true_anatomy", partial(geometry.build_true_anatomy, spacing=SPACING_MM)
        )
        patch.setattr(
            geometry, "build_outer_surface", partial(geometry.build_outer_surface, spacing=SPACING_MM)
        )
        yield


def cubic_law(function, jobs):
    """Force 0.02 d^3 newton on the way in, a little less on the way out; no mesh is needed for it.

    Where cameras are wanted two points follow the indenter by a half and a tenth.
    """
    for job in jobs:
        if function is not simulate_true_force:
            yield None
            continue
        ramp = job.site.ramp
        times = np.linspace(0, 2 * ramp.peak_s, 101)
        depth = np.interp(times, *ramp.knots)
        lag = np.where(times > ramp.peak_s, 0.8, 1.0)
        points = job.site.position + np.array([[14.0, 0.0, 0.0], [0.0, 22.0, 0.0]]) * job.measurements.surface
        moves = np.multiply.outer(np.outer([0.5, 0.1], job.site.axis), depth)[: 2 * job.measurements.surface]
        force = lag * 0.02 * depth**3
        yield TrueForce(times, force, {"element": "none"}, {}, points[: len(moves)], moves)
