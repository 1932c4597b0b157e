"""One material or several: the evidence of each on one likelihood, and errors at held-out sites.

The residuals are so alike that ten or so independent ones are left, too few for criteria that count samples
(AIC, corrected or not; BIC). The evidence counts none: it is the likelihood's mean over the bounds, by
Laplace's method (MacKay 2003, section 28). A parameter that the records do not tell costs nothing there.
"""

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
