"""Cross-validation: a fit to some of the sites is judged at the others.

A choice of k sites out of n is one of many, and its held-out error is one draw of a distribution. Here every
choice, or a sample of them, is fitted and predicts the sites that it did not see; so is every choice that
leaves a region out. It takes thousands of fits, so ``simulate`` is meant to be an emulator that was checked
against the solver; the region in which it is valid enters as the bounds of ``unknowns``.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from ...results.identification import average_records
from ...results.uncertainty import FoldFit
from ..fit.calibration import CalibrationSettings, calibrate
from ..fit.objective import MeasuredCurve, Simulate, SiteResponse
from ..fit.parameters import FIXED, Grouping, SearchSpace, Unknowns, group_separately
from ..fit.prediction import compute_error_percent, compute_errors_percent, summarise_errors
from ..uncertainty.uncertainty import reduce_covariance

Choice = tuple[int, ...]
SiteErrors = dict[str, float | None]  # percent; None where a simulation did not reach the record's end

_MAX_LISTED_CHOICES = 20_000  # choices that are listed before some are drawn
_CANDIDATES = 600
# Least and largest standard deviations of log(parameters) by which fits scatter along the covariance's axes.
_MIN_SD_LOG, _MAX_SD_LOG = 0.08, 0.45
_WIDENING = 2.0  # than the fit's own covariance: fewer records, or others, tell less


@dataclass(frozen=True)
class Fold:
    """One fit: ``fitted`` are indices of sites; ``errors_percent`` are those of all sites, in order.

    ``at_limit`` names the parameters that ended on a bound, and ``label`` a region that was left out.
    """

    fitted: Choice
    parameters: Array
    errors_percent: tuple[float, ...]
    converged: bool
    at_limit: tuple[str, ...]
    label: str = ""

    @property
    def heldout(self) -> Choice:
        return tuple(i for i in range(len(self.errors_percent)) if i not in self.fitted)

    @property
    def mean_heldout(self) -> float:
        errors = [self.errors_percent[i] for i in self.heldout]
        return float(np.mean(errors)) if errors else float("nan")

    def summarise(self, sites: Sequence[str], names: Sequence[str]) -> FoldFit:
        """Return what is stored, by the names of sites and parameters."""
        return FoldFit(
            label=self.label,
            fitted=[sites[i] for i in self.fitted],
            parameters=dict(zip(names, self.parameters.tolist(), strict=True)),
            errors_percent=dict(zip(sites, self.errors_percent, strict=True)),
            mean_error_fitted_percent=float(np.mean([self.errors_percent[i] for i in self.fitted])),
            mean_error_heldout_percent=self.mean_heldout if self.heldout else None,
            converged=self.converged,
            at_limit=self.at_limit,
        )


def list_choices(sites: int, size: int, most: int | None = None, seed: int = 0) -> list[Choice]:
    """List every choice of ``size`` out of ``sites`` sites, in order, or ``most`` of them drawn without
    repeats.

    Raises `CalibrationError` if no site would be left to be predicted.
    """
    if not 0 < size < sites:
        raise CalibrationError(f"{size} of {sites} sites fitted leave none to be predicted")
    number = comb(sites, size)
    if most is None or most >= number:
        return list(combinations(range(sites), size))
    rng = np.random.default_rng(seed)
    if number <= _MAX_LISTED_CHOICES:
        every = list(combinations(range(sites), size))
        return [every[i] for i in np.sort(rng.choice(number, most, replace=False))]
    drawn: set[Choice] = set()
    while len(drawn) < most:
        drawn.add(tuple(sorted(int(i) for i in rng.choice(sites, size, replace=False))))
    return sorted(drawn)


def expand_to_records(choice: Choice, groups: Sequence[Choice]) -> Choice:
    """Return the records of a choice of sites; ``groups`` are the records of each site."""
    return tuple(record for site in choice for record in groups[site])


def average_by_site(fold: Fold, choice: Choice, groups: Sequence[Choice]) -> Fold:
    """Turn a fold over records into one over sites, whose errors are the means of each site's records."""
    errors = tuple(float(np.mean([fold.errors_percent[i] for i in group])) for group in groups)
    return replace(fold, fitted=choice, errors_percent=errors)


def list_choices_without_regions(regions: Sequence[str]) -> dict[str, Choice]:
    """Return for each region the sites of all others; nothing if fewer than two regions have a name."""
    named = [region for region in dict.fromkeys(regions) if region]
    if len(named) < 2:
        return {}
    return {name: tuple(i for i, region in enumerate(regions) if region != name) for name in named}


