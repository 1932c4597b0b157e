"""The choice of sites to test, of depths, and of records: those whose data would determine parameters best.

At given parameters each candidate indentation has a Fisher information on the logarithms of the parameters,
``J' S^-1 J``, from the exact derivatives of its force and a noise model. The information of several
indentations adds up. D-optimal is the choice with the largest determinant of the sum (the smallest volume of
the joint confidence region), A-optimal the one with the smallest sum of variances (Fedorov 1972; Atkinson and
Donev 1992). The bounds and the stated priors count beside the data.

Records that have to fit into a patient's time are chosen by Bayesian design (`plan_records`). Their
information is computed at several samples of the parameters, because what a record tells depends on the
tissue. A protocol is judged by the covariance of the target parameters, or of quantities that follow from
them, while the others are unknown, too: by the mean over the samples of the logarithm of its determinant (D)
or of its trace (A) (Chaloner and Verdinelli, Statistical Science 1995, 10:273).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, product
from math import comb, prod
from typing import Literal

import numpy as np
from scipy.linalg import solve_toeplitz, toeplitz
from scipy.stats import norm, qmc

from ...arrays import Array
from ...errors import CalibrationError
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace, Unknowns
from ..fit.prediction import NORMAL_95
from ..uncertainty.noise import compute_skin_similarity
from ..uncertainty.uncertainty import PriorPrecision

Criterion = Literal["D", "A"]
Cost = Callable[[Sequence[int]], float]

MAX_EXHAUSTIVE_CHOICES = 20_000  # choices that are all looked at; more are searched by exchanges
_RESTARTS = 20
_GIVEN_INFORMATION = 1e8  # on a logarithm that is given
_MAX_VARIANCE = 25.0  # of a logarithm: no factor is reported beyond exp(50), however little is known


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


@dataclass(frozen=True)
class Candidate:
    """An indentation that could be made, and its ``information`` (p, p) on log(parameters)."""

    site: str
    depth_mm: float
    information: Array


def compute_information(response: SiteResponse, parameters: Array, noise: NoiseModel) -> Array:
    """Return the Fisher information (p, p) on log(parameters) of a simulated response."""
    scaled, force = response.jacobian * parameters, response.force_N
    drift = (noise.misfit * float(np.abs(force).max())) ** 2 * noise.correlation ** np.arange(len(force))
    drift[0] += noise.sensor_N**2
    information = scaled.T @ solve_toeplitz(drift + noise.bias_N**2, scaled)
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


def compute_prior_information(unknowns: Unknowns, space: SearchSpace) -> Array:
    """Return the information (p, p) of the bounds, as of a uniform distribution between them, and of the
    stated priors.

    What does not move in the space is given, and so is the ratio of what moves together.
    """
    mean = space.tie / space.tie.sum(axis=0)
    given = np.eye(len(mean)) - mean @ space.tie.T
    known = PriorPrecision.from_unknowns(unknowns, space).precision
    return mean @ known @ mean.T + _GIVEN_INFORMATION * given


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
    free = np.sum(np.linalg.eigvalsh(best.covariance) > 2.0 / _GIVEN_INFORMATION)
    return float(np.exp((design.log_det - best.log_det) / free))


def choose_design(
    candidates: Sequence[Candidate], size: int, prior: Array, criterion: Criterion = "D", seed: int = 0
) -> Design:
    """Choose the best ``size`` sites, each with one of its depths.

    All choices are compared if there are at most 20,000. Otherwise a greedy choice and random ones are
    improved by exchanging one candidate at a time until no exchange helps.

    Raises `CalibrationError` if there are fewer sites than ``size``.
    """
    sites = list(dict.fromkeys(c.site for c in candidates))
    groups = [[i for i, c in enumerate(candidates) if c.site == site] for site in sites]
    if not 0 < size <= len(groups):
        raise CalibrationError(f"{size} sites are wanted of {len(groups)}")
    number = comb(len(groups), size) * max(prod([max(map(len, groups))] * size), 1)
    infos = np.stack([c.information for c in candidates])

    def cost(chosen: Sequence[int]) -> float:
        information = prior + infos[list(chosen)].sum(axis=0)
        if criterion == "A":
            return float(np.trace(np.linalg.inv(information)))
        return -float(np.linalg.slogdet(information)[1])

    if number <= MAX_EXHAUSTIVE_CHOICES:
        choices = (chosen for picked in combinations(groups, size) for chosen in product(*picked))
        return evaluate_design(candidates, min(choices, key=cost), prior)
    rng = np.random.default_rng(seed)
    starts = [_choose_greedily(groups, size, cost)]
    for _ in range(_RESTARTS):
        picked = rng.choice(len(groups), size, replace=False)
        starts.append([int(rng.choice(groups[g])) for g in picked])
    exchange = partial(_list_exchanges, groups)
    end = min((_improve(start, exchange, cost, 1e-12) for start in starts), key=cost)
    return replace(evaluate_design(candidates, sorted(end), prior), exhaustive=False)


def _choose_greedily(groups: Sequence[Sequence[int]], size: int, cost: Cost) -> list[int]:
    chosen: list[int] = []
    for _ in range(size):
        free = [i for group in groups if not set(group) & set(chosen) for i in group]
        chosen.append(min(free, key=lambda i: cost([*chosen, i])))
    return chosen


def _list_exchanges(groups: Sequence[Sequence[int]], chosen: list[int]) -> list[list[int]]:
    """Return the choices that have another candidate in place of one of the ``chosen``."""
    found = []
    for at in range(len(chosen)):
        rest = chosen[:at] + chosen[at + 1 :]
        free = [i for group in groups if not set(group) & set(rest) for i in group if i not in chosen]
        found += [[*rest, i] for i in free]
    return found


def _improve(
    start: list[int], list_others: Callable[[list[int]], list[list[int]]], cost: Cost, tolerance: float
) -> list[int]:
    """Take the best of the choices that ``list_others`` makes of one, until it is better by no more than a
    share of the cost."""
    chosen = start
    while True:
        best, least = min(list_others(chosen), key=cost, default=chosen), cost(chosen)
        if not cost(best) < least - tolerance * abs(least):
            return chosen
        chosen = best


class RecordNoise:
    """The noise of all that a record measures; None where that is not measured.

    ``force`` is that of the force, ``layers`` of the compressions in ultrasound, ``skin`` of the moves that
    cameras see, and ``waves`` of the speeds of shear waves; ``has_secondary`` if there is any beside the
    force. Given are standard deviations of one reading at each point of comparison. The misfit of the model
    is the same share as of the force. The speeds of a place have a common error as large as each one's own.
    """

    def __init__(
        self,
        force: NoiseModel,
        ultrasound_sd_mm: float | None = None,
        surface_sd_mm: float | None = None,
        shear_waves_sd_m_s: float | None = None,
    ) -> None:
        self.force = force
        sds = ultrasound_sd_mm, surface_sd_mm, shear_waves_sd_m_s
        self.layers, self.skin, waves = (sd if sd is None else replace(force, sensor_N=sd) for sd in sds)
        self.waves = None if waves is None else replace(waves, bias_N=waves.sensor_N)
        self.has_secondary = any(sd is not None for sd in sds)

    def compute_information(
        self,
        force: SiteResponse,
        values: Array,
        slopes: Array,
        parts: tuple[int, Array, float],
        parameters: Array,
    ) -> Array:
        """Return the information (p, p) of a record's force and of all that is measured beside it.

        ``values`` (g, n) are measured beside the force, ``slopes`` (g, n, p) are their derivatives. ``parts``
        says what the values are: first so many of layers, then three components of each of the points (k, 3)
        mm on the skin, then speeds, of which there are so many readings.
        """
        layers, points_mm, readings = parts
        information, waves = compute_information(force, parameters, self.force), layers + 3 * len(points_mm)
        curves = [SiteResponse(*pair) for pair in zip(values, slopes, strict=True)]
        if self.layers is not None:
            information += sum(compute_information(one, parameters, self.layers) for one in curves[:layers])
        if self.skin is not None and len(points_mm):
            components = np.tile(range(3), len(points_mm))
            similarity = compute_skin_similarity(np.repeat(points_mm, 3, axis=0), components)
            skin = values[layers:waves], slopes[layers:waves]
            information += compute_field_information(*skin, similarity, parameters, self.skin)
        if self.waves is not None:
            fewer = np.sqrt(max(values.shape[1] / readings, 1.0))  # than points of comparison
            noise = replace(self.waves, sensor_N=fewer * self.waves.sensor_N)
            information += sum(compute_information(one, parameters, noise) for one in curves[waves:])
        return information


@dataclass(frozen=True)
class RecordOption:
    """A record that could be made: ``information`` (d, p, p) on log(parameters) at each sample of tissue.

    ``place`` is what is prepared for it, a site with an indenter; records at one place share that time. The
    site's tissue may be stiffer as a whole, for all of its records, by a share with standard deviation
    ``site_share``.
    """

    place: tuple[str, str]
    seconds: float
    information: Array
    site_share: float = 0.0


@dataclass(frozen=True)
class Budget:
    """The time of a session: ``seconds`` in all, ``setup_s`` for each place."""

    seconds: float
    setup_s: float


@dataclass(frozen=True)
class DesignTarget:
    """What is to be determined: ``rows`` (k, p) times log(parameters), with ``prior`` information (p, p).

    Rows of the unit matrix are parameters; others are quantities that follow from them, such as a pressure's
    logarithm. ``stiffness`` (p,) is 1 for parameters that are moduli, which change if a site is stiffer;
    None: no site is.
    """

    prior: Array
    rows: Array
    criterion: Criterion = "D"
    stiffness: Array | None = None

    def compute_covariances(
        self, options: Sequence[RecordOption], chosen: Sequence[int], draws: int
    ) -> Array:
        """Return the covariance of log(parameters) (d, p, p) at each of the samples of tissue.

        The records of a site share its own stiffness, so they tell less together: that stiffness is one more
        parameter with a known spread, which is then marginalised.
        """
        total = np.repeat(self.prior[None], draws, axis=0)
        sites: dict[str, list[RecordOption]] = {}
        for i in chosen:
            sites.setdefault(options[i].place[0], []).append(options[i])
        for own in sites.values():
            informations = np.array([one.information for one in own])
            total = total + informations.sum(axis=0)
            if self.stiffness is None:
                continue
            share = np.array([one.site_share for one in own])
            along = np.einsum("r,rdij,j->di", share, informations, self.stiffness)
            alone = 1.0 + np.einsum("r,rdij,i,j->d", share**2, informations, self.stiffness, self.stiffness)
            total = total - along[:, :, None] * along[:, None, :] / alone[:, None, None]
        return np.asarray(np.linalg.inv(total))

    def project(self, covariances: Array) -> Array:
        """Return the covariance (d, k, k) of the target from that of log(parameters) (d, p, p)."""
        return np.asarray(self.rows @ covariances @ self.rows.T)

    def compute_cost(self, covariances: Array) -> float:
        """Return the criterion, which the best protocol makes smallest."""
        part = self.project(covariances)
        if self.criterion == "A":
            return float(np.trace(part, axis1=1, axis2=2).mean())
        return float(np.linalg.slogdet(part)[1].mean())


def sample_tissues(unknowns: Unknowns, space: SearchSpace, centre: Array, draws: int, seed: int) -> Array:
    """Sample tissues (d, p) that the limb may have: ``centre``, then others about it in the ``space``.

    A parameter with a prior scatters by the prior's factor, another by half of what its bounds allow. A Latin
    hypercube spreads few samples well.
    """
    spread = 0.5 * space.bounds_sd
    for prior in unknowns.priors:
        spread[space.tie[unknowns.names.index(prior.name)] > 0] = np.log(prior.factor)
    others = qmc.LatinHypercube(len(spread), rng=seed).random(max(draws - 1, 0))
    scattered = space.reduce(np.log(centre)) + spread * norm.ppf(np.clip(others, 0.05, 0.95))
    return np.vstack([centre, space.expand(np.clip(scattered, space.lower, space.upper))])


def compute_factors_95(covariances: Array) -> Array:
    """Return (d, p) the factor f of the expected 95 % interval [value / f, value x f] at each sample."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return np.asarray(np.exp(NORMAL_95 * np.sqrt(np.minimum(variances, _MAX_VARIANCE))))


