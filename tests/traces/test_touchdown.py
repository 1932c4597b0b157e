"""Touch-down: its stated deviation is what it is off by, over records whose truth is known.

The records are a power of the depth with quasi-linear relaxation, in closed form up to the exact recursion
of its memory, and differ as devices and limbs do: 1 to 2 mm/s, 8 to 12 mm, 10 to 20 N, 0.3 to 1 mm of
clearance, relaxation of 0.3 to 4 times the lasting stiffness within 0.2 to 5 s.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

from limbfit.traces import Trace, find_touch_down
from limbfit.traces.numerics import SampleNoise, estimate_noise

NOISE_N, RATE_HZ = 0.05, 500.0


def autoregressive(random, n, lag):
    """(n,) of deviation 1, neighbours correlated by ``lag``, from its stationary state on."""
    new = np.sqrt(1 - lag**2) * random.standard_normal(n)
    return lfilter([1.0], [1.0, -lag], new, zi=[lag * random.standard_normal()])[0]


def relaxing(time, elastic, gamma, tau):
    """``elastic + gamma`` times its memory (n,)."""
    step = time[1] - time[0]
    decay = np.exp(-step / tau)
    gain = (1 - decay) * tau / step
    return elastic + gamma * lfilter([gain], [1.0, -decay], np.diff(elastic, prepend=0.0))


def record(random, exponent, lag, slack=None):
    """A record, and the displacement at which its skin is met."""
    gamma, tau = random.uniform(0.3, 4.0), np.exp(random.uniform(np.log(0.2), np.log(5.0)))
    speed, depth, peak = random.uniform(1, 2), random.uniform(8, 12), random.uniform(10, 20)
    clear = random.uniform(0.3, 1.0) if slack is None else slack
    turn = (clear + depth) / speed
    time = np.arange(0.0, 2 * turn + 0.4, 1 / RATE_HZ)
    path = np.interp(time, [0, turn, 2 * turn], [0, clear + depth, 0])
    force = relaxing(time, np.maximum(path - clear, 0.0) ** exponent, gamma, tau)
    force = np.maximum(peak * force / force.max(), 0.0)
    moved = path + 0.005 * random.standard_normal(time.size)
    return Trace(time, moved, force + NOISE_N * autoregressive(random, time.size, lag)), clear


def errors(exponent, lag, repeats, seed=1):
    """Errors (repeats,) of touch-downs, mm, and what is stated of them."""
    found = []
    for repeat in range(repeats):
        trace, true = record(np.random.default_rng([seed, repeat]), exponent, lag)
        touch = find_touch_down(trace)
        found.append((touch.displacement_mm - true, touch.uncertainty_mm))
    return np.array(found).T


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [1.5, 2.0])
@pytest.mark.parametrize("lag", [0.0, 0.95])
def test_the_stated_deviation_is_the_true_one(exponent, lag):
    off, stated = errors(exponent, lag, 200)
    bias, scatter, z = off.mean(), off.std(), rms(off / stated)
    print(f"p {exponent}, lag {lag}: bias {bias:+.4f}, scatter {scatter:.4f} mm, rms z {z:.2f}")
    assert abs(bias) < 0.5 * scatter
    assert 0.8 < z < 1.25


@pytest.mark.parametrize("lag", [0.0, 0.95])
def test_noise_that_is_correlated_is_not_taken_for_white(lag):
    off, stated = errors(1.5, lag, 8, seed=2)
    assert 0.5 < rms(off / stated) < 1.7


@pytest.mark.parametrize("lag", [0.0, 0.5, 0.95, 0.98])
def test_the_noise_is_known_by_its_correlation(lag):
    """On a curve, whose own bends are no noise; the deviation of a long mean is what counts."""
    curve = 5 * np.linspace(0, 1, 4000) ** 2
    parts = [curve + NOISE_N * autoregressive(np.random.default_rng(k), 4000, lag) for k in range(8)]
    found = [estimate_noise(part) for part in parts]
    assert np.mean([one.lag for one in found]) == pytest.approx(lag, abs=0.02)
    long = np.mean([one.compute_mean_sd(200) for one in found])
    assert long == pytest.approx(SampleNoise(NOISE_N, lag).compute_mean_sd(200), rel=0.1)


@pytest.mark.parametrize("lag", [0.0, 0.3, 0.95])
def test_the_deviation_of_means(lag):
    random, true = np.random.default_rng(4), SampleNoise(1.0, lag)
    means = autoregressive(random, 400_000, lag).reshape(-1, 20).mean(axis=1)
    assert true.compute_mean_sd(20) == pytest.approx(means.std(), rel=0.03)
    assert true.compute_mean_sd(1) == pytest.approx(1.0)


def test_a_record_that_starts_on_the_skin_says_so():
    for seed in range(2):
        trace, _ = record(np.random.default_rng(seed), 1.5, 0.0, slack=0.0)
        touch = find_touch_down(trace)
        assert touch.in_contact_at_start
        assert touch.displacement_mm < 3 * touch.uncertainty_mm + 0.02


def test_a_force_that_jumps_before_the_indenter_moves_is_no_onset():
    trace, true = record(np.random.default_rng(3), 1.5, 0.0)
    wait = np.arange(0.0, 1.0, 1 / RATE_HZ)
    resting = 0.01 * np.random.default_rng(4).standard_normal(wait.size) - 3.0 * (wait < 0.3)
    time = np.r_[wait, wait[-1] + 1 / RATE_HZ + trace.time_s]
    waited = Trace(time, np.r_[0 * wait, trace.displacement_mm], np.r_[resting, trace.force_N])
    touch = find_touch_down(waited)
    assert np.isfinite([touch.displacement_mm, touch.uncertainty_mm]).all()
    assert touch.displacement_mm == pytest.approx(true, abs=0.5)


@pytest.mark.parametrize("speed", [0.96, 4.8])
def test_the_touch_down_of_a_small_ball_is_as_sure_as_it_says(speed):
    """3 mm into 8 mm of tissue by a ball of 12 mm: 1 N at noise of 0.05 N (as simulated, in short)."""
    clearance, depth = 0.45, 3.0
    off, stated = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        time = np.arange(0.0, 2 * (clearance + depth) / speed, 0.002)
        travel = speed * np.minimum(time, time[-1] - time)
        pressed = np.clip(travel - clearance, 0.0, None)
        force = 0.13 * pressed + 0.07 * pressed**2
        trace = Trace(
            time,
            travel + 0.01 * rng.standard_normal(time.size),
            force + 0.05 * rng.standard_normal(time.size),
        )
        found = find_touch_down(trace)
        off.append(found.displacement_mm - clearance)
        stated.append(found.uncertainty_mm)
    assert abs(np.mean(off)) < 0.17
    assert np.sqrt(np.mean(np.square(np.array(off) / stated))) < 1.6
