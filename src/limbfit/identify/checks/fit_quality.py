"""How well a model follows the records: by phase, beside what may be off without the model being wrong.

The residuals r of a record that the model obeys have a known covariance C: noise, touch-down, mesh, and the
stiffness of the site as a whole. ``sqrt(r' C^-1 r / n)`` is then about one in every phase. A model that
cannot follow leaves smooth residuals, many times as large by this measure even where they are small beside
the force. The mesh counts with the shape of its own error and with a smooth error of any shape
(`estimate_mesh_misfit`): a record of the same limb on another mesh is no fault of the model.

Autocorrelation is tested on residuals whitened by C (Ljung and Box 1978). What other parameters would explain
is taken out first: it is the model that is judged, not where the search stopped.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import chdtrc

from ...arrays import Array, Mask
from ...phases import find_phases
from ...results.identification import PhaseFit, RecordFit

_MIN_TIMES_NOISE, _MIN_SHARE = 2.0, 0.003  # of the largest force: less is of no use to say
_MIN_POINTS = 4
_LAGS = 10  # of the test for autocorrelation
_CLEAR_P = 1e-3
_FEW_INSIDE = 0.5  # of the points of a held-out record
_WORDS = {"load": "loading", "hold": "hold", "unload": "unloading"}


def refit_residuals(
    residuals_N: Sequence[Array], jacobians_log: Sequence[Array], covariances: Sequence[Array]
) -> list[Array]:
    """Return the residuals (n,) of fitted records at the parameters that explain them best under C.

    That is one generalised least-squares step of the logarithms of the parameters, by about one at most;
    ``jacobians_log`` (n, p) are the derivatives with respect to these.
    """
    if not residuals_N:  # no fitted record could be simulated
        return []
    rows = [_whiten(J, C) for J, C in zip(jacobians_log, covariances, strict=True)]
    left = [_whiten(r, C) for r, C in zip(residuals_N, covariances, strict=True)]
    A = np.eye(rows[0].shape[1]) + sum(J.T @ J for J in rows)
    step = np.linalg.solve(A, sum(J.T @ r for J, r in zip(rows, left, strict=True)))
    return [r - J @ step for r, J in zip(residuals_N, jacobians_log, strict=True)]


def assess_fit(
    record: str,
    fitted: bool,
    times_s: Array,
    depth_mm: Array,
    residual_N: Array,
    peak_N: float,
    covariance: Array,
    inside: Mask | None = None,
    refitted_N: Array | None = None,
    compared: str = "force",
) -> RecordFit:
    """Assess ``residual_N`` (n,), simulated minus measured, with ``covariance`` (n, n) of what may be off.

    ``depth_mm`` (n,) tells the phases, ``peak_N`` is the largest measured force, ``inside`` (n,) whether each
    point lies in its 95 % band. ``refitted_N`` (n,) are the residuals of `refit_residuals`, which are beside
    the covariance; by default those of the answer. Where the force is stated, ``depth_mm`` holds it, all else
    is lengths, and ``compared`` is the displacement. A held-out record is judged by the band, which counts
    how well the parameters are known.
    """
    refitted = residual_N if refitted_N is None else refitted_N
    white = _whiten(refitted, covariance)
    centred = residual_N - residual_N.mean()
    alike = float(centred[1:] @ centred[:-1] / max(centred @ centred, 1e-300))
    phases = _assess_phases(times_s, depth_mm, residual_N, refitted, peak_N, covariance)
    share = None if inside is None else float(np.mean(inside))
    p = _test_autocorrelation(white)
    if fitted:
        verdict = _describe_fitted(record, phases, p, compared)
    else:
        verdict = _describe_held_out(record, phases, share, compared)
    return RecordFit(
        record=record,
        fitted=fitted,
        times_noise=float(np.sqrt(np.mean(white**2))),
        autocorrelation=alike,
        ljung_box_p=p,
        inside_95=share,
        phases=phases,
        verdict=verdict,
    )


def summarise_fit(records: Sequence[RecordFit]) -> str:
    """Say in one line how the model fits the study's records."""
    fitted = [one for one in records if one.fitted]
    off = [one for one in fitted if one.verdict]
    if not fitted:
        return ""
    text = "the model follows every fitted record within what noise, touch-down, mesh and site explain"
    if off:
        text = max(off, key=lambda one: max(p.times_noise for p in one.phases if _is_clear(p))).verdict
        text += f"; and {len(off) - 1} more of {len(fitted)} fitted records" if len(off) > 1 else ""
    held = [one for one in records if not one.fitted and one.inside_95 is not None]
    if missed := sum(bool(one.verdict) for one in held):
        text += f"; {missed} of {len(held)} held-out records lie mostly outside their 95 % band"
    return text


