"""The robot's record: rate, slack, speed, noise."""

import numpy as np
import pytest

from limbfit.errors import SiteError
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.robot import (
    CLEARANCE_MM,
    FORCE_NOISE_N,
    SPEED_MM_S,
    SPEED_SPREAD,
    Ramp,
    build_true_sites,
    record,
)

RAMP = Ramp(depth=5.0, speed=0.96)


def hat(t: np.ndarray) -> np.ndarray:
    """A force that rises linearly to 4 N at the peak and falls."""
    return 4.0 * (1 - np.abs(t - RAMP.peak_s) / RAMP.peak_s)


@pytest.fixture(scope="module")
def made():
    return record(RAMP, hat, np.random.default_rng(3))


def test_the_rate_is_500_hz(made) -> None:
    np.testing.assert_allclose(np.diff(made.time), 0.002, atol=1e-9)
    assert made.time[0] == 0


def test_it_starts_clear_of_the_skin_and_records_on_after_the_return(made) -> None:
    assert CLEARANCE_MM[0] <= made.clearance <= CLEARANCE_MM[1]
    assert made.touch_s == pytest.approx(made.clearance / 0.96)
    before = made.force[made.time < made.touch_s]
    after = made.force[made.time > made.touch_s + 2 * RAMP.peak_s]
    assert abs(before.mean()) < 0.01
    assert abs(after.mean()) < 0.01
    assert np.ptp(made.displacement[-150:]) < 0.05


def test_it_moves_at_constant_speed_to_depth_and_back(made) -> None:
    peak = made.time[made.displacement.argmax()]
    rising, falling = made.time < peak - 0.1, (made.time > peak + 0.1) & (made.displacement > 0.1)
    assert np.polyfit(made.time[rising], made.displacement[rising], 1)[0] == pytest.approx(0.96, abs=2e-3)
    assert np.polyfit(made.time[falling], made.displacement[falling], 1)[0] == pytest.approx(-0.96, abs=2e-3)
    assert made.displacement.max() == pytest.approx(made.clearance + 5.0, abs=0.03)


def test_noise_is_as_told_and_within_the_sensor_range(made) -> None:
    clean = np.where(made.time > made.touch_s, hat(made.time - made.touch_s), 0).clip(0)
    assert (made.force - clean).std() == pytest.approx(made.force_noise, rel=0.05)
    assert FORCE_NOISE_N[0] <= made.force_noise <= FORCE_NOISE_N[1]
    ramp = np.polyfit(made.time[:2000], made.displacement[:2000], 1)
    assert (made.displacement[:2000] - np.polyval(ramp, made.time[:2000])).std() == pytest.approx(
        0.005, rel=0.1
    )


def test_the_csv_is_what_a_robot_writes(made, tmp_path) -> None:
    made.write(tmp_path / "site.csv")
    lines = (tmp_path / "site.csv").read_text().splitlines()
    assert lines[0] == "time_s,displacement_mm,force_N"
    table = np.loadtxt(lines[1:], delimiter=",")
    np.testing.assert_allclose(table, np.column_stack([made.time, made.displacement, made.force]), atol=6e-4)


def test_speeds_vary_a_little_from_site_to_site() -> None:
    speeds = np.array([site.speed for site in build_true_sites(make_limb(0), 0)])
    assert np.abs(speeds / SPEED_MM_S - 1).max() <= SPEED_SPREAD
    assert speeds.std() > 0.005


@pytest.mark.parametrize(("depth", "speed"), [(0.0, 1.0), (3.0, -1.0), (float("nan"), 1.0)])
def test_impossible_ramps_are_refused(depth: float, speed: float) -> None:
    with pytest.raises(SiteError, match="cannot indent"):
        Ramp(depth, speed)