def fit_sites(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    chosen: Choice,
    settings: CalibrationSettings | None = None,
    grouping: Grouping | None = None,
) -> Fold:
    """Fit the ``chosen`` sites, and predict all of them.

    ``simulate``: returns all sites of ``measured``, in order. ``unknowns``: start at the study's own answer.
    ``grouping``: parameters that move together, as in the study's last stage; by default each by itself.
    """

    def simulate_chosen(parameters: Array) -> list[SiteResponse]:
        responses = simulate(parameters)
        return [responses[i] for i in chosen]

    found = calibrate(
        simulate_chosen,
        [measured[i] for i in chosen],
        unknowns,
        settings,
        stages=(grouping or group_separately(unknowns.names),),
    )
    errors = compute_errors_percent(simulate(found.parameters), measured)
    is_stuck = unknowns.is_at_bound(found.parameters) & (np.array(found.stages[-1].grouping) != FIXED)
    at_limit = tuple(name for name, stuck in zip(unknowns.names, is_stuck) if stuck)
    return Fold(chosen, found.parameters, errors, found.converged, at_limit)


def cross_validate(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    choices: Sequence[Choice],
    settings: CalibrationSettings | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    grouping: Grouping | None = None,
) -> tuple[Fold, ...]:
    """Fit every choice and predict the other sites."""
    folds = []
    for i, choice in enumerate(choices):
        folds.append(fit_sites(simulate, measured, unknowns, choice, settings, grouping))
        progress(i + 1, len(choices))
    return tuple(folds)


def rank_fold(ranked: Fold, folds: Sequence[Fold]) -> dict[str, float | None]:
    """Rank the mean held-out error of a fold in the distribution over ``folds`` (5, 50 and 95 %).

    Returns the keys of `OwnFold`: ``share_better`` of the folds have a smaller error; None where the fold
    holds no site out.
    """
    means = np.array([fold.mean_heldout for fold in folds])
    low, middle, high = np.percentile(means, [5, 50, 95]).tolist()
    # Ties, itself above all, count half.
    ties = np.abs(means - ranked.mean_heldout) <= 1e-9
    better = float(np.mean(means < ranked.mean_heldout - 1e-9) + 0.5 * np.mean(ties))
    share = better if ranked.heldout else None
    return {
        "share_better": share, "median_percent": middle, "low_percent": low, "high_percent": high
    }  # fmt: skip


def summarise_errors_by_site(
    folds: Sequence[Fold], sites: int
) -> list[tuple[int, float | None, float | None]]:
    """Summarise the errors of each site over the folds that did not fit it."""
    errors = [[fold.errors_percent[i] for fold in folds if i not in fold.fitted] for i in range(sites)]
    return [summarise_errors(of_site) for of_site in errors]


def compute_site_errors(
    simulate: Simulate, parameters: Array, measured: Sequence[MeasuredCurve]
) -> SiteErrors:
    """Return the force error of each site in percent; None if its simulation is not complete."""
    return {
        site.name: compute_error_percent(response.force_N, site.force_N) if response.completed else None
        for response, site in zip(simulate(parameters), measured, strict=True)
    }


def average_errors(
    errors_percent: Mapping[str, float | None], sites: Mapping[str, str] | None = None
) -> float | None:
    """Return the mean over the sites that have an error, of their records' means; None if none has.

    ``sites`` of the records, by name; by default a record is a site of its own.
    """
    known = average_records(((sites or {}).get(name, name), one) for name, one in errors_percent.items())
    return float(np.mean(known)) if known else None


def spread_points(centre: Array, covariance_log: Array, space: SearchSpace, count: int, seed: int) -> Array:
    """Spread ``count`` points (count, p) around a fit's answer, far from one another and inside the bounds.

    An emulator learns there what fits to other records, which move in the same ``space``, will ask of it.

    ``centre``: (p,) the answer. ``covariance_log``: (p, p) of the logarithms of the parameters.
    """
    rng, middle = np.random.default_rng(seed), space.reduce(np.log(centre))
    values, axes = np.linalg.eigh(reduce_covariance(covariance_log, space))
    sd = np.clip(_WIDENING * np.sqrt(np.maximum(values, 0.0)), _MIN_SD_LOG, _MAX_SD_LOG)
    unit = rng.standard_normal((_CANDIDATES, len(middle)))
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True) / np.sqrt(len(middle)), 1.0)
    found: list[int] = []
    distance = np.linalg.norm(unit, axis=1)  # to the answer, which is simulated too
    for _ in range(count):
        found.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(unit - unit[found[-1]], axis=1))
    return space.expand(np.clip(middle + (unit[found] * sd) @ axes.T, space.lower, space.upper))