def compute_duration_s(options: Sequence[RecordOption], chosen: Sequence[int], budget: Budget) -> float:
    """Return how long a protocol takes."""
    places = {options[i].place for i in chosen}
    return sum(options[i].seconds for i in chosen) + budget.setup_s * len(places)


def plan_records(options: Sequence[RecordOption], budget: Budget, target: DesignTarget) -> tuple[int, ...]:
    """Plan the records to make: added by gain in their time, then exchanged as long as that helps.

    Raises `CalibrationError` if no record fits into the time.
    """
    if all(compute_duration_s(options, [i], budget) > budget.seconds for i in range(len(options))):
        raise CalibrationError("no record fits into the time")
    draws = len(options[0].information)

    def cost(chosen: Sequence[int]) -> float:
        return target.compute_cost(target.compute_covariances(options, chosen, draws))

    def list_refilled(chosen: list[int]) -> list[list[int]]:
        """Leave each record out in turn, and fill the time again."""
        found = []
        for out in chosen:
            rest = [i for i in chosen if i != out]
            endless = replace(options[out], seconds=float("inf"))  # so that it is not chosen again
            others = [endless if i == out else option for i, option in enumerate(options)]
            found += [_fill_budget(rest, others, budget, cost, by_time=by_time) for by_time in (True, False)]
        return found

    starts = [_fill_budget([], options, budget, cost, by_time=by_time) for by_time in (True, False)]
    best = min((_improve(start, list_refilled, cost, 1e-9) for start in starts), key=cost)
    return tuple(sorted(best))


def _fill_budget(
    chosen: Sequence[int], options: Sequence[RecordOption], budget: Budget, cost: Cost, *, by_time: bool
) -> list[int]:
    """Add the record that tells most, for its time or at all, until nothing more fits."""
    filled = list(chosen)
    while True:
        now, spent, best, gain = cost(filled), compute_duration_s(options, filled, budget), -1, 0.0
        for i in range(len(options)):
            seconds = compute_duration_s(options, [*filled, i], budget)
            if i in filled or seconds > budget.seconds:
                continue
            gain_rate = (now - cost([*filled, i])) / (seconds - spent if by_time else 1.0)
            if gain_rate > gain:
                best, gain = i, gain_rate
        if best < 0:
            return filled
        filled.append(best)
