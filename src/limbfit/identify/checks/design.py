"""The choice of sites to test, and of depths: those whose data would determine the parameters best.

At given parameters each candidate indentation has a Fisher information on the logarithms of the parameters,
``J' S^-1 J``, from the exact derivatives of its force and a noise model. The information of several
indentations adds up. D-optimal is the choice with the largest determinant of the sum (the smallest volume of
the joint confidence region), A-optimal the one with the smallest sum of variances (Fedorov 1972; Atkinson and
Donev 1992). The bounds replace data where there are none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from math import comb, prod
from typing import Literal

import numpy as np
from scipy.linalg import solve_toeplitz, toeplitz

from ...arrays import Array
from ...errors import CalibrationError
from ..fit.objective import SiteResponse
from ..fit.parameters import Unknowns
from ..uncertainty.uncertainty import NORMAL_95

Criterion = Literal["D", "A"]

MAX_EXHAUSTIVE_CHOICES = 20_000  # choices that are all looked at; more are searched by exchanges
_RESTARTS = 20


@dataclass(frozen=True)
class NoiseModel:
    """The scatter of a record's force about the model.

    ``sensor_N`` is white. ``misfit`` (a fraction of the largest force) is the model's own error, which drifts
    along the trace with the ``correlation`` of neighbouring points. ``bias_N`` shifts all points together.
    """

    sensor_N: float
    misfit: float = 0.0
    correlation: float = 0.9
    bias_N: float = 0.0

    def __post_init__(self) -> None:
        if not (self.sensor_N >= 0 and self.misfit >= 0 and 0 <= self.correlation < 1):
            raise CalibrationError("a noise model has standard deviations >= 0 and a correlation below 1")
        if self.sensor_N == 0 and self.misfit == 0:
            raise CalibrationError("a design needs some noise: without any, one site determines everything")

    def covariance_row(self, force_N: Array) -> Array:
        """First row (n,) of the covariance of a record, which is a Toeplitz matrix."""
        n = len(force_N)
        drift = (self.misfit * float(np.abs(force_N).max())) ** 2 * self.correlation ** np.arange(n)
        drift[0] += self.sensor_N**2
        return np.asarray(drift + self.bias_N**2, dtype=np.float64)


@dataclass(frozen=True)
class Candidate:
    """An indentation that could be made, and its ``information`` (p, p) on log(parameters)."""

    site: str
    depth_mm: float
    information: Array


def build_candidate(
    site: str, depth_mm: float, response: SiteResponse, parameters: Array, noise: NoiseModel
) -> Candidate:
    """Build the candidate of a simulated indentation.

    Raises
    ------
    CalibrationError
        If the simulation is partial: half a record informs differently from the whole.
    """
    if not response.completed:
        raise CalibrationError(f"{site}, {depth_mm:g} mm: {response.reason or 'simulation failed'}")
    return Candidate(site, depth_mm, compute_information(response, parameters, noise))


def compute_information(response: SiteResponse, parameters: Array, noise: NoiseModel) -> Array:
    """Return the Fisher information (p, p) on log(parameters) of a simulated response."""
    scaled = response.jacobian * parameters
    information = scaled.T @ solve_toeplitz(noise.covariance_row(response.force_N), scaled)
    return np.asarray((information + information.T) / 2)


def compute_field_information(
    values: Array, slopes: Array, similarity: Array, parameters: Array, noise: NoiseModel
) -> Array:
    """Return the Fisher information (p, p) on log(parameters) of a field: curves ``values`` (g, n) of a
    record.

    Its misfit is a share of the largest value of all, with ``similarity`` (g, g) between curves; ``slopes``
    (g, n, p) are derivatives.
    """
    n = values.shape[1]
    across, U = np.linalg.eigh(similarity)
    along, V = np.linalg.eigh(toeplitz(noise.correlation ** np.arange(n)))
    rotated = np.einsum("ga,gnp,nb->abp", U, slopes * parameters, V, optimize=True)
    misfit = noise.misfit * float(np.abs(values).max())
    variances = noise.sensor_N**2 + misfit**2 * np.outer(across, along).clip(0.0)
    return np.einsum("abp,abq->pq", rotated / variances[..., None], rotated)


def compute_bounds_information(unknowns: Unknowns) -> Array:
    """Return the information (p, p) of the bounds, as of a uniform distribution between them."""
    return np.diag(12.0 / np.log(unknowns.upper / unknowns.lower) ** 2)


@dataclass(frozen=True)
class Design:
    """A choice of candidates (indices) and what is expected of it.

    ``covariance`` (p, p) is that of log(parameters), ``log_det`` that of the information; ``exhaustive`` says
    that no other choice is better.
    """

    chosen: tuple[int, ...]
    covariance: Array
    log_det: float
    exhaustive: bool = True

    @property
    def trace(self) -> float:
        return float(np.trace(self.covariance))

    @property
    def factors_95(self) -> Array:
        """(p,) the factor f of the expected 95 % interval [value / f, value x f]."""
        return np.exp(np.minimum(NORMAL_95 * np.sqrt(np.diag(self.covariance)), 50.0))


def evaluate_design(candidates: Sequence[Candidate], chosen: Sequence[int], prior: Array) -> Design:
    """Return what to expect of a given choice."""
    information = prior + sum(candidates[i].information for i in chosen)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Design(tuple(chosen), covariance, float(np.linalg.slogdet(information)[1]))


def compute_efficiency(design: Design, best: Design, criterion: Criterion) -> float:
    """Return the efficiency of a design, between 0 and 1 if ``best`` is better.

    For D it is the share of the data of ``best`` that would tell as much, for A the ratio of the sums of
    variances.
    """
    if criterion == "A":
        return best.trace / design.trace
    return float(np.exp((design.log_det - best.log_det) / len(best.covariance)))


def choose_design(
    candidates: Sequence[Candidate], size: int, prior: Array, criterion: Criterion = "D", seed: int = 0
) -> Design:
    """Choose the best ``size`` sites, each with one of its depths.

    All choices are compared if there are at most 20,000. Otherwise a greedy choice and random ones are
    improved by exchanging one candidate at a time until no exchange helps.

    Raises
    ------
    CalibrationError
        If there are fewer sites than ``size``.
    """
    sites = list(dict.fromkeys(c.site for c in candidates))
    groups = [[i for i, c in enumerate(candidates) if c.site == site] for site in sites]
    if not 0 < size <= len(groups):
        raise CalibrationError(f"{size} sites are wanted of {len(groups)}")
    number = comb(len(groups), size) * max(prod([max(map(len, groups))] * size), 1)
    infos = np.stack([c.information for c in candidates])
    if number <= MAX_EXHAUSTIVE_CHOICES:
        choices = (chosen for picked in combinations(groups, size) for chosen in product(*picked))
        best = min(choices, key=lambda chosen: _compute_cost(infos, chosen, prior, criterion))
        return evaluate_design(candidates, best, prior)
    rng = np.random.default_rng(seed)
    starts = [_choose_greedily(infos, groups, size, prior, criterion)]
    for _ in range(_RESTARTS):
        picked = rng.choice(len(groups), size, replace=False)
        starts.append([int(rng.choice(groups[g])) for g in picked])
    ends = [_improve_by_exchange(infos, groups, start, prior, criterion) for start in starts]
    end = min(ends, key=lambda chosen: _compute_cost(infos, chosen, prior, criterion))
    found = evaluate_design(candidates, sorted(end), prior)
    return Design(found.chosen, found.covariance, found.log_det, exhaustive=False)


def _compute_cost(infos: Array, chosen: Sequence[int], prior: Array, criterion: Criterion) -> float:
    information = prior + infos[list(chosen)].sum(axis=0)
    if criterion == "A":
        return float(np.trace(np.linalg.inv(information)))
    return -float(np.linalg.slogdet(information)[1])


def _choose_greedily(
    infos: Array, groups: Sequence[Sequence[int]], size: int, prior: Array, criterion: Criterion
) -> list[int]:
    chosen: list[int] = []
    for _ in range(size):
        free = [i for group in groups if not set(group) & set(chosen) for i in group]
        chosen.append(min(free, key=lambda i: _compute_cost(infos, [*chosen, i], prior, criterion)))
    return chosen


def _improve_by_exchange(
    infos: Array, groups: Sequence[Sequence[int]], start: Sequence[int], prior: Array, criterion: Criterion
) -> list[int]:
    """Return the choice after the best exchange of one candidate, repeated until no exchange helps."""
    chosen, cost = list(start), _compute_cost(infos, start, prior, criterion)
    while True:
        trials = []
        for at in range(len(chosen)):
            rest = chosen[:at] + chosen[at + 1 :]
            free = [i for group in groups if not set(group) & set(rest) for i in group if i not in chosen]
            trials += [[*rest, i] for i in free]
        best = min(trials, key=lambda trial: _compute_cost(infos, trial, prior, criterion), default=chosen)
        least = _compute_cost(infos, best, prior, criterion)
        if not least < cost - 1e-12 * abs(cost):
            return chosen
        chosen, cost = best, least
