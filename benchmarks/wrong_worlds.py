"""Where the intervals give way when the model is wrong.

    python benchmarks/wrong_worlds.py --draws 8
    python benchmarks/wrong_worlds.py --draws 8 --hold 60 "power law"

An analytic limb stands in for the solver: at each site skin and muscle share a flat punch, each a bar under
uniaxial stress whose relaxation is quasi-linear.  Four sites are fitted and four held out.  The records come
from a limb that differs from the model in one way; calibration, residuals, intervals and the spread between
relaxations are limbfit's own.  Every draw has other tissues and other noise.

The table shows how often the verdict on the fit blames the model, the error at held-out sites, how many
parameters are called determined and hold the truth, how many points of held-out records lie inside their
bands, and the force after ``--after`` seconds of a hold that no record has: its error, and the half width and
the coverage of its interval from the parameters alone (before) and with what relaxation beyond the record may
do (after).  ``--hold``: one fitted site is held so long in its record.  Last comes which relaxation the
records prefer, and how often the user is warned that the limb may give way to the indenter.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from limbfit.autoregressive import compute_block_covariance
from limbfit.identify.checks.fit_quality import assess_fit, refit_residuals
from limbfit.identify.fit.calibration import CalibrationSettings, calibrate
from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns, build_stage_groupings
from limbfit.identify.fit.prediction import MAX_FREEDOM, NORMAL_95, PredictionModel, compute_error_percent
from limbfit.identify.uncertainty.intervals import EvaluationStore, sample_uncertainty
from limbfit.identify.uncertainty.noise import compute_depth_slope, estimate_record_noise
from limbfit.identify.uncertainty.relaxation import GIVES_WAY, assess_relaxation, limit_verdicts
from limbfit.identify.uncertainty.uncertainty import DETERMINED, estimate_uncertainty
from limbfit.results.identification import RecordFit

Array = NDArray[np.float64]
Terms = tuple[tuple[float, float], ...]  # amplitude and time, s
NAMES = tuple(f"{tissue}.{key}" for tissue in ("skin", "muscle") for key in ("c_kPa", "m", "gamma", "tau_s"))
TRUTH = np.array([7.0, 6.0, 2.5, 0.5, 4.7, 4.6, 3.2, 0.3])
UNKNOWNS = Unknowns(
    NAMES,
    np.tile([4.7, 3.0, 1.2, 2.0], 2),
    np.tile([0.047, 2.0, 0.01, 0.01], 2),
    np.tile([47.0, 20.0, 10.0, 10.0], 2),
)
MODULI = np.array([1.0, 0.0, 0.0, 0.0] * 2)
AREA_MM2, SHARE_OF_STRAIN = 400.0, 0.75
POINTS, FINE = 81, 1601  # of comparison, of the simulation
RATE_HZ, NOISE_N, TOUCH_DOWN_MM, SITE_SHARE = 500.0, 0.05, 0.03, 0.012
POWER_LAW_S = (0.03, 0.2, 1.2, 7.0, 40.0)
_STEP = 1e-4


@dataclass(frozen=True)
class Bar:
    """A site: depth and thickness in mm, the skin's share of the section, speed in mm/s, hold in s."""

    name: str
    fitted: bool
    depth: float
    thickness: float
    skin: float
    speed: float
    hold: float = 0.0

    def history(self) -> tuple[Array, Array]:
        """Times and depths of the simulation (FINE,)."""
        ramp = self.depth / self.speed
        time = np.linspace(0.0, 2 * ramp + self.hold, FINE)
        turns = [0.0, ramp, ramp + self.hold, 2 * ramp + self.hold]
        return time, np.interp(time, turns, [0.0, self.depth, self.depth, 0.0])


SITES = (
    Bar("a", True, 3.0, 9.0, 0.50, 0.96),
    Bar("b", True, 5.0, 24.0, 0.18, 0.95),
    Bar("c", True, 6.0, 35.0, 0.12, 0.97),
    Bar("d", True, 4.0, 16.0, 0.28, 0.98),
    Bar("e", False, 3.5, 12.0, 0.38, 0.96),
    Bar("f", False, 5.5, 28.0, 0.15, 0.96),
    Bar("g", False, 4.5, 18.0, 0.25, 0.94),
    Bar("h", False, 6.0, 20.0, 0.22, 0.97),
)
KEPT = np.linspace(0, FINE - 1, POINTS).astype(int)


