"""Which records fit into a patient's time, and what they would determine: Bayesian choice of a protocol.

Each record that could be made has a Fisher information on the logarithms of the parameters, at several draws
of them, since what a record tells depends on the tissue. A protocol is judged by the covariance of the
parameters that are wanted, or of what follows from them, the others being unknown too: by the mean over the
draws of the logarithm of its determinant (D) or of its trace (A) (Chaloner and Verdinelli, Statistical
Science 1995, 10:273).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from ...errors import CalibrationError
from ..fit.objective import SiteResponse
from ..fit.parameters import Unknowns
from ..uncertainty.noise import alike_on_skin
from ..uncertainty.uncertainty import NORMAL_95
from .design import Criterion, NoiseModel, information_of, information_of_field

Array = NDArray[np.float64]

_LARGEST_VARIANCE = 25.0  # of a logarithm: no factor is told beyond exp(50), however little is known


@dataclass(frozen=True)
class Noises:
    """Of a record's force, of the compressions that ultrasound sees, of the moves that cameras see and of the
    speeds of shear waves; None where there is none.
    """

    force: NoiseModel
    layers: NoiseModel | None = None
    skin: NoiseModel | None = None
    waves: NoiseModel | None = None

    @classmethod
    def of(
        cls,
        force: NoiseModel,
        ultrasound_sd_mm: float | None = None,
        surface_sd_mm: float | None = None,
        shear_waves_sd_m_s: float | None = None,
    ) -> Noises:
        """One reading at each point of comparison; the model errs by the same share as of the force.

        Speeds of a place are off together by as much as each is by itself.
        """
        layers, skin, waves = (
            None if sd is None else replace(force, sensor_N=sd)
            for sd in (ultrasound_sd_mm, surface_sd_mm, shear_waves_sd_m_s)
        )
        return cls(force, layers, skin, None if waves is None else replace(waves, bias_N=waves.sensor_N))

    @property
    def sees_more(self) -> bool:
        """Whether there is anything beside the force."""
        return any(one is not None for one in (self.layers, self.skin, self.waves))

    def of_force(self, force: SiteResponse, parameters: Array) -> Array:
        """Information (p, p) of a record's force."""
        return information_of(force, parameters, self.force)

    def of_all(
        self,
        force: SiteResponse,
        values: Array,
        slopes: Array,
        parts: tuple[int, Array, float],
        parameters: Array,
    ) -> Array:
        """Information (p, p) of a record with ``values`` (g, n) beside its force, ``slopes`` (g, n, p).

        ``parts``: how many of the values are of layers; then come three components of each of the points
        (k, 3) mm on the skin; then speeds, of which there are so many readings.
        """
        layers, points_mm, readings = parts
        found, waves = self.of_force(force, parameters), layers + 3 * len(points_mm)
        if self.layers is not None:
            found = found + _of_each(values[:layers], slopes[:layers], parameters, self.layers)
        if self.skin is not None and len(points_mm):
            components = np.tile(range(3), len(points_mm))
            alike = alike_on_skin(np.repeat(points_mm, 3, axis=0), components)
            skin = values[layers:waves], slopes[layers:waves]
            found = found + information_of_field(*skin, alike, parameters, self.skin)
        if self.waves is not None:
            fewer = np.sqrt(max(values.shape[1] / readings, 1.0))  # than points of comparison
            noise = replace(self.waves, sensor_N=fewer * self.waves.sensor_N)
            found = found + _of_each(values[waves:], slopes[waves:], parameters, noise)
        return found


def _of_each(values: Array, slopes: Array, parameters: Array, noise: NoiseModel) -> Array:
    """Information (p, p) of several curves (g, n)."""
    found = np.zeros((len(parameters), len(parameters)))
    for value, slope in zip(values, slopes, strict=True):
        found += information_of(SiteResponse(value, slope), parameters, noise)
    return found