def _whiten(rows: Array, covariance: Array) -> Array:
    return np.asarray(solve_triangular(cholesky(covariance, lower=True), rows, lower=True))


def _test_autocorrelation(white: Array) -> float:
    """Probability of so much autocorrelation of white noise (n,) by chance (Ljung and Box 1978)."""
    n, squares = len(white), max(float(white @ white), 1e-300)
    lags = np.arange(1, min(_LAGS, n - 2) + 1)
    alike = np.array([float(white[k:] @ white[:-k]) / squares for k in lags])
    return float(chdtrc(len(lags), n * (n + 2) * np.sum(alike**2 / (n - lags))))


def _assess_phases(
    times_s: Array, depth_mm: Array, residual_N: Array, refitted_N: Array, peak_N: float, covariance: Array
) -> tuple[PhaseFit, ...]:
    kinds = np.full(len(times_s), "", dtype=object)
    for phase in find_phases(times_s, depth_mm):
        kinds[(times_s > phase.start_s) & (times_s <= phase.end_s)] = _WORDS.get(phase.kind, phase.kind)
    found = []
    for kind in dict.fromkeys(kinds[kinds != ""]):
        at = np.flatnonzero(kinds == kind)
        if len(at) < _MIN_POINTS:
            continue
        error = residual_N[at]
        rms = float(np.sqrt(np.mean(error**2)))
        white = _whiten(refitted_N[at], covariance[np.ix_(at, at)])
        times = float(np.sqrt(np.mean(white**2)))
        found.append(
            PhaseFit(
                phase=kind,
                error_N=rms,
                error_percent=100 * rms / peak_N,
                bias_percent=100 * float(error.mean()) / peak_N,
                times_noise=times,
            )
        )
    return tuple(found)


def _is_clear(phase: PhaseFit) -> bool:
    """True if the model does not follow the record there."""
    return phase.times_noise >= _MIN_TIMES_NOISE and phase.error_percent >= 100 * _MIN_SHARE


def _describe_fitted(record: str, phases: Sequence[PhaseFit], ljung_box_p: float, compared: str) -> str:
    clear = [phase for phase in phases if _is_clear(phase)]
    if not clear or ljung_box_p > _CLEAR_P:
        return ""
    worst = max(clear, key=lambda phase: phase.error_percent)
    return (
        f"the model cannot follow the {worst.phase} at {record}: {worst.error_percent:.2g} % of the "
        f"largest {compared}, {worst.times_noise:.2g} times what noise, touch-down, mesh and site explain"
    )


def _describe_held_out(record: str, phases: Sequence[PhaseFit], inside: float | None, compared: str) -> str:
    if inside is None or inside >= _FEW_INSIDE or not any(map(_is_clear, phases)):
        return ""
    worst = max(phases, key=lambda phase: phase.error_percent)
    return (
        f"{record} is not predicted: {100 * inside:.0f} % of its points lie in the 95 % band, "
        f"and the {worst.phase} is off by {worst.error_percent:.2g} % of the largest {compared}"
    )
