"""Do the 95 % intervals hold the truth in 95 % of cases?

    limbfit uncertainty STUDY
    python benchmarks/coverage.py STUDY --repeats 200 --json coverage.json

The truth is the study's identified model, on the emulator that ``limbfit uncertainty`` made of its solver.
Every repeat records the true forces as the robot does (500 Hz, noise of 0.05 N), regularises them as the
stage ``traces`` does (with the penalty that suits the site best: to find it anew by cross-validation takes
twenty times as long), calibrates on the emulator, and states intervals as the stage ``calibrate`` does:
from what it simulated and at most ten further simulations. Linearised intervals stand beside them, and those
of the posterior on the whole emulator, as ``limbfit uncertainty`` samples it (``--steps 0``: not). The
touch-down is found in a noisy record with an approach: what it is off by moves the curve, and what is stated
of it is what the uncertainty knows. The noise that is left after regularising is correlated from point to
point. With ``--misfit`` the model is wrong as well: a smooth error of so many percent of the largest force,
of another shape than the one that the method assumes.  The tissue of each site is stiffer or softer than
the truth by as much as is expected of it (``--differ 1``; 0: alike).
"""

import argparse
import json
import resource
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.linalg import block_diag

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "identify"))
from coverage_study import Coverage, Deviation, coverage_study

from limbfit import load_study
from limbfit.execution import SerialExecutor
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns
from limbfit.identify.uncertainty.emulator import Emulator
from limbfit.identify.uncertainty.noise import SiteNoise, compute_depth_slope, estimate_record_noise
from limbfit.phantom.robot import DISPLACEMENT_NOISE_MM, RATE_HZ
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.engine.store import Store, read_json
from limbfit.pipeline.identification.search import build_unknowns
from limbfit.pipeline.records.records import SiteRecord, estimate_site_deviation, load_site_record
from limbfit.pipeline.uncertainty.uncertainty import EMULATOR
from limbfit.traces import RegularisedCurve, TouchDown, Trace, find_touch_down, regularise

Array = NDArray[np.float64]
BEFORE_S = 0.3  # in the air
CLEARANCE_MM = 0.5
SMOOTHINGS = tuple(10.0**k for k in range(-4, 4))  # s^3


def read_emulator(file: Path) -> Emulator:
    """The emulator of the runs that `limbfit uncertainty` has stored."""
    with np.load(file, allow_pickle=False) as stored:
        ends = np.cumsum(stored["sizes"])[:-1]
        runs = [
            [SiteResponse(f, j) for f, j in zip(np.split(force, ends), np.split(jacobian, ends))]
            for force, jacobian in zip(stored["forces"], stored["jacobians"])
        ]
        return Emulator(stored["points"], runs)


