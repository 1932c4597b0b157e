"""The likelihood of parameters, given the records, with profiles and evidence.

The residuals have the covariance of ``discrepancy``. The size of the misfit is not known exactly, so a factor
on all misfits remains an unknown of its own; it is 1 where the misfit was estimated.

The profile says how well the records can be fitted with one parameter fixed and all others free. It needs no
prior and no linearisation (Raue et al. 2009). A parameter whose profile stays below the threshold up to its
bound is not determined on that side, whatever a covariance says.

Models, such as one material or several, are compared by their evidence on one likelihood and by their errors
at held-out sites. The residuals are so alike that ten or so independent ones are left, too few for criteria
that count samples (AIC, corrected or not; BIC). The evidence counts none: it is the likelihood's mean over
the bounds, by Laplace's method (MacKay 2003, section 28). A parameter that the records do not tell costs
nothing there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.special import ndtr, softmax, stdtr, stdtrit

from ...arrays import Array
from ...results.uncertainty import EvidenceComparison, ModelEvidence, ProfileCheck
from ..fit.objective import MeasuredCurve, SiteResponse
from ..fit.parameters import SearchSpace, Unknowns
from ..fit.prediction import MAX_FREEDOM
from ..fit.trust_region import SearchPoint, minimise
from .discrepancy import ResidualModel, Spectrum
from .emulator import Emulator
from .uncertainty import PriorPrecision

_MAX_ITERATIONS = 60
_TOLERANCE = 1e-5
MISFIT_FACTOR_BOUNDS = (0.2, 5.0)  # of the misfit
_MIN_MISFIT = 1e-7  # over the largest force: much less than any noise
_FIRST_STEP, _STEP_GROWTH, _MAX_STEPS = 0.5, 1.5, 25  # in standard deviations
# Differences of minus twice the log of the evidence (Kass and Raftery 1995)
_CLEAR_DIFFERENCE, _STRONG_DIFFERENCE = 2.0, 10.0


@dataclass(frozen=True)
class Optimum:
    """The most probable z (k,) of a space: ``parameters`` (p,), ``minus_2_log`` of the likelihood there."""

    z: Array
    parameters: Array
    minus_2_log: float


class Likelihood:
    """The likelihood of the records over a search space, with the emulator in place of the solver.

    The coordinates ``z`` (k,) are those of ``space``. Stated priors of ``unknowns`` count as data; bounds
    hold. Where ``counts_emulator``, the emulator's expected error counts as misfit that grows away from the
    simulated points (Kennedy and O'Hagan 2001).
    """

    def __init__(
        self,
        emulator: Emulator,
        measured: Sequence[MeasuredCurve],
        model: ResidualModel,
        unknowns: Unknowns,
        space: SearchSpace,
        counts_emulator: bool = False,
    ) -> None:
        if counts_emulator:  # an expected error has the shape of misfit, which none would not have
            model = replace(model, misfit=np.maximum(model.misfit, _MIN_MISFIT))
        self.emulator, self.measured, self.model = emulator, tuple(measured), model
        self.unknowns, self.space, self.counts_emulator = unknowns, space, counts_emulator
        self._prior = PriorPrecision.from_unknowns(unknowns, space)
        self._spectrum = Spectrum(model)
        self._shared = self._spectrum.transform(np.concatenate(model.shared_deviations))
        self._target = self._spectrum.transform(np.concatenate([site.force_N for site in measured]))

    @property
    def has_misfit(self) -> bool:
        """True if the size of the misfit makes a difference."""
        return bool(self._spectrum.values.max(initial=0.0) > 1e-6)

    def to_parameters(self, z: Array) -> Array:
        """Return the full parameters (..., p) at z (..., k)."""
        return np.exp(self.space.to_logarithms(z))

    def compute_minus_2_log(self, z: Array, factor: Array | float = 1.0) -> Array:
        """Return minus twice the log-likelihood (m,) at z (m, k), with the misfit ``factor`` (m,) times as
        large.

        It is infinite outside the bounds.
        """
        z = np.atleast_2d(z)
        parameters = self.to_parameters(z)
        squares = np.atleast_1d(factor)[:, None] ** 2
        if self.counts_emulator:
            forces, sd_N = self.emulator.predict_forces_and_sd(parameters)
            shares = sd_N / (self.model.misfit * self.model.peaks_N)
        else:
            forces, shares = self.emulator.predict_forces(parameters), np.zeros((1, len(self.measured)))
        with np.errstate(over="ignore", invalid="ignore"):  # far from all runs: not finite, so infinite
            found = self._compute_minus_2_log(z, forces, squares + shares[:, self._spectrum.record] ** 2)
        outside = np.any((z < self.space.lower - 1e-9) | (z > self.space.upper + 1e-9), axis=1)
        return np.where(outside | ~np.isfinite(found), np.inf, found)

    def minus_2_log_of(self, responses: Sequence[SiteResponse], parameters: Array) -> float:
        """Return the same for forces of the solver, to check the emulator."""
        forces = np.concatenate([response.force_N for response in responses])
        z = self.space.reduce(np.log(parameters))
        return float(self._compute_minus_2_log(z[None], forces[None], np.ones((1, 1)))[0])

    def _compute_minus_2_log(self, z: Array, forces: Array, squares: Array) -> Array:
        """Return minus twice the log-likelihood (m,) of forces (m, N) at z (m, k).

        The variance of the misfit is ``squares`` (m, N) times the model's. What records share is integrated
        out (Woodbury).
        """
        residual = self._spectrum.transform(forces.T).T - self._target
        variances = 1.0 + squares * self._spectrum.values
        deviations = z @ self._prior.rows.T - self._prior.target
        E = self._shared
        amount = (residual / variances) @ E
        inner = np.eye(E.shape[1]) + np.einsum("ni,mn,nj->mij", E, 1.0 / variances, E, optimize=True)
        explained = np.einsum("mi,mi->m", amount, np.linalg.solve(inner, amount[..., None])[..., 0])
        log_determinant = np.log(variances).sum(axis=1) + np.linalg.slogdet(inner)[1]
        constant = self._spectrum.log_determinant + residual.shape[1] * np.log(2 * np.pi)
        distance = np.sum(residual**2 / variances, axis=1) + np.sum(deviations**2, axis=1)
        return np.asarray(distance - explained + log_determinant + constant)

    def linearise(self, z: Array, factor: float = 1.0) -> SearchPoint | None:
        """Return residuals of unit variance and their derivatives at z (k,), for least squares."""
        parameters = self.to_parameters(z)
        responses = self.emulator(parameters)
        forces = np.concatenate([response.force_N for response in responses])
        slopes = np.concatenate([self.space.pull_back(r.jacobian, parameters) for r in responses])
        if not (np.isfinite(forces).all() and np.isfinite(slopes).all()):
            return None
        sd = np.sqrt(1.0 + factor**2 * self._spectrum.values)[:, None]
        axes, sizes, _ = np.linalg.svd(self._shared / sd, full_matrices=False)
        shrunk = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)  # of what records share: (I + F F')^(-1/2)
        residual = self._spectrum.transform(forces) - self._target
        rows = np.column_stack([residual, self._spectrum.transform(slopes)]) / sd
        rows -= (axes * shrunk) @ (axes.T @ rows)
        priors = np.column_stack([self._prior.compute_deviations(z), self._prior.rows])
        both = np.concatenate([rows, priors])
        return SearchPoint(z, both[:, 0], both[:, 1:])

    def find_optimum(self, start: Array, fixed_entry: int = -1, factor: float = 1.0) -> Optimum:
        """Find the most probable z from ``start`` (k,); an entry ``fixed_entry`` stays as it is."""
        free = np.arange(len(start)) != fixed_entry

        def evaluate(part: Array) -> SearchPoint | None:
            z = start.copy()
            z[free] = part
            point = self.linearise(z, factor)
            return point and SearchPoint(part, point.residual, point.jacobian[:, free])

        z = start.copy()
        first = evaluate(start[free])
        if first is not None and free.any():
            lower, upper = self.space.lower[free], self.space.upper[free]
            steps = minimise(
                evaluate, first, lower, upper, tolerance=_TOLERANCE, max_iterations=_MAX_ITERATIONS
            )
            for step in steps:
                z[free] = step.point.z
        return Optimum(z, self.to_parameters(z), float(self.compute_minus_2_log(z, factor)[0]))

    def find_best(self, starts: Sequence[Array]) -> Optimum:
        """Return the most probable of the optima from several full parameters (p,)."""
        found = [self.find_optimum(self.space.reduce(np.log(start))) for start in starts]
        return min(found, key=lambda one: one.minus_2_log)

    def compute_covariance(self, z: Array, factor: float = 1.0) -> Array:
        """Return the linearised covariance (k, k) at z (k,), the misfit ``factor`` times as large.

        The bounds keep it finite.
        """
        point = self.linearise(z, factor)
        assert point is not None
        precision = point.jacobian.T @ point.jacobian + self._prior.bound_precision
        return np.asarray(np.linalg.inv(precision), dtype=np.float64)


@dataclass(frozen=True)
class Profile:
    """The profile of one coordinate: ``values`` (n,) of the parameter in rising order, and ``rise`` (n,).

    ``rise`` is that of minus twice the log-likelihood over its least value. ``interval_95`` ends where it
    crosses ``threshold``, or at a bound if ``closed`` (low, high) is False. ``ends`` are the full parameters
    (2, p) there. ``extrapolated`` (n,) and ``ends_extrapolated`` say where the emulator is asked outside its
    runs.
    """

    name: str
    values: Array
    rise: Array
    threshold: float
    interval_95: tuple[float, float]
    closed: tuple[bool, bool]
    ends: Array
    extrapolated: NDArray[np.bool_]
    ends_extrapolated: tuple[bool, bool]

    @property
    def verdict(self) -> str:
        return ("not determined", "determined on one side", "determined on both sides")[sum(self.closed)]


def compute_profile(
    likelihood: Likelihood, best: Optimum, k: int, sd: float, freedom: float = MAX_FREEDOM
) -> Profile:
    """Compute the profile of coordinate k from the optimum outwards.

    ``sd``: a guess of the coordinate's standard deviation, for the steps. ``freedom``: degrees of freedom of
    the misfit's size. The threshold is the square of Student's 97.5 % quantile, 3.84 for many.
    """
    threshold = float(stdtrit(freedom, 0.975) ** 2)
    sides = [_walk_side(likelihood, best, k, sign * sd, threshold) for sign in (-1.0, 1.0)]
    (left, low, low_closed), (right, high, high_closed) = sides
    track = [*reversed(left), best, *right]
    least = min(point.minus_2_log for point in track)
    extrapolated = [not likelihood.emulator.is_inside(one.parameters, 0.0) for one in [*track, low, high]]
    return Profile(
        name=likelihood.unknowns.names[int(np.flatnonzero(likelihood.space.tie[:, k])[0])],
        values=np.exp([point.z[k] for point in track]),
        rise=np.array([point.minus_2_log - least for point in track]),
        threshold=threshold,
        interval_95=(float(np.exp(low.z[k])), float(np.exp(high.z[k]))),
        closed=(low_closed, high_closed),
        ends=np.stack([low.parameters, high.parameters]),
        extrapolated=np.array(extrapolated[:-2]),
        ends_extrapolated=(extrapolated[-2], extrapolated[-1]),
    )


def _walk_side(
    likelihood: Likelihood, best: Optimum, k: int, step: float, threshold: float
) -> tuple[list[Optimum], Optimum, bool]:
    """Return the points on one side, the end of the interval, and True if it crossed the threshold."""
    lower, upper = likelihood.space.lower[k], likelihood.space.upper[k]
    track, at, length = [], best, _FIRST_STEP * step

    def optimise(near: Optimum, value: float) -> Optimum:
        start = near.z.copy()
        start[k] = value
        return likelihood.find_optimum(start, fixed_entry=k)

    for _ in range(_MAX_STEPS):
        value = float(np.clip(at.z[k] + length, lower, upper))
        track.append(optimise(at, value))
        if track[-1].minus_2_log - best.minus_2_log > threshold:
            level = best.minus_2_log + threshold
            return track, _find_crossing(partial(optimise, at), at, track[-1], k, level), True
        at, length = track[-1], length * _STEP_GROWTH
        if value in (lower, upper):
            break
    return track, at, False


def _find_crossing(
    optimise: Callable[[float], Optimum], inner: Optimum, outer: Optimum, k: int, level: float
) -> Optimum:
    """Find the point between two at which minus twice the log-likelihood is ``level``."""
    if inner.minus_2_log >= level:
        return inner
    found = cache(optimise)
    a, b = float(inner.z[k]), float(outer.z[k])
    if found(b).minus_2_log <= level:  # reached from elsewhere it was higher: the better of the two counts
        return found(b)
    return found(float(brentq(lambda value: found(value).minus_2_log - level, a, b, xtol=1e-3 * abs(b - a))))


def check_profile_ends(
    likelihood: Likelihood,
    best: Optimum,
    best_responses: Sequence[SiteResponse],
    profile: Profile,
    responses: Sequence[Sequence[SiteResponse]],
    why: str = "",
) -> ProfileCheck:
    """Compare a profile's two ends with ``responses`` of the solver there and at the optimum."""
    reference = likelihood.minus_2_log_of(best_responses, best.parameters)
    low, high = (
        likelihood.minus_2_log_of(run, end) - reference if all(one.completed for one in run) else None
        for run, end in zip(responses, profile.ends, strict=True)
    )
    z = np.array([likelihood.space.reduce(np.log(end)) for end in profile.ends])
    return ProfileCheck(
        name=profile.name,
        why=why,
        emulated=(likelihood.compute_minus_2_log(z) - best.minus_2_log).tolist(),
        solved=(low, high),
        extrapolated=profile.ends_extrapolated,
    )


def fit_alternative(name: str, likelihood: Likelihood, start: Array) -> tuple[ModelEvidence, Optimum]:
    """Fit a model in the likelihood's space from ``start`` (k,), the size of the misfit included."""
    at = likelihood.find_optimum(start)
    factor = 1.0
    for _ in range(3 if likelihood.has_misfit else 0):  # alternate: the two hardly depend on each other
        found = minimize_scalar(
            lambda log, z=at.z: float(likelihood.compute_minus_2_log(z, np.exp(log))[0]),
            bounds=tuple(np.log(MISFIT_FACTOR_BOUNDS)),
            method="bounded",
        )
        factor = float(np.exp(found.x))
        at = likelihood.find_optimum(at.z, factor=factor)
    width = likelihood.space.upper - likelihood.space.lower
    spread = np.linalg.slogdet(2 * np.pi * likelihood.compute_covariance(at.z, factor))[1]
    return (
        ModelEvidence(
            name=name,
            parameters=len(start) + int(likelihood.has_misfit),
            minus_2_log=at.minus_2_log,
            effective_samples=likelihood.model.effective_samples(),
            misfit_factor=factor,
            # It depends on the bounds: twice the width costs a parameter that the records tell 1.4 more.
            minus_2_log_evidence=at.minus_2_log - float(spread) + 2 * float(np.log(width).sum()),
        ),
        at,
    )


def weigh_models(minus_2_log_evidence: Sequence[float]) -> Array:
    """Return the probability (m,) of each model, alike before the records were seen."""
    return np.asarray(softmax(-0.5 * np.asarray(minus_2_log_evidence, dtype=float)))


def compute_mixture_interval(means: Array, sds: Array, weights: Array) -> tuple[Array, Array]:
    """Return both ends (n,) of the 95 % interval of a mixture of normal distributions.

    ``means``, ``sds``: (m, n) of each model at n points. ``weights``: (m,) of the models; their sum is 1.
    """
    kept = weights > 0
    means, sds, weights = means[kept], np.maximum(sds[kept], np.finfo(float).tiny), weights[kept]

    def find_quantile(share: float) -> Array:
        low, high = (means - 10 * sds).min(axis=0), (means + 10 * sds).max(axis=0)
        for _ in range(60):  # bisection
            middle = (low + high) / 2
            below = weights @ ndtr((middle - means) / sds) < share
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray((low + high) / 2)

    return find_quantile(0.025), find_quantile(0.975)


def compare_models(
    first: ModelEvidence,
    second: ModelEvidence,
    errors_first: Sequence[float] = (),
    errors_second: Sequence[float] = (),
) -> EvidenceComparison:
    """Compare two models by the records; the errors in percent are those at the same held-out sites.

    ``heldout`` of what is returned has the mean error of each, the mean difference (first minus second), its
    standard error, and the probability of so large a difference by chance (paired t-test).
    """
    heldout = _compare_held_out(np.asarray(errors_first, float), np.asarray(errors_second, float))
    rise = first.minus_2_log_evidence - second.minus_2_log_evidence
    # 1: the second model, -1: the first, 0: neither
    names = {1: second.name, -1: first.name, 0: ""}
    fitted = 0 if abs(rise) < _CLEAR_DIFFERENCE else int(np.sign(rise))
    unseen = int(np.sign(heldout["difference_percent"])) if heldout.get("p_value", 1.0) < 0.05 else 0
    better = names[int(np.sign(fitted + unseen))]
    by_fit = f"the fitted records do not distinguish {first.name} from {second.name}"
    if fitted:
        strength = "strongly" if abs(rise) > _STRONG_DIFFERENCE else "moderately"
        by_fit = f"the fitted records support {names[fitted]} {strength}"
    by_test = "no site was held out"
    if heldout:
        predicts = f"{names[unseen]} predict better" if unseen else "both predict alike"
        by_test = f"at {heldout['sites']:.0f} held-out sites {predicts}"
    numbers = f"twice the log of the evidence {rise:+.1f} against {first.name}"
    end = f"better supported: {better}" if better else "neither is better supported"
    verdict = f"{by_fit} ({numbers}); {by_test}; {end}"
    return EvidenceComparison(first=first, second=second, heldout=heldout, better=better, verdict=verdict)


def _compare_held_out(errors_first: Array, errors_second: Array) -> dict[str, float]:
    if not errors_first.size:
        return {}
    sites, difference = errors_first.size, errors_first - errors_second
    found = {
        "sites": float(sites),
        "first_percent": float(errors_first.mean()),
        "second_percent": float(errors_second.mean()),
        "difference_percent": float(difference.mean()),
    }
    if sites > 1 and difference.std() > 0:
        error = float(difference.std(ddof=1) / np.sqrt(sites))
        found["standard_error_percent"] = error
        found["p_value"] = float(2 * stdtr(sites - 1, -abs(difference.mean()) / error))
    return found
