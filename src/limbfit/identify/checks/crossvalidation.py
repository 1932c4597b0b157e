"""Cross-validation: fitted on some of the sites, judged at the others.

A choice of k sites out of n is one of many, and its held-out error one draw of a distribution. Here every
choice, or a sample of them, is fitted and predicts the sites that it did not see; so is every choice that
leaves a region out. There are thousands of fits in it, so ``simulate`` is meant to be an emulator that was
checked against the solver; its region of validity comes as the bounds of ``unknowns``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CalibrationError
from ..fit.calibration import calibrate
from ..fit.objective import Measured, Simulate, SiteResponse
from ..fit.parameters import Unknowns, separate
from ..fit.prediction import Summary, error_percent, summarise
from ..fit.state import CalibrationSettings

Array = NDArray[np.float64]
Choice = tuple[int, ...]

_EDGE = 1e-3  # of the logarithm: this close to a bound is on it
_ALL = 20_000  # choices that are listed before some are drawn


@dataclass(frozen=True)
class Fold:
    """One fit: ``fitted`` are indices of sites; ``errors_percent`` are those of all sites, in order.

    ``at_limit`` names the parameters that ended on a bound.
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
    def heldout_errors(self) -> tuple[float, ...]:
        return tuple(self.errors_percent[i] for i in self.heldout)

    @property
    def mean_heldout(self) -> float:
        return float(np.mean(self.heldout_errors)) if self.heldout else float("nan")

    @property
    def mean_fitted(self) -> float:
        return float(np.mean([self.errors_percent[i] for i in self.fitted]))

    def to_dict(self, sites: Sequence[str], names: Sequence[str]) -> dict[str, Any]:
        """JSON-like values."""
        return {
            "label": self.label,
            "fitted": [sites[i] for i in self.fitted],
            "parameters": dict(zip(names, self.parameters.tolist(), strict=True)),
            "errors_percent": dict(zip(sites, self.errors_percent, strict=True)),
            "mean_error_fitted_percent": self.mean_fitted,
            "mean_error_heldout_percent": self.mean_heldout if self.heldout else None,
            "converged": self.converged,
            "at_limit": list(self.at_limit),
        }


def choices_of(sites: int, size: int, most: int | None = None, seed: int = 0) -> list[Choice]:
    """Every choice of ``size`` out of ``sites`` sites, in order, or ``most`` of them drawn without repeats.

    Raises
    ------
    CalibrationError
        Where no site would be left to be predicted.
    """
    if not 0 < size < sites:
        raise CalibrationError(f"{size} of {sites} sites fitted leave none to be predicted")
    number = comb(sites, size)
    if most is None or most >= number:
        return list(combinations(range(sites), size))
    rng = np.random.default_rng(seed)
    if number <= _ALL:
        every = list(combinations(range(sites), size))
        return [every[i] for i in np.sort(rng.choice(number, most, replace=False))]
    drawn: set[Choice] = set()
    while len(drawn) < most:
        drawn.add(tuple(sorted(int(i) for i in rng.choice(sites, size, replace=False))))
    return sorted(drawn)


def expanded(choice: Choice, groups: Sequence[Choice]) -> Choice:
    """The records of a choice of sites; ``groups`` are the records of each site."""
    return tuple(record for site in choice for record in groups[site])


def by_site(fold: Fold, choice: Choice, groups: Sequence[Choice]) -> Fold:
    """A fit to the records of a choice of sites as one to them: an error is the mean of a site's records."""
    errors = tuple(float(np.mean([fold.errors_percent[i] for i in group])) for group in groups)
    return replace(fold, fitted=choice, errors_percent=errors)


def without_regions(regions: Sequence[str]) -> dict[str, Choice]:
    """For each region the sites of all others; none where there are fewer than two regions with a name."""
    named = [region for region in dict.fromkeys(regions) if region]
    if len(named) < 2:
        return {}
    return {name: tuple(i for i, region in enumerate(regions) if region != name) for name in named}


def fit_sites(
    simulate: Simulate,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    chosen: Choice,
    settings: CalibrationSettings | None = None,
    label: str = "",
) -> Fold:
    """Fit the ``chosen`` sites, every tissue its own material, and predict all of them.

    Parameters
    ----------
    simulate : gives all sites of ``measured``, in order.
    unknowns : starts at the study's own answer.
    """

    def of_chosen(parameters: Array) -> list[SiteResponse]:
        responses = simulate(parameters)
        return [responses[i] for i in chosen]

    found = calibrate(
        of_chosen,
        [measured[i] for i in chosen],
        unknowns,
        settings or CalibrationSettings(),
        stages=(separate(unknowns.names),),
    )
    errors = [
        error_percent(response.force_N, site.force_N)
        for response, site in zip(simulate(found.parameters), measured, strict=True)
    ]
    return Fold(
        chosen, found.parameters, tuple(errors), found.converged, _at_limit(found.parameters, unknowns), label
    )


def _at_limit(parameters: Array, unknowns: Unknowns) -> tuple[str, ...]:
    near = (np.log(parameters / unknowns.lower) < _EDGE) | (np.log(unknowns.upper / parameters) < _EDGE)
    return tuple(name for name, edge in zip(unknowns.names, near) if edge)


def cross_validate(
    simulate: Simulate,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    choices: Sequence[Choice] | Mapping[str, Choice],
    settings: CalibrationSettings | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Fold, ...]:
    """Fit every choice (with its label where they are named) and predict the others."""
    pairs = list(choices.items()) if isinstance(choices, Mapping) else [("", choice) for choice in choices]
    folds = []
    for i, (label, choice) in enumerate(pairs):
        folds.append(fit_sites(simulate, measured, unknowns, tuple(choice), settings, label))
        progress(i + 1, len(pairs))
    return tuple(folds)


@dataclass(frozen=True)
class Standing:
    """Where one fold lies among the others: ``share_better`` of them have a smaller held-out error."""

    mean_percent: float
    share_better: float
    median_percent: float
    low_percent: float
    high_percent: float


def standing(own: Fold, folds: Sequence[Fold]) -> Standing:
    """The mean held-out error of ``own`` in the distribution over ``folds`` (5, 50 and 95 %)."""
    means = np.array([fold.mean_heldout for fold in folds])
    low, middle, high = np.percentile(means, [5, 50, 95])
    # Ties, itself above all, count half.
    better = np.mean(means < own.mean_heldout - 1e-9) + 0.5 * np.mean(
        np.abs(means - own.mean_heldout) <= 1e-9
    )
    return Standing(own.mean_heldout, float(better), float(middle), float(low), float(high))


def errors_by_site(folds: Sequence[Fold], sites: int) -> tuple[Summary, ...]:
    """Errors of each site over the folds that did not fit it."""
    return tuple(
        summarise([fold.errors_percent[i] for fold in folds if i not in fold.fitted]) for i in range(sites)
    )