def ogden(stretch: Array, c: float, m: float) -> Array:
    """Nominal compressive stress of the second-order Ogden law, MPa for c in MPa."""
    powers = stretch ** (m - 1) - stretch ** (-m - 1) - stretch ** (-m / 2 - 1) + stretch ** (m / 2 - 1)
    return np.asarray(-(c / m) * powers)


def fung(stretch: Array, c: float, b: float) -> Array:
    """The same of Fung's exponential law; neo-Hookean where b is small."""
    invariant = stretch**2 + 2 / stretch
    return np.asarray(-(c / 2) * np.exp(b * (invariant - 3)) * (2 * stretch - 2 / stretch**2))


def relax(elastic: Array, dt: float, terms: Terms) -> Array:
    """Quasi-linear viscoelastic stress (n,) of an elastic one."""
    found, steps = elastic.copy(), np.diff(elastic)
    for amplitude, tau in terms:
        decay = np.exp(-dt / tau)
        found[1:] += amplitude * lfilter([(1 - decay) * tau / dt], [1.0, -decay], steps)
    return found


@dataclass(frozen=True)
class World:
    """How the true limb differs from the model; each key is one way.

    ``terms`` of a tissue's amplitude and time; ``exponent`` of Fung's law; standard deviations between sites
    (``differ``, ``skin_differ``, ``relaxation_differs``, ``bone_sd_mm``); ``bone_mm`` deeper;
    ``skin_share``: factor; ``early_mm``: touch-down; ``recede``: share of the travel; ``stiffen``: share over
    the record; ``breath_mm``.
    """

    terms: Callable[[float, float], Terms] = lambda gamma, tau: ((gamma, tau),)
    exponent: float | None = None
    differ: float = 0.01
    skin_differ: float = 0.0
    relaxation_differs: float = 0.0
    bone_mm: float = 0.0
    bone_sd_mm: float = 0.0
    skin_share: float = 1.0
    early_mm: float = 0.0
    recede: float = 0.0
    stiffen: float = 0.0
    breath_mm: float = 0.0

    def force(self, bar: Bar, p: Array, time: Array, depth: Array, deeper: float = 0.0) -> Array:
        """True force (FINE,) of parameters (8,)."""
        thickness, share = max(bar.thickness + self.bone_mm + deeper, 6.0), bar.skin * self.skin_share
        return _force(thickness, share, p, time, depth, self.terms, self.exponent)


def _force(
    thickness: float,
    share: float,
    p: Array,
    time: Array,
    depth: Array,
    terms: Callable[[float, float], Terms] = World.terms,
    exponent: float | None = None,
) -> Array:
    stretch = 1 - SHARE_OF_STRAIN * depth / thickness
    area = AREA_MM2 * (1 + 10.0 / thickness)
    total = np.zeros_like(depth)
    for section, (c, m, gamma, tau) in zip((share, 1 - share), p.reshape(2, 4)):
        elastic = ogden(stretch, 1e-3 * c, m) if exponent is None else fung(stretch, 1e-3 * c, exponent)
        total += area * section * relax(elastic, time[1] - time[0], terms(gamma, tau))
    return total


WORLDS: Mapping[str, World] = {
    "as the model": World(differ=0.0),
    "sites 1 %": World(),
    "sites 10 %": World(differ=0.10),
    "sites 20 %": World(differ=0.20),
    "skin c 30 % by site": World(skin_differ=0.3),
    "relaxation 30 % by site": World(relaxation_differs=0.3),
    "two times": World(terms=lambda gamma, tau: ((gamma / 2, 0.1), (gamma / 2, 3.0))),
    "power law": World(terms=lambda gamma, tau: tuple((0.24 * gamma, t) for t in POWER_LAW_S)),
    "two times, slow 60 s": World(terms=lambda gamma, tau: ((gamma, 0.3), (1.0, 60.0))),
    "neo-Hookean": World(exponent=1e-4),
    "Fung b=3": World(exponent=3.0),
    "skin share +30 %": World(skin_share=1.3),
    "bone 2 mm deeper": World(bone_mm=2.0),
    "bone off by 2 mm": World(bone_sd_mm=2.0),
    "touch-down 0.5 mm early": World(early_mm=0.5),
    "limb recedes 10 %": World(recede=0.1),
    "muscle stiffens 20 %": World(stiffen=0.2),
    "breathing 0.2 mm": World(breath_mm=0.2),
}


