"""One material or several: information criteria on one likelihood, and errors at held-out sites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtr

from ...arrays import Array
from .likelihood import MISFIT_FACTOR_BOUNDS, Likelihood, Optimum

# Differences of criteria (Burnham and Anderson 2002; Kass and Raftery 1995)
_CLEAR_DIFFERENCE, _STRONG_DIFFERENCE = 2.0, 10.0


@dataclass(frozen=True)
class AlternativeModel:
    """A model's fit: ``parameters`` counts the free ones and the size of the misfit.

    ``aic`` is corrected for few samples (Hurvich and Tsai 1989); both criteria use the effective number of
    samples.
    """

    name: str
    parameters: int
    minus_2_log: float
    effective_samples: float
    misfit_factor: float
    aic: float
    bic: float


@dataclass(frozen=True)
class ModelComparison:
    """Two models compared: ``verdict`` in words, ``better`` the name of the supported one, or empty.

    ``heldout`` holds the mean error of each in percent, the mean difference (first minus second), its
    standard error, and the probability of so large a difference by chance (paired t-test). It is empty
    without held-out sites.
    """

    first: AlternativeModel
    second: AlternativeModel
    heldout: dict[str, float]
    better: str
    verdict: str

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def fit_alternative(name: str, likelihood: Likelihood, start: Array) -> tuple[AlternativeModel, Optimum]:
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
    k = len(start) + int(likelihood.has_misfit)
    n = likelihood.model.effective_samples()
    correction = 2 * k * (k + 1) / max(n - k - 1, 1.0)
    value = at.minus_2_log
    return (
        AlternativeModel(name, k, value, n, factor, value + 2 * k + correction, value + k * float(np.log(n))),
        at,
    )


def compare_models(
    first: AlternativeModel,
    second: AlternativeModel,
    errors_first: Sequence[float] = (),
    errors_second: Sequence[float] = (),
) -> ModelComparison:
    """Compare two models by the records; the errors in percent are those at the same held-out sites."""
    heldout = _compare_held_out(np.asarray(errors_first, float), np.asarray(errors_second, float))
    by_fit = min(first.aic - second.aic, first.bic - second.bic, key=abs)
    agree = (first.aic - second.aic) * (first.bic - second.bic) > 0
    better_fitted = 0 if not agree or abs(by_fit) < _CLEAR_DIFFERENCE else (1 if by_fit > 0 else -1)
    better_unseen = 0
    if heldout.get("p_value", 1.0) < 0.05:
        better_unseen = 1 if heldout["difference_percent"] > 0 else -1
    better, verdict = _describe_comparison(first, second, better_fitted, better_unseen, abs(by_fit), heldout)
    return ModelComparison(first, second, heldout, better, verdict)


def _compare_held_out(errors_first: Array, errors_second: Array) -> dict[str, float]:
    if not errors_first.size:
        return {}
    found = {
        "sites": float(errors_first.size),
        "first_percent": float(errors_first.mean()),
        "second_percent": float(errors_second.mean()),
    }
    difference = errors_first - errors_second
    found["difference_percent"] = float(difference.mean())
    if errors_first.size > 1 and difference.std() > 0:
        error = float(difference.std(ddof=1) / np.sqrt(errors_first.size))
        found["standard_error_percent"] = error
        found["p_value"] = float(2 * stdtr(errors_first.size - 1, -abs(difference.mean()) / error))
    return found


def _describe_comparison(
    first: AlternativeModel,
    second: AlternativeModel,
    better_fitted: int,
    better_unseen: int,
    size: float,
    heldout: dict[str, float],
) -> tuple[str, str]:
    names = {1: second.name, -1: first.name}
    if better_fitted:
        strength = "strongly" if size > _STRONG_DIFFERENCE else "moderately"
        by_fit = f"the fitted records support {names[better_fitted]} {strength}"
    else:
        by_fit = f"the fitted records do not distinguish {first.name} from {second.name}"
    if not heldout:
        by_test = "no site was held out"
    elif better_unseen:
        by_test = f"at {heldout['sites']:.0f} held-out sites {names[better_unseen]} predict better"
    else:
        by_test = f"at {heldout['sites']:.0f} held-out sites both predict alike"
    if better_fitted and better_unseen in (better_fitted, 0):
        better = names[better_fitted]
    elif better_unseen and not better_fitted:
        better = names[better_unseen]
    else:
        better = ""
    end = f"better supported: {better}" if better else "neither is better supported"
    numbers = f"AIC {first.aic - second.aic:+.1f}, BIC {first.bic - second.bic:+.1f} against {first.name}"
    return better, f"{by_fit} ({numbers}); {by_test}; {end}"