@dataclass(frozen=True)
class Option:
    """A record that could be made: ``information`` (d, p, p) on log(parameters) at each draw.

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
    """Time of a session: ``seconds`` in all, ``setup_s`` for each place."""

    seconds: float
    setup_s: float


@dataclass(frozen=True)
class Wanted:
    """What is to be determined: ``rows`` (k, p) times log(parameters); ``prior`` (p, p) information is given.

    Rows of the unit matrix are parameters; others are what follows from them, such as a pressure's logarithm.
    ``stiffness`` (p,) is 1 for parameters that are moduli: how they change where a site is stiffer. None: no
    site is.
    """

    prior: Array
    rows: Array
    criterion: Criterion = "D"
    stiffness: Array | None = None

    def covariances(self, options: Sequence[Option], chosen: Sequence[int], draws: int) -> Array:
        """Of log(parameters) (d, p, p) at each of the draws.

        What the records of a site tell together is less by what its own stiffness takes away, which they
        share: the information with that as one more parameter, of known spread, that is then left out.
        """
        total = np.repeat(self.prior[None], draws, axis=0)
        sites: dict[str, list[Option]] = {}
        for i in chosen:
            sites.setdefault(options[i].place[0], []).append(options[i])
        for own in sites.values():
            told = np.array([one.information for one in own])
            total = total + told.sum(axis=0)
            if self.stiffness is None:
                continue
            share = np.array([one.site_share for one in own])
            along = np.einsum("r,rdij,j->di", share, told, self.stiffness)
            alone = 1.0 + np.einsum("r,rdij,i,j->d", share**2, told, self.stiffness, self.stiffness)
            total = total - along[:, :, None] * along[:, None, :] / alone[:, None, None]
        return np.asarray(np.linalg.inv(total))

    def of_wanted(self, covariances: Array) -> Array:
        """The covariance (d, k, k) of what is wanted, from that of log(parameters) (d, p, p)."""
        return np.asarray(self.rows @ covariances @ self.rows.T)

    def cost(self, covariances: Array) -> float:
        """What the best protocol has least of."""
        part = self.of_wanted(covariances)
        if self.criterion == "A":
            return float(np.trace(part, axis1=1, axis2=2).mean())
        return float(np.linalg.slogdet(part)[1].mean())


def drawn(known: Unknowns, centre: Array, draws: int, seed: int) -> Array:
    """Tissues (d, p) that the limb may have: ``centre``, then others about it within the bounds.

    A parameter with a prior scatters by its factor, another by half of what its bounds leave. A Latin
    hypercube spreads few draws well.
    """
    spread = 0.5 * np.log(known.upper / known.lower) / np.sqrt(12.0)
    for prior in known.priors:
        spread[known.names.index(prior.name)] = np.log(prior.factor)
    others = qmc.LatinHypercube(len(centre), rng=seed).random(max(draws - 1, 0))
    scattered = np.log(centre) + spread * norm.ppf(np.clip(others, 0.05, 0.95))
    return np.vstack([centre, np.exp(np.clip(scattered, np.log(known.lower), np.log(known.upper)))])


def factors_95(covariances: Array) -> Array:
    """(d, p) the factor f of the expected 95 % interval [value / f, value x f] at each draw."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return np.asarray(np.exp(NORMAL_95 * np.sqrt(np.minimum(variances, _LARGEST_VARIANCE))))


def seconds_of(options: Sequence[Option], chosen: Sequence[int], budget: Budget) -> float:
    """How long a protocol takes."""
    places = {options[i].place for i in chosen}
    return sum(options[i].seconds for i in chosen) + budget.setup_s * len(places)


def plan(options: Sequence[Option], budget: Budget, wanted: Wanted) -> tuple[int, ...]:
    """The records to make: added by gain in their time, then exchanged as long as that helps.

    Raises
    ------
    CalibrationError
        Where no record fits into the time.
    """
    if not options or all(seconds_of(options, [i], budget) > budget.seconds for i in range(len(options))):
        raise CalibrationError("no record fits into the time")
    draws = len(options[0].information)

    def cost(chosen: Sequence[int]) -> float:
        return wanted.cost(wanted.covariances(options, chosen, draws))

    starts = [_filled([], options, budget, cost, by_time=by_time) for by_time in (True, False)]
    best = min((_exchanged(start, options, budget, cost) for start in starts), key=cost)
    return tuple(sorted(best))


Cost = Callable[[Sequence[int]], float]


def _filled(
    chosen: Sequence[int], options: Sequence[Option], budget: Budget, cost: Cost, *, by_time: bool
) -> list[int]:
    """The choice with what tells most, for its time or at all, added until nothing more fits."""
    found = list(chosen)
    while True:
        now, spent, best, gain = cost(found), seconds_of(options, found, budget), -1, 0.0
        for i in range(len(options)):
            seconds = seconds_of(options, [*found, i], budget)
            if i in found or seconds > budget.seconds:
                continue
            told = (now - cost([*found, i])) / (seconds - spent if by_time else 1.0)
            if told > gain:
                best, gain = i, told
        if best < 0:
            return found
        found.append(best)


def _exchanged(start: Sequence[int], options: Sequence[Option], budget: Budget, cost: Cost) -> list[int]:
    """The choice with one record left out and the time filled anew, as long as that is better."""
    found, least = list(start), cost(start)
    while True:
        trials = []
        for out in found:
            rest = [i for i in found if i != out]
            without = options[out]
            others = [option if option is not without else _nothing(option) for option in options]
            trials += [_filled(rest, others, budget, cost, by_time=by_time) for by_time in (True, False)]
        best = min(trials, key=cost, default=found)
        now = cost(best)
        if not now < least - 1e-9 * abs(least):
            return found
        found, least = best, now


def _nothing(option: Option) -> Option:
    """A record that takes longer than any session: it is not chosen again."""
    return replace(option, seconds=float("inf"))