def respond(bar: Bar, p: Array) -> SiteResponse:
    """The model's force and derivatives at the times of comparison."""
    time, depth = bar.history()

    def force(q: Array) -> Array:
        return _force(bar.thickness, bar.skin, q, time, depth)[KEPT]

    steps = np.diag(_STEP * p)
    columns = [(force(p + step) - force(p - step)) / (2 * step.max()) for step in steps]
    value = force(p)
    return SiteResponse(
        np.maximum(value, 0.0), np.stack(columns, axis=1) * (value > 0)[:, None], site=bar.name
    )


@dataclass(frozen=True)
class Recorded:
    """A site's record, the noise in it and the tissues that made it."""

    bar: Bar
    times_s: Array
    depth_mm: Array
    force_N: Array
    touch_down_N: Array
    parameters: Array


def make_record(world: World, bar: Bar, p: Array, random: np.random.Generator) -> Recorded:
    """The record of a site whose tissues have about the parameters (8,)."""
    time, depth = bar.history()
    own = p.copy()
    own[[3, 7]] *= np.exp(world.relaxation_differs * random.standard_normal())
    own[[2, 6]] *= np.exp(0.5 * world.relaxation_differs * random.standard_normal())
    own[0] *= np.exp(world.skin_differ * random.standard_normal())
    stiffness = np.exp(world.differ * random.standard_normal())
    moved = np.maximum(depth + world.early_mm * (depth > 0) - world.recede * depth.max() * time / time[-1], 0)
    wave = np.sin(np.pi / 2 * time + random.uniform(0, 2 * np.pi)) * np.minimum(moved, 1.0)
    moved = np.maximum(moved + world.breath_mm * wave, 0.0)
    true = world.force(bar, own, time, moved, world.bone_sd_mm * random.standard_normal())
    true = stiffness * np.maximum(true, 0.0) * (1 + world.stiffen * time / time[-1])
    times, clean = time[KEPT], true[KEPT]
    per_point = np.full(POINTS, max(int(RATE_HZ * times[-1] / POINTS), 1))
    noise = random.multivariate_normal(np.zeros(POINTS), compute_block_covariance(NOISE_N, 0.0, per_point))
    slope = TOUCH_DOWN_MM * compute_depth_slope(times, depth[KEPT], clean)
    force = np.maximum(clean + noise + slope * random.standard_normal(), 0.0)
    return Recorded(bar, times, depth[KEPT], force, slope, own)


