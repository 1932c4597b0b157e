"""How stiff the layers of people's legs are and how much people differ: a nonlinear mixed model.

A person's site i has layers l with compressions d (mm) under the force F (N),

    d_il = F_i g_l(thickness_i, mu_i) + e_l - e_(l-1),    g: layer_compressions,
    log mu_il = beta_l,site + alpha_l log(F_i / F_0) + u_l,person + v_il,

u and v normal, between and within persons, e normal: the reading error of each layer's lower end. alpha is
how layers stiffen with the force, or that stiffer people are pressed harder: the data cannot part the two.
Fitted as Lindstrom and Bates do (Biometrics 1990, doi 10.2307/2532087): compressions are linearised at the
likeliest u and v, the linear mixed model that results is fitted by restricted maximum likelihood, and so on.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]
Whole = NDArray[np.intp]

SITES = ("LL_A", "LL_P", "UL_A", "UL_P")
FORCE_N = 9.0  # F_0, the median
STEP = 1e-4  # of central differences, in logarithms
ROUNDS, STILL = 150, 0.01  # of linearisation, and when they end: change of logarithms
DAMPED, SETTLING = 0.5, 15  # of a whole step, which overshoots; rounds after which it is half of that
WEAK_MPA, WEAK = 0.005, 2.0  # prior of beta: its middle, and the standard deviation of the logarithm
LEAST, MOST = 0.02, 3.0  # bounds of standard deviations
READING_MM = 0.8  # nothing is read worse: what is more is a difference of places
TYPICAL, SPREAD = 0.3, 1.0  # lognormal prior of the deviations of logarithms


class PressedLayers(Protocol):
    """Layers at n places under a probe."""

    def compressions(self, shear_moduli: Array) -> Array:
        """Compression of each layer in mm per N, (n, l), for moduli (n, l) in MPa."""


class Probe(Protocol):
    """What presses: `layer_compressions.Footprint`, linear theory, or `solved_layers.SolvedFootprint`."""

    def under(self, thickness_mm: Array, force_N: Array) -> PressedLayers:
        """Layers of these thicknesses (n, l) under it, pressed by forces (n,)."""


@dataclass(frozen=True)
class Known:
    """What is not fitted: the modulus of a layer, lognormal over persons."""

    layer: int
    median_MPa: float
    sd_log: float


@dataclass(frozen=True)
class Legs:
    """n places on people: ``person``, ``site``, ``force_N`` (n,), thickness and compression (n, l)."""

    person: Whole
    site: Whole
    force_N: Array
    thickness_mm: Array
    compression_mm: Array

    def of(self, chosen: NDArray[np.bool_]) -> Legs:
        return Legs(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def read_legs(file: Path, layers: Sequence[Sequence[str]]) -> Legs:
    """The table of the MULTIS study; a layer is one or several of ``skin``, ``fat``, ``muscle``, added up."""
    with file.open(encoding="utf-8") as opened:
        rows = [row for row in csv.DictReader(opened) if row["total_strain"]]

    def column(key: str) -> Array:
        return np.array([float(row[key]) for row in rows])

    names = {name for layer in layers for name in layer}
    thickness = {name: column(f"{name}_mm") for name in names}
    pressed = {name: column(f"{name}_strain") * thickness[name] for name in names}
    return Legs(
        np.array([int(row["person"]) for row in rows]),
        np.array([SITES.index(row["site"]) for row in rows]),
        column("max_force_N"),
        np.stack([sum(thickness[name] for name in layer) for layer in layers], axis=1),
        np.stack([sum(pressed[name] for name in layer) for layer in layers], axis=1),
    )


@dataclass(frozen=True)
class Fit:
    """``effects`` (l, 5): beta of each site and alpha, of log MPa, with ``covariance`` (5 l, 5 l).

    ``between``, ``within`` (l,) are standard deviations of log mu, ``reading_mm`` (l,) those of e; ``logs``
    (n, l) are the likeliest log mu of every place that was fitted.
    """

    effects: Array
    covariance: Array
    between: Array
    within: Array
    reading_mm: Array
    logs: Array | None = None


@dataclass(frozen=True)
class _Linear:
    """Compressions (p, 4, l) of p persons, linear in log mu: ``seen`` = ``slope`` @ log mu + noise."""

    seen: Array
    slope: Array
    design: Array  # (p, 4, l, 5 l)
    gap: NDArray[np.bool_]  # (p, 4)


def fit(
    legs: Legs, probe: Probe, known: Sequence[Known] = (), still: float = STILL, start: Fit | None = None
) -> Fit:
    """The model of these legs, searched from that of much the same legs where one is given.

    ``still``: root mean square step of the likeliest log mu of all places at which it ends.
    """
    count = legs.thickness_mm.shape[1]
    under = probe.under(legs.thickness_mm, legs.force_N)
    people, row = np.unique(legs.person, return_inverse=True)
    shape = (len(people), len(SITES))
    design = np.zeros((len(row), count, 5 * count))
    for layer in range(count):
        design[np.arange(len(row)), layer, 5 * layer + legs.site] = 1.0
        design[:, layer, 5 * layer + 4] = np.log(legs.force_N / FORCE_N)

    def placed(values: Array) -> Array:
        table = np.zeros((*shape, *values.shape[1:]))
        table[row, legs.site] = values
        return table

    model = _Mixed(count, tuple(known))
    gap = placed(np.ones(len(row))) == 0
    logs, theta = design @ model.middle, model.start
    if start is not None and start.logs is not None:
        logs = start.logs
        theta = np.log(np.concatenate([start.between, start.within, start.reading_mm]))
    for number in range(ROUNDS):
        expected, slope = _pressed(under, legs.force_N, logs)
        seen = legs.compression_mm - expected + np.einsum("nij,nj->ni", slope, logs)
        linear = _Linear(placed(seen), placed(slope), placed(design), gap)
        found = minimize(model.cost, theta, args=(linear,), method="L-BFGS-B", bounds=model.bounds)
        step = model.likeliest(found.x, linear)[row, legs.site] - logs
        moved = max(np.abs(found.x - theta).max(), float(np.sqrt(np.mean(step**2))))
        theta, logs = found.x, logs + np.clip(DAMPED / (1 + number / SETTLING) * step, -0.5, 0.5)
        if moved < still:
            break
    else:
        raise RuntimeError(f"the logarithms still move by {moved:.1e} after {ROUNDS} rounds")
    between, within, reading = model.deviations(theta)
    effects, covariance = model.effects(theta, linear)
    return Fit(effects.reshape(count, 5), covariance, between, within, reading, logs)


def _pressed(under: PressedLayers, force_N: Array, logs: Array) -> tuple[Array, Array]:
    """Compressions (n, l) and their derivatives (n, l, l) with respect to log mu."""
    columns = []
    for layer in range(logs.shape[1]):
        step = np.zeros(logs.shape[1])
        step[layer] = STEP
        ends = (under.compressions(np.exp(logs + sign * step)) for sign in (1, -1))
        columns.append((next(ends) - next(ends)) / (2 * STEP))
    pressed = under.compressions(np.exp(logs))
    return pressed * force_N[:, None], np.stack(columns, axis=-1) * force_N[:, None, None]


class _Mixed:
    """The linear mixed model: theta are the logarithms of the standard deviations."""

    def __init__(self, count: int, known: tuple[Known, ...]) -> None:
        self.count, self.known = count, known
        self.middle = np.tile([*[np.log(WEAK_MPA)] * 4, 0.0], count)
        self.precision = np.tile([*[WEAK**-2] * 4, 1.0], count)
        for one in known:
            own = slice(5 * one.layer, 5 * one.layer + 5)
            self.middle[own] = [*[np.log(one.median_MPa)] * 4, 0.0]
            self.precision[own] = 1e6
        self.start = np.log([TYPICAL] * (3 * count))
        self.bounds = [(np.log(LEAST), np.log(MOST))] * (2 * count) + [
            (np.log(LEAST), np.log(READING_MM))
        ] * count

    def deviations(self, theta: Array) -> tuple[Array, Array, Array]:
        between, within, reading = np.exp(theta).reshape(3, self.count)
        for one in self.known:
            between[one.layer], within[one.layer] = one.sd_log, LEAST
        return between, within, reading

    def cost(self, theta: Array, linear: _Linear) -> float:
        """Minus the restricted log-likelihood, with the weak priors of the deviations."""
        log, square, A, b = self._sums(theta, linear)
        moved = np.linalg.solve(A, b)
        prior = np.sum(((theta[: 2 * self.count] - np.log(TYPICAL)) / SPREAD) ** 2)
        return float(0.5 * (log + square - b @ moved + np.linalg.slogdet(A)[1] + prior))

    def effects(self, theta: Array, linear: _Linear) -> tuple[Array, Array]:
        A, b = self._sums(theta, linear)[2:]
        return self.middle + np.linalg.solve(A, b), np.linalg.inv(A)

    def likeliest(self, theta: Array, linear: _Linear) -> Array:
        """log mu (p, 4, l) where persons and places are likeliest."""
        between, within, _ = self.deviations(theta)
        effects, _ = self.effects(theta, linear)
        V, X, y = self._system(theta, linear)
        left = np.linalg.solve(V, (y - X @ effects)[..., None])[..., 0].reshape(linear.seen.shape)
        pull = np.einsum("psij,psi->psj", linear.slope, left)
        return np.asarray(
            linear.design @ effects + between**2 * pull.sum(axis=1, keepdims=True) + within**2 * pull
        )

    def _sums(self, theta: Array, linear: _Linear) -> tuple[float, float, Array, Array]:
        """Log-determinant, square of what was seen, normal equations of the effects about ``middle``."""
        V, X, y = self._system(theta, linear)
        half = np.linalg.cholesky(V)
        white = np.linalg.solve(half, np.concatenate([X, (y - X @ self.middle)[..., None]], axis=-1))
        WX, Wy = white[..., :-1], white[..., -1]
        A = np.einsum("pki,pkj->ij", WX, WX) + np.diag(self.precision)
        b = np.einsum("pki,pk->i", WX, Wy)
        log = 2 * float(np.log(np.diagonal(half, axis1=1, axis2=2)).sum())
        return log, float(np.sum(Wy**2)), A, b

    def _system(self, theta: Array, linear: _Linear) -> tuple[Array, Array, Array]:
        """Covariance (p, 4 l, 4 l), design and values of what was seen; a gap is a reading of nothing."""
        between, within, reading = self.deviations(theta)
        people, sites, count = linear.seen.shape
        ends = np.eye(count) - np.eye(count, k=-1)
        noise = ends @ np.diag(reading**2) @ ends.T
        J = linear.slope
        V = np.einsum("psij,j,ptkj->psitk", J, between**2, J)
        own = np.einsum("psij,j,pskj->psik", J, within**2, J)
        own += np.where(linear.gap[..., None, None], np.eye(count), noise)
        for site in range(sites):
            V[:, site, :, site, :] += own[:, site]
        X = np.einsum("psij,psjk->psik", J, linear.design)
        size = sites * count
        return V.reshape(people, size, size), X.reshape(people, size, -1), linear.seen.reshape(people, size)


@dataclass(frozen=True)
class Coverage:
    """Share of the compressions of held-out persons in 90 % intervals: by layer, of all layers' sum, all."""

    layers: tuple[float, ...]
    whole: float
    all: float


