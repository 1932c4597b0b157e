"""Is every artefact of a record told, or is the touch-down within what is stated of it?

    python benchmarks/record_artefacts.py --draws 100 --seed 0 --json record_artefacts.json
    python benchmarks/record_artefacts.py --only "step of force" "lost samples"

Records with a known touch-down are drawn from (seed, kind, number): a power-law solid with quasi-linear
relaxation is pushed in, held or not, and drawn back, and noise is added.  Then something goes wrong with
them, by a random amount (``ARTEFACTS``), or nothing does (``CLEAN``).  Each is read as limbfit reads it.  An
artefact is covered where the true touch-down lies within 1.96 stated standard deviations or where the record
is refused or carries a remark on that artefact.  The exit code is 0 when 95 % of the artefacts are covered,
and at most 2 % of the clean records carry a remark.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from limbfit.errors import TraceError
from limbfit.traces import Trace, check_trace, interpret_record

Array = NDArray[np.float64]
Random = np.random.Generator

STEP_S = 5e-4  # of the curve that is taken for exact
POWER_LAW = tuple((0.5, tau) for tau in (0.02, 0.1, 0.5, 2.5, 12.0))
WITHIN_SD = 1.96
COVERED, FALSE_ALARMS = 0.95, 0.02


@dataclass(frozen=True)
class Press:
    """An indentation without noise: corners of its path (s, mm from the skin), its solid, its sampling."""

    corners_s: Array
    corners_mm: Array
    exponent: float
    peak_N: float
    terms: tuple[tuple[float, float], ...]
    rate_Hz: float
    noise_N: float
    noise_mm: float = 0.005

    @property
    def time_s(self) -> Array:
        return np.arange(0.0, self.corners_s[-1], 1.0 / self.rate_Hz)

    def depth(self, at: Array) -> Array:
        return np.interp(at, self.corners_s, self.corners_mm)

    def force(self, at: Array, motion: Callable[[Array], Array] | None = None) -> Array:
        """Force at times (n,); ``motion`` adds mm to the depth."""
        fine = np.arange(0.0, self.corners_s[-1] + 2 * STEP_S, STEP_S)
        path = self.depth(fine)
        scale = self.peak_N / float(self._relaxed(np.maximum(path, 0.0) ** self.exponent).max())
        depth = np.maximum(path + (motion(fine) if motion else 0.0), 0.0)
        force = scale * self._relaxed(depth**self.exponent)
        return np.interp(at, fine, np.where(depth > 0.0, np.maximum(force, 0.0), 0.0))

    def _relaxed(self, elastic: Array) -> Array:
        total = elastic.copy()
        for gamma, tau in self.terms:
            decay = np.exp(-STEP_S / tau)
            gain = (1.0 - decay) * tau / STEP_S
            total += gamma * lfilter([gain], [1.0, -decay], np.diff(elastic, prepend=0.0))
        return total


@dataclass(frozen=True)
class Case:
    """A record as it was exported, and where its skin was met on its own displacement, mm."""

    trace: Trace
    touch_down_mm: float


Make = Callable[[Random, Press], Case]


def draw_press(random: Random) -> Press:
    """An ordinary record: a ramp in, at times a hold, a ramp out, and a moment clear of the skin."""
    gap, depth, speed = random.uniform(0.3, 0.7), random.uniform(4.0, 8.0), random.uniform(0.6, 1.5)
    hold = random.choice([0.0, 0.0, random.uniform(1.0, 10.0)])
    return Press(
        *_path(
            [(-gap, 0.0), (depth, speed), *([(depth, -hold)] if hold else []), (-gap, speed), (-gap, -0.4)]
        ),
        exponent=random.uniform(1.2, 1.8),
        peak_N=random.uniform(4.0, 12.0),
        terms=((random.uniform(1.0, 3.0), random.uniform(0.2, 1.0)),),
        rate_Hz=random.choice([100.0, 250.0, 500.0]),
        noise_N=random.uniform(0.02, 0.06),
    )


def _path(legs: list[tuple[float, float]]) -> tuple[Array, Array]:
    """Corners from (mm, speed) of each leg, the first where it begins; a negative speed is a wait in s."""
    times, places = [0.0], [legs[0][0]]
    for place, speed in legs[1:]:
        times.append(times[-1] + (-speed if speed < 0 else abs(place - places[-1]) / speed))
        places.append(place)
    return np.array(times), np.array(places)


def _case(press: Press, random: Random, force: Array | None = None, moved: Array | None = None) -> Case:
    """The record with its noise, its displacement zeroed at the start."""
    at = press.time_s
    gap = -float(press.corners_mm[0])
    force = press.force(at) if force is None else force
    moved = press.depth(at) + gap if moved is None else moved
    noisy = moved + press.noise_mm * random.standard_normal(at.size)
    return Case(Trace(at, noisy, force + press.noise_N * random.standard_normal(at.size)), gap)


def _contact(press: Press) -> tuple[float, float, float]:
    """When the skin is met, when the way in ends, and when the indenter leaves the skin again, s."""
    turn = int(np.argmax(press.corners_mm))
    met = float(np.interp(0.0, press.corners_mm[: turn + 1], press.corners_s[: turn + 1]))
    out = int(np.flatnonzero(press.corners_mm > 0.0)[-1])
    left = np.interp(0.0, -press.corners_mm[out : out + 2], press.corners_s[out : out + 2])
    return met, float(press.corners_s[turn]), float(left)


# --- artefacts


def saturated(random: Random, press: Press) -> Case:
    return _case(
        press, random, np.minimum(press.force(press.time_s), random.uniform(0.5, 0.95) * press.peak_N)
    )


def saturated_after_noise(random: Random, press: Press) -> Case:
    case, limit = _case(press, random), random.uniform(0.5, 0.95) * press.peak_N
    return replace(case, trace=replace(case.trace, force_N=np.minimum(case.trace.force_N, limit)))


def lost_in_ramp(random: Random, press: Press) -> Case:
    met, turn, _ = _contact(press)
    length = random.uniform(0.2, 0.35) * (turn - met)
    start = random.uniform(met - 0.1, turn - 0.1 - length)
    return _without(_case(press, random), start, start + length)


def lost_at_peak(random: Random, press: Press) -> Case:
    _, turn, _ = _contact(press)
    length = random.uniform(0.3, 1.5)
    start = turn - random.uniform(0.2, 0.8) * length
    return _without(_case(press, random), start, start + length)


def _without(case: Case, start: float, end: float) -> Case:
    trace = case.trace
    kept = (trace.time_s < start) | (trace.time_s > end)
    return replace(case, trace=trace.select(kept))


def frozen(random: Random, press: Press) -> Case:
    met, turn, left = _contact(press)
    case, length = _case(press, random), random.uniform(0.3, 1.5)
    ways = [(met + 0.3, turn - length), (press.corners_s[-3] - 0.2, left - 0.3 - length)]
    low, high = ways[random.integers(2)]
    start = random.uniform(low, max(high, low + 0.01))
    force = case.trace.force_N.copy()
    held = (press.time_s >= start) & (press.time_s < start + length)
    force[held] = force[held][0]
    return replace(case, trace=replace(case.trace, force_N=force))


def low_passed(random: Random, press: Press) -> Case:
    decay = np.exp(-1.0 / (press.rate_Hz * random.uniform(0.03, 0.2)))
    return _case(press, random, lfilter([1.0 - decay], [1.0, -decay], press.force(press.time_s)))


def late(random: Random, press: Press) -> Case:
    lag = random.uniform(0.03, 0.3)
    return _case(press, random, np.interp(press.time_s - lag, press.time_s, press.force(press.time_s)))


def breathing_force(random: Random, press: Press) -> Case:
    force = press.force(press.time_s)
    size = random.uniform(0.03, 0.1) * press.peak_N
    return _case(
        press, random, force + size * _breath(random)(press.time_s) * np.clip(force / size, 0.0, 1.0)
    )


def breathing_motion(random: Random, press: Press) -> Case:
    breath, size = _breath(random), random.uniform(0.15, 0.5)
    return _case(press, random, press.force(press.time_s, lambda at: size * breath(at)))


def _breath(random: Random) -> Callable[[Array], Array]:
    rate, phase = random.uniform(0.2, 0.4), random.uniform(0.0, 2 * np.pi)
    return lambda at: np.sin(2 * np.pi * rate * at + phase)


def begun_in_contact(random: Random, press: Press) -> Case:
    start = random.uniform(0.15, 0.8)
    return _begun(_case(press, random), press, start, random.random() < 0.5)


def _begun(case: Case, press: Press, start_mm: float, to_the_end: bool) -> Case:
    """The record from ``start_mm`` below the skin on, both sensors zeroed there."""
    trace, depth = case.trace, press.depth(press.time_s)
    first = int(np.argmax(depth >= start_mm))
    after = np.flatnonzero(depth >= start_mm)[-1]
    rows = slice(first, None if to_the_end else after)
    return Case(
        Trace(
            trace.time_s[rows] - trace.time_s[first],
            trace.displacement_mm[rows] - trace.displacement_mm[first],
            trace.force_N[rows] - trace.force_N[first : first + 5].mean(),
        ),
        -start_mm,
    )


def step(random: Random, press: Press) -> Case:
    met, turn, _ = _contact(press)
    at = random.uniform(met + 0.2 * (turn - met), turn - 0.2)
    size = random.choice([-1.0, 1.0]) * random.uniform(0.05, 0.2) * press.peak_N
    return _case(press, random, press.force(press.time_s) + size * (press.time_s >= at))


def warming(random: Random, press: Press) -> Case:
    size = random.choice([-1.0, 1.0]) * random.uniform(0.05, 0.2) * press.peak_N
    drift = size * (1.0 - np.exp(-press.time_s / random.uniform(1.5, 6.0)))
    return _case(press, random, press.force(press.time_s) + drift)


def coarse_force(random: Random, press: Press) -> Case:
    case, size = _case(press, random), random.uniform(0.02, 0.08) * press.peak_N
    return replace(case, trace=replace(case.trace, force_N=_rounded(case.trace.force_N, size)))


def coarse_displacement(random: Random, press: Press) -> Case:
    press = replace(press, noise_mm=random.choice([0.0, 0.005]))
    case, size = _case(press, random), random.choice([0.05, 0.1, 0.2])
    return replace(
        case, trace=replace(case.trace, displacement_mm=_rounded(case.trace.displacement_mm, size))
    )


def coarse_times(random: Random, press: Press) -> Case:
    case = _case(replace(press, rate_Hz=random.choice([250.0, 500.0, 1000.0])), random)
    return replace(case, trace=replace(case.trace, time_s=_rounded(case.trace.time_s, 0.01)))


def doubled_rows(random: Random, press: Press) -> Case:
    case = _case(press, random)
    n = len(case.trace.time_s)
    rows = np.sort(np.r_[np.arange(n), random.integers(0, n, random.integers(5, 50))])
    return replace(
        case,
        trace=case.trace.select(rows),
    )


def _rounded(values: Array, size: float) -> Array:
    return np.round(values / size) * size


ARTEFACTS: dict[str, tuple[Make, str]] = {
    "force saturated": (saturated, "saturation"),
    "force clipped": (saturated_after_noise, "saturation"),
    "lost samples in the ramp": (lost_in_ramp, "gap"),
    "lost samples at the peak": (lost_at_peak, "gap"),
    "force frozen": (frozen, "frozen"),
    "force low-passed": (low_passed, "lag"),
    "force late": (late, "lag"),
    "breathing as force": (breathing_force, "swing"),
    "breathing as motion": (breathing_motion, "swing"),
    "begins in contact, zeroed": (begun_in_contact, "start"),
    "step of force": (step, "step"),
    "drift by warming": (warming, "drift"),
    "force in coarse steps": (coarse_force, "resolution"),
    "displacement in coarse steps": (coarse_displacement, "resolution"),
    "times in steps of 10 ms": (coarse_times, "times"),
    "doubled rows": (doubled_rows, "rows"),
}


# --- clean records


def _ordinary(**changes: object) -> Make:
    return lambda random, press: _case(replace(press, **changes), random)  # type: ignore[arg-type]


def _along(legs: Callable[[float], list[tuple[float, float]]], **changes: object) -> Make:
    """Records of other movements: ``legs`` of the gap before the skin."""

    def make(random: Random, press: Press) -> Case:
        times, places = _path(legs(-float(press.corners_mm[0])))
        return _case(replace(press, corners_s=times, corners_mm=places, **changes), random)  # type: ignore[arg-type]

    return make


def _smooth_turns(random: Random, press: Press) -> Case:
    at = np.linspace(0.0, 20.0, 401)
    places = 3.25 * (1.0 - np.cos(2 * np.pi * at / 10.0)) + press.corners_mm[0]
    return _case(replace(press, corners_s=at, corners_mm=places), random)


def _s_curve(random: Random, press: Press) -> Case:
    at = np.linspace(0.0, 7.0, 201)
    places = 6.5 * (3 * (at / 7.0) ** 2 - 2 * (at / 7.0) ** 3) + press.corners_mm[0]
    return _case(replace(press, corners_s=at, corners_mm=places), random)


def _correlated(random: Random, press: Press) -> Case:
    at = press.time_s
    noise = lfilter([np.sqrt(1 - 0.95**2)], [1.0, -0.95], random.standard_normal(at.size))
    return _case(replace(press, noise_N=1e-6), random, press.force(at) + press.noise_N * noise)


def _offset(random: Random, press: Press) -> Case:
    return _case(press, random, press.force(press.time_s) + random.uniform(-3.0, 3.0))


def _sticky(random: Random, press: Press) -> Case:
    """It sticks a little as it leaves the skin."""
    at = press.time_s
    _, turn, _ = _contact(press)
    sticks = (at > turn) & (press.depth(at) < 0.6) & (press.depth(at) > -0.2)
    return _case(
        press, random, press.force(at) - 0.03 * press.peak_N * sticks * np.clip(press.depth(at) + 0.2, 0, 1)
    )


def _missing(random: Random, press: Press) -> Case:
    case = _case(press, random)
    kept = random.random(press.time_s.size) > 0.3
    trace = case.trace
    return replace(case, trace=trace.select(kept))


def _jittered(random: Random, press: Press) -> Case:
    at = press.time_s
    true = np.clip(np.sort(at + 0.004 * random.standard_normal(at.size)), 0.0, at[-1])
    return _case(press, random, press.force(true), press.depth(true) - press.corners_mm[0])


CLEAN: dict[str, Make] = {
    "ordinary": _ordinary(),
    "exponent 1": _ordinary(exponent=1.0),
    "exponent 2": _ordinary(exponent=2.0),
    "relaxes by a power law": _ordinary(terms=POWER_LAW),
    "elastic": _ordinary(terms=()),
    "correlated noise": _correlated,
    "weak force": _ordinary(peak_N=0.7),
    "strong force": _ordinary(peak_N=20.0),
    "noise of 0.2 N": _ordinary(noise_N=0.2),
    "hardly any noise": _ordinary(noise_N=0.002, noise_mm=0.001),
    "fast, 5 mm/s": _along(lambda gap: [(-gap, 0), (6, 5), (-gap, 5), (-gap, -0.4)]),
    "hold of 30 s": _along(lambda gap: [(-gap, 0), (6, 1), (6, -30), (-gap, 1)]),
    "creeps on in a hold": _along(lambda gap: [(-gap, 0), (6, 1), (6.1, 0.01), (-gap, 1)]),
    "two rates, then out": _along(lambda gap: [(-gap, 0), (4, 2), (6, 0.2), (-gap, 1)]),
    "five cycles": _along(lambda gap: [(-gap, 0), *[(6, 2), (-gap, 2)] * 5]),
    "slow way out": _along(lambda gap: [(-gap, 0), (6, 1), (-gap, 0.1)]),
    "way in only": _along(lambda gap: [(-gap, 0), (6, 1)]),
    "sine": _smooth_turns,
    "S-curve": _s_curve,
    "10 Hz": _ordinary(rate_Hz=10.0),
    "25 Hz": _ordinary(rate_Hz=25.0),
    "30 % of samples missing": _missing,
    "clock jitter 4 ms": _jittered,
    "offset of up to 3 N": _offset,
    "sticks to the skin": _sticky,
}


# --- reading them


@dataclass(frozen=True)
class Reading:
    """What reading a record came to: its remarks' kinds, or why it is refused, and the touch-down's error.

    ``told`` says that it is refused or has a remark on what is wrong; of a clean record, on anything.
    """

    kinds: tuple[str, ...]
    refused: str | None
    told: bool
    error_mm: float | None = None
    sd_mm: float | None = None

    @property
    def within(self) -> bool:
        return self.error_mm is not None and abs(self.error_mm) <= WITHIN_SD * (self.sd_mm or 0.0)


def read(case: Case, wrong: str | None) -> Reading:
    """Read a record as limbfit does; ``wrong`` is the kind of remark that it deserves."""
    try:
        check_trace(case.trace)
        found = interpret_record(case.trace)
    except TraceError as error:
        return Reading((), error.what, told=True)
    kinds = tuple(sorted({remark.kind for remark in found.warnings}))
    told = bool(kinds) if wrong is None else wrong in kinds
    touch = found.touch_down
    return Reading(kinds, None, told, touch.displacement_mm - case.touch_down_mm, touch.uncertainty_mm)


def run(name: str, make: Make, wrong: str | None, draws: int, seed: int) -> list[Reading]:
    readings = []
    for number in range(draws):
        random = np.random.default_rng([seed, *name.encode(), number])
        readings.append(read(make(random, draw_press(random)), wrong))
    return readings


def row(name: str, found: list[Reading]) -> str:
    """One line of the table."""
    errors = [reading.error_mm for reading in found if reading.error_mm is not None]
    sds = [reading.sd_mm for reading in found if reading.sd_mm is not None]
    shares = [[r.told for r in found], [r.within for r in found], [r.told or r.within for r in found]]
    percent = " | ".join(f"{100 * np.mean(share):.0f}" for share in shares)
    numbers = f"{np.sqrt(np.mean(np.square(errors))):.3f} | {np.median(sds):.3f}" if errors else "- | -"
    return f"| {name} | {len(found)} | {percent} | {numbers} |"


def table(
    title: str, kinds: dict[str, tuple[Make, str | None]], draws: int, seed: int
) -> dict[str, list[Reading]]:
    """Read so many records of every kind, and print a line for each."""
    if kinds:
        print(f"| {title} | draws | told % | within 1.96 sd % | either % | rms error mm | median sd mm |")
        print(7 * "|---" + "|", flush=True)
    readings = {}
    for name, (make, wrong) in kinds.items():
        readings[name] = run(name, make, wrong, draws, seed)
        print(row(name, readings[name]), flush=True)
    return readings


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="kinds, instead of all")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    kinds = ARTEFACTS, {name: (make, None) for name, make in CLEAN.items()}
    chosen = [{k: v for k, v in some.items() if k in (options.only or some)} for some in kinds]
    began = time.process_time()
    artefacts = table("artefact", chosen[0], options.draws, options.seed)
    clean = table("clean record", chosen[1], options.draws, options.seed)
    covered = np.mean([r.told or r.within for found in artefacts.values() for r in found] or [True])
    alarms = np.mean([r.told for found in clean.values() for r in found] or [False])
    if artefacts:
        print(f"{100 * covered:.1f} % of the artefacts are told or within 1.96 standard deviations")
    if clean:
        print(f"{100 * alarms:.1f} % of the clean records are told as something else")
    print(f"{time.process_time() - began:.0f} s of processor time")
    if options.json:
        rows = {name: [asdict(r) for r in found] for name, found in {**artefacts, **clean}.items()}
        options.json.write_text(json.dumps(rows, indent=1))
    return 0 if covered >= COVERED and alarms <= FALSE_ALARMS else 1


if __name__ == "__main__":
    sys.exit(main())