def run_draw(world: World, seed: int, hold_s: float, after_s: float) -> dict[str, Any]:
    """Record, calibrate and predict once."""
    random = np.random.default_rng(seed)
    truth = TRUTH * np.exp(0.1 * random.standard_normal(8))
    bars = [replace(bar, hold=hold_s) if bar.name == "b" else bar for bar in SITES]
    records = [make_record(world, bar, truth, random) for bar in bars]
    fitted = [record for record in records if record.bar.fitted]
    measured = [MeasuredCurve(r.bar.name, r.force_N, touch_down_sd_N=r.touch_down_N) for r in fitted]
    store = EvaluationStore()

    def simulate(p: Array) -> Sequence[SiteResponse]:
        found = [respond(record.bar, np.asarray(p)) for record in fitted]
        store.add(p, found)
        return found

    settings = CalibrationSettings(relative_tolerance=0.01)
    found = calibrate(simulate, measured, UNKNOWNS, settings, stages=build_stage_groupings(NAMES))
    best = found.parameters
    noise = [
        estimate_record_noise(
            record.bar.name, record.times_s,
            NOISE_N * random.standard_normal(int(RATE_HZ * record.times_s[-1])),
            response.force_N, record.depth_mm, TOUCH_DOWN_MM,
        )
        for record, response in zip(fitted, found.responses, strict=True)
    ]  # fmt: skip
    off = [SITE_SHARE * (response.jacobian @ (best * MODULI)) for response in found.responses]
    linearised = estimate_uncertainty(
        best, found.responses, measured, UNKNOWNS, noise, settings=settings, site_N=off
    )
    known = sample_uncertainty(linearised, store, simulate)
    relaxation = assess_relaxation(known, found.responses)
    assert relaxation is not None
    residuals = known.residual_model.summarise()
    model = PredictionModel(
        known.covariance, known.centre, residuals.sites, residuals.misfit_elsewhere,
        residuals.known_scale, residuals.site_factor or 1.0, residuals.site_freedom or MAX_FREEDOM,
    )  # fmt: skip
    inside = (known.intervals_95[:, 0] <= truth) & (truth <= known.intervals_95[:, 1])
    verdicts = limit_verdicts(known.verdicts, known, relaxation.summarise())
    quality = _judge_fit(fitted, found.responses, best, [one.covariance for one in noise], off)
    row: dict[str, Any] = {
        "named": any(one.verdict for one in quality),
        "times_noise": max(phase.times_noise for one in quality for phase in one.phases),
        "prefers": relaxation.preferred_model,
        "gives_way": GIVES_WAY in relaxation.describe(),
        "determined": [word == DETERMINED for word in known.verdicts],
        "still_determined": [word == DETERMINED for word in verdicts],
        "inside": inside.tolist(),
        "heldout": [],
        "after": [],
    }
    spread = relaxation.spread.own_weight, *relaxation.spread.interpolate(after_s)
    for record in records:
        if not record.bar.fitted:
            row["heldout"].append(_compare_record(record, best, model))
            sampled = known.centre, known.covariance
            hold = world, record.bar, best, truth, after_s
            row["after"].append(_compare_hold(*hold, sampled, spread))
    return row


def _judge_fit(
    records: Sequence[Recorded],
    responses: Sequence[SiteResponse],
    best: Array,
    noise: Sequence[Array],
    off: Sequence[Array],
) -> list[RecordFit]:
    """What the stage ``predict`` says of the fit; nothing here has a mesh."""
    allowed = [covariance + np.outer(error, error) for covariance, error in zip(noise, off, strict=True)]
    residuals = [r.force_N - one.force_N for r, one in zip(responses, records, strict=True)]
    left = refit_residuals(residuals, [r.jacobian * best for r in responses], allowed)
    return [
        assess_fit(
            one.bar.name, True, one.times_s, one.depth_mm, residual,
            float(one.force_N.max()), covariance, None, refitted,
        )
        for one, residual, covariance, refitted in zip(records, residuals, allowed, left, strict=True)
    ]  # fmt: skip


def _compare_record(record: Recorded, best: Array, model: PredictionModel) -> dict[str, float]:
    """Error and band at a held-out site, percent."""
    response = respond(record.bar, best)
    off = SITE_SHARE * (response.jacobian @ (best * MODULI))
    low, high = model.compute_interval_95(response, best, record.bar.name, "N", off)
    inside = (record.force_N >= np.maximum(low, 0.0) - 1e-9) & (record.force_N <= high)
    return {
        "error": compute_error_percent(response.force_N, record.force_N),
        "inside": 100 * float(inside.mean()),
        "half": 50 * float(np.mean(high - low)) / float(record.force_N.max()),
    }