def predict(found: Fit, legs: Legs, probe: Probe, draws: int, seed: int = 0) -> Array:
    """Drawn compressions (draws, n, l) of the layers of other persons' legs, readings and all."""
    random = np.random.default_rng(seed)
    under, count = probe.under(legs.thickness_mm, legs.force_N), legs.thickness_mm.shape[1]
    people, row = np.unique(legs.person, return_inverse=True)
    force = np.log(legs.force_N / FORCE_N)[:, None]
    told = np.empty((draws, *legs.thickness_mm.shape))
    for one in told:
        effects = random.multivariate_normal(found.effects.ravel(), found.covariance).reshape(count, 5)
        logs = effects[:, legs.site].T + force * effects[:, 4]
        logs = logs + random.normal(0, found.between, (len(people), count))[row]
        logs = logs + random.normal(0, found.within, logs.shape)
        ends = random.normal(0, found.reading_mm, logs.shape)
        one[:] = legs.force_N[:, None] * under.compressions(np.exp(logs))
        one += np.diff(ends, axis=1, prepend=0.0)
    return told


def predict_held_out(
    legs: Legs,
    probe: Probe,
    known: Sequence[Known] = (),
    folds: int = 10,
    draws: int = 400,
    still: float = STILL,
) -> Array:
    """Compressions (draws, n, l) of every person, drawn from the model of the others.

    Every person is left out once, with as many of the others as ``folds`` ask for: alone with one fold each.
    """
    fold = np.random.default_rng(0).permutation(legs.person.max() + 1)[legs.person] % folds
    drawn, every = np.empty((draws, *legs.compression_mm.shape)), fit(legs, probe, known, still)
    for number in np.unique(fold):
        out = fold == number
        others = fit(legs.of(~out), probe, known, still, replace(every, logs=every.logs[~out]))
        drawn[:, out] = predict(others, legs.of(out), probe, draws, int(number))
    return drawn


def coverage(
    legs: Legs, probe: Probe, known: Sequence[Known] = (), folds: int = 10, draws: int = 400
) -> Coverage:
    """Of the intervals of `predict_held_out`."""
    drawn = predict_held_out(legs, probe, known, folds, draws)
    inside = within(drawn, legs.compression_mm)
    whole = within(drawn.sum(axis=2), legs.compression_mm.sum(axis=1))
    return Coverage(tuple(map(float, inside.mean(axis=0))), float(whole.mean()), float(inside.mean()))


def within(drawn: Array, seen: Array) -> NDArray[np.bool_]:
    """Whether what was seen lies in the middle 90 % of what was drawn (draws, ...)."""
    low, high = np.quantile(drawn, [0.05, 0.95], axis=0)
    return np.asarray((low <= seen) & (seen <= high))