@dataclass(frozen=True)
class Robot:
    """Makes records of the true ``forces`` at the sites of a study.

    ``noise_N`` at 500 Hz with ``autocorrelation`` of neighbours; ``smoothing`` (sites,) is the penalty on
    roughness and ``responses``, (n, n) per site, what such smoothing makes of a force; ``misfit`` is the
    error of the model over the largest force, ``stiffer`` (n,) per site the standard deviation of its force
    as the site's tissue differs.
    """

    records: tuple[SiteRecord, ...]
    forces: tuple[Array, ...]
    smoothing: tuple[float, ...]
    responses: tuple[Array, ...]
    noise_N: float
    autocorrelation: float
    misfit: float
    stiffer: tuple[Array, ...]
    seed: int

    def __call__(self, repeat: int, smoothed: Sequence[Array]) -> tuple[list[MeasuredCurve], list[SiteNoise]]:
        random = np.random.default_rng([self.seed, repeat])
        measured, noise = [], []
        how = zip(self.smoothing, self.responses, strict=True)
        sites = zip(self.records, self.forces, self.stiffer, smoothed, how, strict=True)
        for record, force, stiffer, answer, (smoothing, response) in sites:
            true = force + random.standard_normal() * stiffer
            true = true + self._wrong(random, record.times_s, force)
            off, sd = self._touch_down(random, record, true)
            true = true + off * compute_depth_slope(record.times_s, record.displacement_mm, force)
            smooth, residual = self.regularised(random, record, np.maximum(true, 0.0), smoothing)
            curve = np.interp(record.times_s, smooth.time_s, smooth.force_N)
            measured.append(MeasuredCurve(record.name, curve))
            site = record.name, record.times_s, residual, answer, record.displacement_mm, sd
            noise.append(estimate_record_noise(*site, response))
        return measured, noise

    def _touch_down(
        self, random: np.random.Generator, record: SiteRecord, force: Array
    ) -> tuple[float, float]:
        """How far the touch-down that is found in a noisy record is off, and what is stated of it, mm."""
        times, depth = record.times_s, record.displacement_mm
        speed = float(depth[1] - depth[0]) / float(times[1] - times[0])
        time = np.arange(-CLEARANCE_MM / speed, times[-1], 1 / RATE_HZ)
        path = np.where(time < 0, speed * time, np.interp(time, times, depth))
        # Straight between the points of comparison the onset would have corners that no skin makes.
        clean = PchipInterpolator(times, force)(np.maximum(time, 0.0))
        moved = path + DISPLACEMENT_NOISE_MM * random.standard_normal(time.size)
        touch = find_touch_down(Trace(time, moved, clean + self._noise(random, time.size)))
        return touch.displacement_mm, touch.uncertainty_mm

    def _wrong(self, random: np.random.Generator, times: Array, force: Array) -> Array:
        """A smooth error: a few waves of random phase, from half a wave to three over the record."""
        share = times / times[-1]
        waves = random.uniform(0.5, 3.0, 4)
        sizes = random.standard_normal(4)
        shape = sum(
            size * np.sin(2 * np.pi * (wave * share + random.uniform())) for size, wave in zip(sizes, waves)
        )
        return self.misfit * force.max() * np.asarray(shape) / np.sqrt(2.0)

    def regularised(
        self, random: np.random.Generator, record: SiteRecord, force: Array, smoothing: float
    ) -> tuple[RegularisedCurve, Array]:
        """The smoothed record, from touch-down on, and what was smoothed away."""
        end = record.times_s[-1]
        time = np.arange(0.0, BEFORE_S + end + 1e-9, 1 / RATE_HZ)
        since = time - BEFORE_S
        raw = np.where(since > 0, np.interp(since, record.times_s, force), 0.0) + self._noise(
            random, time.size
        )
        depth = np.interp(since, record.times_s, record.displacement_mm)
        touch = TouchDown(BEFORE_S, 0.0, 0.0, 0.0, False)
        smooth = regularise(Trace(time, depth, raw), touch, smoothing)
        inside = since >= 0
        return smooth, raw[inside] - np.interp(since[inside], smooth.time_s, smooth.force_N)

    def response(self, record: SiteRecord, force: Array, smoothing: float) -> Array:
        """What smoothing makes of forces (n, n); it depends on the times and the penalty alone."""
        smooth, _ = self.regularised(np.random.default_rng(self.seed), record, force, smoothing)
        return smooth.curve.compute_response(record.times_s)

    def _noise(self, random: np.random.Generator, n: int) -> Array:
        white = random.standard_normal(n)
        lag, noise = self.autocorrelation, np.empty(n)
        noise[0] = white[0]
        for k in range(1, n):
            noise[k] = lag * noise[k - 1] + np.sqrt(1 - lag**2) * white[k]
        return self.noise_N * noise


@dataclass(frozen=True)
class Smoothed:
    """An emulator whose forces are smoothed, by a matrix (n, n) per site, as their records are."""

    emulator: Emulator
    responses: tuple[Array, ...]

    def __call__(self, parameters: Array) -> list[SiteResponse]:
        found = zip(self.responses, self.emulator(parameters), strict=True)
        return [SiteResponse(S @ r.force_N, S @ r.jacobian) for S, r in found]

    def predict_forces(self, parameters: Array) -> Array:
        return self.emulator.predict_forces(parameters) @ block_diag(*self.responses).T


