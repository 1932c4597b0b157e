"""Readings beside the records count in the fit as what they tell to first order."""

from dataclasses import replace

import numpy as np
import pytest
from bars import PAPER, TRUTH, estimate, records, simulate

from limbfit.identify.fit.parameters import Prior, Unknowns
from limbfit.identify.fit.readings import LinearisedReadings, add_scatter

AT = np.log([5.0, 2.0, 0.5])


def make_readings(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences (n,), derivatives (n, 3) and a covariance (n, n) with a common gain."""
    random = np.random.default_rng(n)
    common = random.uniform(1.0, 2.0, n)
    return random.normal(size=n), random.normal(size=(n, 3)), np.eye(n) + np.outer(common, common)


@pytest.mark.parametrize("n", [40, 2])
def test_the_rows_have_the_optimum_and_the_curvature_of_all_readings(n):
    off, derivatives, covariance = make_readings(n)
    found = LinearisedReadings.weigh(off, derivatives, covariance, AT)
    inverse = np.linalg.inv(covariance)
    np.testing.assert_allclose(found.rows.T @ found.rows, derivatives.T @ inverse @ derivatives, atol=1e-12)
    slope = found.rows.T @ (found.rows @ AT - found.target)
    np.testing.assert_allclose(slope, -derivatives.T @ inverse @ off, atol=1e-12)
    assert len(found.rows) == min(n, 3)


def test_they_count_after_the_priors():
    off, derivatives, covariance = make_readings(9)
    found = LinearisedReadings.weigh(off, derivatives, covariance, AT)
    bounds = np.full(3, 0.1), np.full(3, 1.0), np.full(3, 9.0)
    lower, start, upper = bounds
    one = Unknowns(("a.c", "a.m", "a.g"), start, lower, upper, (Prior("a.m", 2.0, np.e),), found)
    rows, target = one.build_prior_rows()
    np.testing.assert_allclose(rows[0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(rows[1:], found.rows)
    np.testing.assert_allclose(target, [np.log(2.0), *found.target])


def test_what_a_simulation_lacks_is_a_mean_of_all_and_a_scatter_alike_among_neighbours():
    random = np.random.default_rng(0)
    places = random.uniform(0.0, 400.0, (900, 3))
    own = np.eye(900)
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    root = np.linalg.cholesky(own + 4.0 * np.exp(-distance / 10.0))
    off = root @ random.normal(size=900)
    covariance, missed = add_scatter(own, off - off.mean() + 3.0, places, 10.0)
    assert missed == pytest.approx(np.hypot(2.0, 3.0), rel=0.05)
    far, near = (covariance[0, 1:][pick(distance[0, 1:])] for pick in (np.argmax, np.argmin))
    assert far == pytest.approx(9.0)
    assert near > 9.02
    off = 0.5 * random.normal(size=900)
    assert add_scatter(own, off - off.mean(), places, 10.0)[1] == pytest.approx(0.0, abs=1e-9)


def test_readings_never_widen_what_the_records_say_and_good_ones_decide_it():
    random = np.random.default_rng(5)
    data = [
        replace(one, force_N=one.force_N + 0.003 * random.normal(size=len(one.force_N))) for one in records()
    ]
    sd, rows = [], random.normal(size=(2, len(TRUTH)))
    for weight in (0.0, 1.0, 30.0, 1e3, 1e6):
        readings = LinearisedReadings(weight * rows, weight * rows @ np.log(TRUTH))
        known = estimate(TRUTH, simulate(TRUTH), data, replace(PAPER, readings=readings))
        sd.append(np.sqrt(np.diag(known.about_centre)))
    assert (np.diff(sd, axis=0) < 1e-12).all()
    assert (sd[3] < 0.99 * sd[0]).any()
    np.testing.assert_allclose(rows @ known.about_centre @ rows.T, 1e-12 * np.eye(2), rtol=1e-2, atol=1e-14)
