"""One material or several: the evidence of each on one likelihood, and errors at held-out sites.

The residuals are so alike that ten or so independent ones are left, too few for criteria that count samples
(AIC, corrected or not; BIC). The evidence counts none: it is the likelihood's mean over the bounds, by
Laplace's method (MacKay 2003, section 28). A parameter that the records do not tell costs nothing there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import ndtr, softmax, stdtr

from ...arrays import Array
from ...results.uncertainty import EvidenceComparison, ModelEvidence
from .likelihood import MISFIT_FACTOR_BOUNDS, Likelihood, Optimum

# Differences of minus twice the log of the evidence (Kass and Raftery 1995)
_CLEAR_DIFFERENCE, _STRONG_DIFFERENCE = 2.0, 10.0


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

    Parameters
    ----------
    means, sds : (m, n) of each model at n points.
    weights : (m,) of the models; their sum is 1.
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
    by_fit = first.minus_2_log_evidence - second.minus_2_log_evidence
    better_fitted = 0 if abs(by_fit) < _CLEAR_DIFFERENCE else (1 if by_fit > 0 else -1)
    better_unseen = 0
    if heldout.get("p_value", 1.0) < 0.05:
        better_unseen = 1 if heldout["difference_percent"] > 0 else -1
    better, verdict = _describe_comparison(first, second, better_fitted, better_unseen, by_fit, heldout)
    return EvidenceComparison(first=first, second=second, heldout=heldout, better=better, verdict=verdict)


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
    first: ModelEvidence,
    second: ModelEvidence,
    better_fitted: int,
    better_unseen: int,
    by_evidence: float,
    heldout: dict[str, float],
) -> tuple[str, str]:
    names = {1: second.name, -1: first.name}
    if better_fitted:
        strength = "strongly" if abs(by_evidence) > _STRONG_DIFFERENCE else "moderately"
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
    numbers = f"twice the log of the evidence {by_evidence:+.1f} against {first.name}"
    return better, f"{by_fit} ({numbers}); {by_test}; {end}"