def study_robot(
    study_file: Path, noise_N: float, autocorrelation: float, misfit: float, differ: float, seed: int
) -> tuple[Robot, Array, Smoothed, Unknowns, Deviation]:
    """The robot of a study, the truth (p,), what is fitted to its records, the unknowns, and what is expected
    of each site as a whole."""
    study = load_study(study_file)
    store = Store(study.results)
    context = Context(study, store, SerialExecutor(), lambda progress: None)
    found = read_json(store["uncertainty"] / "uncertainty.json")
    truth = np.array([row["calibrated"] for row in found["parameters"]])
    records = tuple(load_site_record(context, record) for record in study.records_at(*study.fitted))
    emulator = read_emulator(store["uncertainty"] / EMULATOR)

    def deviation(responses: Sequence[SiteResponse], parameters: Array) -> tuple[Array, ...]:
        pairs = zip(records, responses, strict=True)
        return tuple(
            estimate_site_deviation(study, record, response, parameters) for record, response in pairs
        )

    true = list(emulator(truth))
    forces = tuple(response.force_N for response in true)
    stiffer = tuple(differ * one for one in deviation(true, truth))
    robot = Robot(records, forces, (), (), noise_N, autocorrelation, misfit, stiffer, seed)
    smoothing = tuple(best_smoothing(robot, *pair) for pair in zip(records, forces))
    responses = tuple(robot.response(*site) for site in zip(records, forces, smoothing))
    robot = replace(robot, smoothing=smoothing, responses=responses)
    return robot, truth, Smoothed(emulator, responses), build_unknowns(study), deviation


def best_smoothing(robot: Robot, record: SiteRecord, force: Array) -> float:
    """The penalty that brings regularised records closest to the true force, over a few records."""

    def error(smoothing: float) -> float:
        random = np.random.default_rng(robot.seed)
        found = [robot.regularised(random, record, force, smoothing)[0] for _ in range(3)]
        curves = [np.interp(record.times_s, one.time_s, one.force_N) for one in found]
        return float(np.mean([np.mean((curve - force) ** 2) for curve in curves]))

    return min(SMOOTHINGS, key=error)


def summary(found: Coverage) -> dict[str, Any]:
    low, high = found.limits()
    return {
        "determined_percent": 100 * found.share,
        "determined_per_repeat": float(found.determined.sum(axis=1).mean()),
        "by_combination_percent": (100 * found.by_combination).tolist(),
        "binomial_limits_percent": [100 * low, 100 * high],
        "by_parameter_percent": (100 * found.by_parameter).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument(
        "--steps", type=int, default=1500, help="of the sampler; 0: what every run states only"
    )
    parser.add_argument("--noise", type=float, default=0.05, help="N, standard deviation at 500 Hz")
    parser.add_argument("--autocorrelation", type=float, default=0.0, help="of neighbouring samples")
    parser.add_argument("--misfit", type=float, default=0.0, help="percent of the largest force")
    parser.add_argument("--differ", type=float, default=1.0, help="of sites, over what is expected")
    parser.add_argument("--most-probable", action="store_true", help="of what is most probable")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    robot, truth, emulator, free, deviation = study_robot(
        given.study, given.noise, given.autocorrelation, given.misfit / 100, given.differ, given.seed
    )
    found = coverage_study(
        emulator, truth, free, robot, given.repeats, given.steps, deviation, given.most_probable
    )
    told = {
        "repeats": given.repeats,
        "noise_N": robot.noise_N,
        "autocorrelation": robot.autocorrelation,
        "misfit_percent": 100 * robot.misfit,
        "sites_differ": given.differ,
        "estimated_misfit_percent": float(np.median(found.linearised.misfit_percent)),
        "further_simulations": found.further,
        "stated": summary(found.stated),
        "linearised": summary(found.linearised),
        "sampled": None if found.sampled is None else summary(found.sampled),
        "cpu_seconds": resource.getrusage(resource.RUSAGE_SELF).ru_utime,
    }
    print(json.dumps(told, indent=1))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
