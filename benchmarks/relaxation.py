"""How many relaxation terms six curves of real tissue want, and which slope a power law of time has there.

    python benchmarks/relaxation.py       # tables by law; needs shared/data/relaxation, or --data

Muscle outside the body (shared/data/README.md): a ramp of some 3 s to about 1.2 N, then 10 s of relaxation.
Indenter and specimen are not known, so the elastic force is left open, three powers of the depth; the
relaxation acts on it as on limbfit's tissues (quasi-linear viscoelasticity, G(0) = 1 + sum of amplitudes).

Two questions are asked of every law. Does it describe the curve: Schwarz' criterion with the likelihood of
residuals that remember the last one (an autoregressive process of first order), so that 140 samples count as
what they are worth. Does it predict: fitted to the ramp and the first half of the hold, how far is it off in
the second half.

A power of time is a sum of eight terms at fixed times, of amplitudes gamma (tau / 1 s)^-slope: two
parameters.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from limbfit.relaxation import compute_power_law_terms

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / ".." / "shared" / "data" / "relaxation"
POOR = "230403-FF1A"  # as its source says: 0.87 N
POWERS = (1.0, 3.0, 6.0)  # of the depth, in the elastic force
TOUCHED_N = 0.03  # force above rest that says the tissue is touched
SHORTEST_S, LONGEST_S = 0.05, 100.0  # of relaxation times that may be found, or that a power law is made of
POWER_TIMES_S = np.geomspace(SHORTEST_S, LONGEST_S, 8)
STARTS = 3
MOST_TERMS = 6
AMPLITUDES = (1e-4, 100.0)


@dataclass(frozen=True)
class Curve:
    """From touch-down on: ``time_s``, ``depth_mm``, ``force_N`` (n,); ``held`` is where the hold begins."""

    name: str
    time_s: Array
    depth_mm: Array
    force_N: Array
    held: int

    def until(self, end: int) -> Curve:
        return Curve(self.name, self.time_s[:end], self.depth_mm[:end], self.force_N[:end], self.held)


@dataclass(frozen=True)
class Law:
    """A relaxation: ``terms`` makes amplitudes and times (s) of its parameters within ``bounds`` (p, 2).

    ``starts (s, p)``: where its fits begin.
    """

    name: str
    terms: Callable[[Array], tuple[Array, Array]]
    bounds: Array
    starts: Array


@dataclass(frozen=True)
class RelaxationFit:
    """A law on a curve.

    ``parameters`` of the law; ``error``: root mean square over the peak, ``bic``: Schwarz' criterion with
    correlated residuals, ``memory``: their lag-one correlation; ``ahead``: root mean square error in the
    second half of the hold over the peak, of the fit to what comes before; ``end``: its error at the end.
    """

    law: Law
    parameters: Array
    error: float
    bic: float
    memory: float
    ahead: float
    end: float


def prony_law(count: int) -> Law:
    """``count`` terms, each amplitude and time free."""
    times = np.geomspace(0.15, 15.0, count) if count > 1 else np.array([2.0])
    shifts = np.linspace(-1.0, 1.0, STARTS)
    starts = np.array(
        [np.concatenate([np.full(count, np.log(1.5 / count)), np.log(times) + s]) for s in shifts]
    )
    bounds = np.log(np.concatenate([[AMPLITUDES] * count, [(SHORTEST_S, LONGEST_S)] * count]))
    return Law(
        f"{count} term" + "s" * (count > 1),
        lambda p: (np.exp(p[:count]), np.exp(p[count:])),
        bounds,
        np.clip(starts, bounds[:, 0], bounds[:, 1]),
    )


def power_law() -> Law:
    """Fixed times with amplitudes gamma (tau / 1 s)^-slope."""
    return Law(
        "power of time",
        lambda p: (compute_power_law_terms(float(np.exp(p[0])), p[1], POWER_TIMES_S), POWER_TIMES_S),
        np.array([np.log(AMPLITUDES), (-0.5, 2.0)]),
        np.array([[0.0, slope] for slope in (0.0, 0.2, 0.5)]),
    )


LAWS = (*(prony_law(count) for count in range(1, MOST_TERMS + 1)), power_law())


def read_curve(file: Path) -> Curve:
    """The ramp from touch-down, and the hold."""
    time, force, depth = np.loadtxt(file, delimiter=",", skiprows=1).T
    peak = int(np.argmax(force))
    rest = force[:5].mean()
    touched = int(np.flatnonzero(force[:peak] - rest < TOUCHED_N)[-1])
    t, u, F = (values[touched:] for values in (time, depth, force))
    held = int(np.flatnonzero(u < u[-1] - 0.02)[-1]) + 1
    return Curve(file.stem, t - t[0], u - u[0], F - F[0], held)


def relaxed_forces(curve: Curve, amplitudes: Array, times_s: Array) -> Array:
    """(n, 3) relaxed force of each power of the depth: exact for what is linear between samples."""
    depth = np.maximum(curve.depth_mm / curve.depth_mm[-1], 0.0)
    elastic = np.stack([depth**power for power in POWERS], axis=1)
    step = curve.time_s[1] - curve.time_s[0]
    change = np.diff(elastic, axis=0, prepend=0.0)
    force = elastic.copy()
    for g, tau in zip(amplitudes, times_s, strict=True):
        x = step / tau
        force += g * lfilter([-np.expm1(-x) / x], [1.0, -np.exp(-x)], change, axis=0)
    return np.asarray(force)


def fit_law(curve: Curve, law: Law) -> tuple[Array, Array, Array]:
    """Its parameters, the moduli (3,) of the elastic force and the residuals (n,) that are least together."""

    def unpacked(p: Array) -> tuple[Array, Array]:
        return relaxed_forces(curve, *law.terms(p[3:])), np.exp(p[:3])

    def residuals(p: Array) -> Array:
        columns, moduli = unpacked(p)
        return np.asarray(curve.force_N - columns @ moduli)

    peak = curve.force_N.max()
    bounds = np.concatenate([np.log(peak * np.array([[1e-4, 10.0]] * 3)), law.bounds])
    found = [
        least_squares(
            residuals, np.concatenate([np.log(peak * np.full(3, 0.15)), start]), bounds=bounds.T, max_nfev=80
        )
        for start in law.starts
    ]
    best = min(found, key=lambda one: one.cost).x
    return best[3:], np.exp(best[:3]), residuals(best)


def judge_law(curve: Curve, law: Law) -> RelaxationFit:
    """How well a law describes a curve, and how well it predicts the second half of the hold."""
    parameters, _, residuals = fit_law(curve, law)
    peak, n = curve.force_N.max(), len(residuals)
    memory = float(np.clip(residuals[1:] @ residuals[:-1] / (residuals[:-1] @ residuals[:-1]), 0.0, 0.999))
    news = residuals[1:] - memory * residuals[:-1]
    bic = (n - 1) * np.log(news @ news / (n - 1)) + (len(parameters) + len(POWERS) + 1) * np.log(n - 1)
    half = (curve.held + n) // 2
    early, moduli, _ = fit_law(curve.until(half), law)
    ahead = (relaxed_forces(curve, *law.terms(early)) @ moduli - curve.force_N)[half:] / peak
    error = float(np.sqrt(np.mean(residuals**2)) / peak)
    return RelaxationFit(
        law, parameters, error, float(bic), memory, float(np.sqrt(np.mean(ahead**2))), float(ahead[-1])
    )


def fall_per_decade(curve: Curve) -> float:
    """Slope of log(force) over log(time since the hold began), from 1 s on: that of a plain power of time."""
    since = curve.time_s[curve.held :] - curve.time_s[curve.held]
    late = since >= 1.0
    return -float(np.polyfit(np.log(since[late]), np.log(curve.force_N[curve.held :][late]), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA, help="the folder of curves")
    curves = [read_curve(file) for file in sorted(parser.parse_args().data.glob("*.csv"))]
    fits = [[judge_law(curve, law) for law in LAWS] for curve in curves]
    least = [min(fit.bic for fit in found) for found in fits]
    print("law, by curve (" + ", ".join(curve.name for curve in curves) + ")")
    for law, of_law in zip(LAWS, zip(*fits, strict=True), strict=True):
        for words, values, form in (
            ("error, % of the peak", [100 * fit.error for fit in of_law], "{:.2f}"),
            (
                "criterion over the least",
                [fit.bic - low for fit, low in zip(of_law, least, strict=True)],
                "{:.0f}",
            ),
            ("second half ahead, % of the peak", [100 * fit.ahead for fit in of_law], "{:.2f}"),
            ("its end, %", [100 * fit.end for fit in of_law], "{:+.1f}"),
            ("memory", [fit.memory for fit in of_law], "{:.2f}"),
        ):
            print(f"{law.name:14s} {words:34s}", "  ".join(form.format(value) for value in values))
        for fit in of_law:
            terms = np.column_stack(law.terms(fit.parameters))
            shown = f"gamma {np.exp(fit.parameters[0]):.2f}, slope {fit.parameters[1]:.2f}"
            print(" " * 15, shown if law.name == "power of time" else np.round(terms, 2).tolist())
    print(
        "slope of the force itself, 1 s to the end:", "  ".join(f"{fall_per_decade(c):.3f}" for c in curves)
    )


if __name__ == "__main__":
    main()
