"""Errors of simulated forces, and the intervals of predicted ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from ...arrays import Array
from ...results.identification import CalibrationUncertainty, RecordResiduals, RelaxationBeyond
from .objective import MeasuredCurve, SiteResponse, find_largest_magnitude

Values = Array | float  # numbers, or (n,)
NORMAL_95 = 1.959964  # half of a 95 % interval, in standard deviations of a normal distribution
MAX_FREEDOM = 1e6  # of Student's distribution: a normal one
MIN_FREEDOM = 3.0  # of a misfit: it is similar at other sites and in other studies


def compute_error_percent(simulated_N: Array, measured_N: Array) -> float:
    """Return the mean absolute error over the largest measured force, in percent (paper, table 2).

    Measured lengths may be negative; their largest magnitude is taken.
    """
    return float(100 * np.mean(np.abs(simulated_N - measured_N)) / find_largest_magnitude(measured_N))


def compute_errors_percent(
    responses: Sequence[SiteResponse], measured: Sequence[MeasuredCurve | SiteResponse]
) -> tuple[float, ...]:
    """Return the error of each record in percent, of what was measured or of another simulation."""
    pairs = zip(responses, measured, strict=True)
    return tuple(compute_error_percent(response.force_N, site.force_N) for response, site in pairs)


def combine_freedom(*parts: tuple[Array | float, float]) -> Array:
    """Return the degrees of freedom of a variance, of whose parts some are estimated (Satterthwaite 1946).

    A part is its share of the variance, a number or (n,), and the degrees of freedom with which it is known.
    """
    inverse = sum(np.asarray(share) ** 2 / known for share, known in parts)
    return np.asarray(1.0 / np.clip(inverse, 1.0 / MAX_FREEDOM, 1.0))


def compute_half_width_95(
    variance: Array, misfit: Array | float, site: Array | float, known_scale: float, site_freedom: float
) -> Array:
    """Return half the 95 % interval (n,) of what has a ``variance`` (n,), by Student's quantile.

    Of the variance, ``misfit`` is known from ``known_scale`` independent residuals, and ``site`` with
    ``site_freedom`` degrees of freedom.
    """
    whole = np.maximum(variance, 1e-300)
    misfit_known = max(known_scale, MIN_FREEDOM)
    freedom = combine_freedom((misfit / whole, misfit_known), (site / whole, site_freedom))
    return np.asarray(stdtrit(freedom, 0.975) * np.sqrt(variance))


def summarise_errors(errors_percent: Sequence[float]) -> tuple[int, float | None, float | None]:
    """Return number, mean and standard deviation (n - 1) of errors; None where there are too few."""
    errors = np.asarray(errors_percent, dtype=float)
    sd = float(errors.std(ddof=1)) if errors.size > 1 else None
    return errors.size, float(errors.mean()) if errors.size else None, sd


def compute_force_range(
    response: SiteResponse, parameters: Array, most_probable: Array
) -> tuple[Array, Array]:
    """Return the lower and the higher (n,) of the force at the parameters (p,), and of that at the most
    probable ones (p,), linearised."""
    other = response.force_N + response.jacobian @ (parameters * np.log(most_probable / parameters))
    return np.minimum(response.force_N, other), np.maximum(response.force_N, other)


def change_by_factor(value: Values, change: Values) -> Array:
    """Return positive values after a ``change`` to first order, by which alone they could become negative:
    moduli fall by factors, and so do they."""
    size = np.maximum(value, np.finfo(float).tiny)
    return np.asarray(value * np.exp(np.minimum(change, 0.0) / size) + np.maximum(change, 0.0))


def widen_by_relaxation(
    value: Values, ends: tuple[Values, Values], half: Values, moved: Values, sd: Values, fall: Values
) -> tuple[Array, Array]:
    """Return the ends of the 95 % interval of positive values that relaxation beyond the records changes.

    Before that it is ``half`` wider than ``ends`` on either side. To first order relaxation moves the values
    by ``moved``, with a standard deviation ``sd``, and beside that they may be lower by anything up to
    ``fall`` (higher, where it is negative). Values fall by factors, with all that is uncertain of them.
    """
    size = np.maximum(value, np.finfo(float).tiny)
    low = change_by_factor(value, moved - np.maximum(fall, 0.0))
    high = change_by_factor(value, moved - np.minimum(fall, 0.0))
    less, more = np.minimum(low / size, 1.0), np.minimum(high / size, 1.0)
    down = np.hypot(less * half, low * np.expm1(-NORMAL_95 * sd / size))
    up = np.hypot(more * half, NORMAL_95 * sd)
    return low - less * (value - ends[0]) - down, high + more * (ends[1] - value) + up


@dataclass(frozen=True)
class RelaxationSpread:
    """What other relaxations that fit the records say of the parameters ``durations_s`` (d,) after a step.

    Forces then follow from the moduli at that time, with the logarithms' mean ``shift_log`` (d, p) over those
    of the answer and the covariance ``own_weight`` times that of the answer plus ``covariance_log``
    (d, p, p). ``longest_s`` is the longest load in the records. Later, logarithms may be lower by
    anything up to ``fall_log`` (d, p): a bound and no distribution, so that intervals hold for every fall.
    """

    longest_s: float
    own_weight: float
    durations_s: Array
    shift_log: Array
    covariance_log: Array
    fall_log: Array

    def interpolate(self, duration_s: float) -> tuple[Array, Array, Array]:
        """Return shift (p,), covariance (p, p) and fall (p,) at a duration, linear in its logarithm.

        They go on so beyond the last duration, as a power of time falls.
        """
        logs = np.log(self.durations_s)
        i = int(np.clip(np.searchsorted(logs, np.log(duration_s)) - 1, 0, len(logs) - 2))
        at = max((np.log(duration_s) - logs[i]) / (logs[i + 1] - logs[i]), 0.0)
        weights = np.array([1.0 - at, at])
        shift, fall = weights @ self.shift_log[i : i + 2], weights @ self.fall_log[i : i + 2]
        return shift, np.tensordot(weights, self.covariance_log[i : i + 2], 1), fall

    def widen_band(
        self, force_N: Array, slopes: Array, times_s: Array, ends: tuple[Array, Array], half: Array
    ) -> tuple[Array, Array]:
        """Return the ends of a band that is ``half`` (n,) wider than ``ends`` on either side, and beyond the
        records' longest load as wide as relaxation asks.

        ``slopes`` (n, p) of ``force_N`` (n,) are by the logarithms of the parameters.
        """
        low, high = ends[0] - half, ends[1] + half
        for i in np.flatnonzero(times_s > self.longest_s):
            shift_log, covariance, fall_log = self.interpolate(float(times_s[i]))
            moved, sd = slopes[i] @ shift_log, np.sqrt(slopes[i] @ covariance @ slopes[i])
            own, fall = (ends[0][i], ends[1][i]), slopes[i] @ fall_log
            lower, higher = widen_by_relaxation(force_N[i], own, half[i], moved, sd, fall)
            low[i], high[i] = min(low[i], lower), max(high[i], higher)
        return low, high

    @classmethod
    def from_stored(cls, stored: RelaxationBeyond) -> RelaxationSpread:
        """Build it from what ``calibration.json`` holds."""
        parts = (stored.durations_s, stored.shift_log, stored.covariance_log, stored.fall_log)
        return cls(stored.longest_s, stored.own_weight, *map(np.array, parts))


@dataclass(frozen=True)
class PredictionModel:
    """What a prediction interval needs of a stored uncertainty.

    ``sites`` holds noise and misfit of the fitted records, and ``known_scale`` the number of independent
    residuals from which the size of the misfit is known. ``site_factor`` is the deviation of whole sites over
    the expected one, known with ``site_freedom`` degrees of freedom. ``most_probable`` (p,) are the most
    probable parameters, which may differ from those of least error. ``relaxation`` is what is added beyond
    the longest load in the records.
    """

    covariance_log: Array
    most_probable: Array
    sites: Mapping[str, RecordResiduals]
    misfit_elsewhere: float
    known_scale: float
    site_factor: float = 1.0
    site_freedom: float = MAX_FREEDOM
    relaxation: RelaxationSpread | None = None

    @classmethod
    def from_stored(cls, uncertainty: CalibrationUncertainty) -> PredictionModel:
        """Build the model from the part ``uncertainty`` of ``calibration.json``."""
        residuals, relaxation = uncertainty.residuals, uncertainty.relaxation
        return cls(
            np.array(uncertainty.covariance_log),
            np.array([value for one in uncertainty.most_probable.values() for value in one.values()]),
            residuals.sites,
            residuals.misfit_elsewhere,
            residuals.known_scale,
            residuals.site_factor or 1.0,
            residuals.site_freedom or MAX_FREEDOM,
            None if relaxation is None else RelaxationSpread.from_stored(relaxation.beyond),
        )

    def find_residual_sd(self, site: str, unit: str = "N", noise_N: float = 0.0) -> tuple[float, float]:
        """Return the noise (N) and the misfit (over the largest force) of a record.

        A record that was not fitted has its own noise ``noise_N``, where that is known, else the median of
        the others of its unit, and the misfit that is expected elsewhere.
        """
        if site in self.sites:
            return self.sites[site].compared_noise_sd_N, self.sites[site].misfit_share
        noise = [found.compared_noise_sd_N for found in self.sites.values() if found.unit == unit]
        return noise_N or (float(np.median(noise)) if noise else 0.0), self.misfit_elsewhere

    def find_mesh_error(self, site: str, force_N: Array) -> Array:
        """Return one standard deviation (n,) in N of what the mesh lacks of a record's ``force_N`` (n,).

        Where no other mesh was simulated it is as large, over the largest force, as the median of the fitted
        records', and goes with the force.
        """
        if site in self.sites and (stored := self.sites[site].mesh_N):
            return np.array(stored)
        shares = [one.mesh_share or 0.0 for one in self.sites.values()]
        share = float(np.median(shares)) if shares and site not in self.sites else 0.0
        size = max(float(np.sqrt(np.mean(force_N**2))), np.finfo(float).tiny)
        return np.asarray(share * find_largest_magnitude(force_N) * force_N / size)

    def compute_interval_95(
        self,
        response: SiteResponse,
        parameters: Array,
        name: str,
        unit: str = "N",
        site_N: Array | float = 0.0,
        times_s: Array | None = None,
        noise_N: float = 0.0,
    ) -> tuple[Array, Array]:
        """Return the 95 % interval of a new record, two arrays (n,) in N.

        It counts the uncertainty of the parameters, misfit and noise. The interval covers ``response``,
        simulated at the ``parameters`` (p,), and its linearised value at the most probable parameters. It is
        in mm for a record that compares depths (``unit``). The misfit is known from few residuals only, and
        the spread between sites from few sites, so the interval takes Student's quantile. ``site_N`` (n,) is
        one standard deviation of the stiffness that is expected of a site that was not fitted. Beyond the
        longest load in the records, by ``times_s`` (n,), the interval counts what relaxation may do there.
        ``noise_N`` is the noise of a record that was not fitted, where it is known.
        """
        known_N, misfit = self.find_residual_sd(name, unit, noise_N)
        misfit_N = misfit * find_largest_magnitude(response.force_N)
        site_N = self.site_factor * np.abs(site_N)
        slopes, estimated = response.jacobian * parameters, (misfit_N**2, site_N**2)
        variance = np.einsum("ni,ij,nj->n", slopes, self.covariance_log, slopes) + known_N**2 + sum(estimated)
        half = compute_half_width_95(variance, *estimated, self.known_scale, self.site_freedom)
        ends = compute_force_range(response, parameters, self.most_probable)
        if self.relaxation is None or times_s is None:
            return ends[0] - half, ends[1] + half
        return self.relaxation.widen_band(response.force_N, slopes, times_s, ends, half)