def _compare_hold(
    world: World,
    bar: Bar,
    best: Array,
    truth: Array,
    after_s: float,
    sampled: tuple[Array, Array],
    spread: tuple[float, Array, Array, Array],
) -> dict[str, float]:
    """Error and intervals of the force after a hold, from parameters alone and with the spread, percent."""
    time, depth = replace(bar, hold=after_s).history()
    last = int(np.searchsorted(time, bar.depth / bar.speed + 0.98 * after_s))

    def value(logarithms: Array) -> float:
        p = best * np.exp(logarithms)
        return float(np.log(_force(bar.thickness, bar.skin, p, time, depth)[last]))

    true = float(np.log(world.force(bar, truth, time, depth)[last]))
    slope = np.array([(value(_STEP * row) - value(-_STEP * row)) / (2 * _STEP) for row in np.eye(8)])
    at, (centre, covariance) = value(np.zeros(8)), sampled
    off, variance = float(slope @ np.log(centre / best)), float(slope @ covariance @ slope)
    weight, shift, further, fall = spread
    found = {"error": 100 * float(np.expm1(at - true))}
    for word, share, moved, added, falls in (
        ("before", 1.0, 0.0, 0.0, 0.0),
        ("after", weight, float(slope @ shift), float(slope @ further @ slope), float(slope @ fall)),
    ):
        half = NORMAL_95 * np.sqrt(share * variance + added)
        low, high = at + moved + share * min(0.0, off) - half, at + moved + share * max(0.0, off) + half
        low -= falls
        low, high = min(low, at), max(high, at)  # as those of a socket
        found |= {f"{word}_inside": 100.0 * (low <= true <= high)}
        found |= {f"{word}_half": 50 * float(np.exp(high - at) - np.exp(low - at))}
    return found


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Means over draws and sites."""

    def mean(part: str, key: str) -> float:
        return float(np.mean([one[key] for row in rows for one in row[part]]))

    def covered(key: str) -> float:
        hits = [hit for row in rows for hit, yes in zip(row["inside"], row[key]) if yes]
        return 100 * float(np.mean(hits)) if hits else float("nan")

    return {
        "named": 100 * float(np.mean([row["named"] for row in rows])),
        "times noise": float(np.median([row["times_noise"] for row in rows])),
        "heldout": mean("heldout", "error"),
        "determined": float(np.mean([sum(row["determined"]) for row in rows])),
        "true": covered("determined"),
        "still": float(np.mean([sum(row["still_determined"]) for row in rows])),
        "still true": covered("still_determined"),
        "band": mean("heldout", "inside"),
        "band half": mean("heldout", "half"),
        "error": mean("after", "error"),
        "before": mean("after", "before_inside"),
        "before half": mean("after", "before_half"),
        "after": mean("after", "after_inside"),
        "after half": mean("after", "after_half"),
    }


HEADS = (
    "| truth | named, times noise | held-out error | determined, of which true: before | after | "
    "band: inside, half width | force after the hold: error | before: half width, inside | "
    "after: half width, inside | prefers |"
)


def format_row(name: str, s: Mapping[str, float], rows: Sequence[Mapping[str, Any]]) -> str:
    words = [row["prefers"] for row in rows]
    counts = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
    if warned := sum(row["gives_way"] for row in rows):
        counts += f"; {warned} may give way"
    return (
        f"| {name} | {s['named']:.0f} %, {s['times noise']:.1f} | {s['heldout']:.1f} % | "
        f"{s['determined']:.1f}, {s['true']:.0f} % | "
        f"{s['still']:.1f}, {s['still true']:.0f} % | {s['band']:.0f} %, {s['band half']:.1f} % | "
        f"{s['error']:+.0f} % | {s['before half']:.0f} %, {s['before']:.0f} % | "
        f"{s['after half']:.0f} %, {s['after']:.0f} % | {counts} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("worlds", nargs="*", help=f"by default all: {', '.join(WORLDS)}")
    parser.add_argument("--draws", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="of the first draw")
    parser.add_argument("--hold", type=float, default=0.0, help="s, of one fitted site")
    parser.add_argument("--after", type=float, default=60.0, help="s, of the hold that is predicted")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    unknown = [name for name in given.worlds if name not in WORLDS]
    if unknown:
        sys.exit(f"unknown world {unknown[0]!r}; use one of {', '.join(WORLDS)}")
    print(HEADS, "|" + "---|" * HEADS.count(" |"), sep="\n")
    found, everything = {}, []
    for name in given.worlds or WORLDS:
        seeds = range(given.seed, given.seed + given.draws)
        rows = [run_draw(WORLDS[name], seed, given.hold, given.after) for seed in seeds]
        found[name] = {"summary": summarise(rows), "draws": rows}
        everything += rows
        print(format_row(name, found[name]["summary"], rows), flush=True)
        if given.json:
            given.json.write_text(json.dumps(found, indent=1) + "\n")
    print(format_row("all", summarise(everything), everything))


if __name__ == "__main__":
    main()
