"""An emulator: forces over the logarithms of the parameters, from simulations that were already made.

Every simulation brings its exact derivatives, so k runs of p parameters are k (p + 1) observations of each
point of each curve. A Gaussian process with a polynomial trend interpolates values and derivatives together
(gradient-enhanced universal kriging: Morris, Mitchell and Ylvisaker 1993). It works on ``asinh(F / s)`` with
s a share of the site's force: a logarithm that also takes a force of zero, and that is close to a polynomial.
One kernel matrix serves all points of all curves; its length is the one that predicts each run best from the
others (Dubrule 1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement, pairwise

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from ..fit.objective import SiteResponse, find_largest_magnitude
from ..fit.prediction import compute_error_percent

_LENGTHS = (1.0, 2.0, 4.0, 8.0)  # of the kernel, in half-widths of the points
_NUGGETS = (1e-9, 1e-7, 1e-5)  # variance that the solver's own tolerances add, over that of the kernel
_TRUSTED_CONDITION = 1e6
_ROUNDING_SHARE = 1e-9  # of half a width: runs and questions may both lie on a bound
_MAX_SOFT_FORCE = 50.0  # asinh of a force over s: far outside of its runs the trend would pass any number
_MIN_WIDTH = 0.02  # of the points, in the logarithm


@dataclass(frozen=True)
class Emulator:
    """Forces and derivatives at any parameters; calling it simulates (see ``Simulate``).

    ``points`` (k, p) are the parameters of its runs; ``loo_percent`` (k, sites) is the force error at each
    run when it is left out; ``length`` and ``nugget`` are those of the kernel. It interpolates within
    ``lower`` and ``upper``, the box of its points; ``expected_error_percent`` says what to expect anywhere.
    """

    names: tuple[str, ...]
    points: Array
    loo_percent: Array
    length: float
    nugget: float
    _sites: tuple[slice, ...] = field(repr=False)
    _soft: Array = field(repr=False)
    _centre: Array = field(repr=False)
    _width: Array = field(repr=False)
    _quadratic: bool = field(repr=False)
    _unit: Array = field(repr=False)  # the points in the unit box
    _weights: Array = field(repr=False)  # (k (p + 1) + trend, outputs)
    _inverse: Array = field(repr=False)  # of the bordered kernel matrix
    _spread: Array = field(repr=False)  # sd of the process, per output
    _peaks: Array = field(repr=False)

    @classmethod
    def fit(
        cls,
        names: Sequence[str],
        points: Array,
        responses: Sequence[Sequence[SiteResponse]],
        *,
        softening: float = 0.3,
    ) -> Emulator:
        """Fit the emulator to k runs: ``points`` (k, p), all positive, and their responses per site.

        Runs in which a site failed are left out.

        Parameters
        ----------
        softening : s over the median of a site's largest forces. Above s the scale is logarithmic, which
            suits forces that differ manifold between the points; far above 1 it is the force itself.

        Raises
        ------
        CalibrationError
            If fewer than two complete runs are left.
        """
        whole = [i for i, run in enumerate(responses) if all(r.completed and _is_finite(r) for r in run)]
        points = np.atleast_2d(np.asarray(points, dtype=float))[whole]
        if len(points) < 2:
            raise CalibrationError(f"an emulator needs two complete simulations, has {len(points)}")
        runs = [responses[i] for i in whole]
        forces = np.array([np.concatenate([r.force_N for r in run]) for run in runs])
        slopes = np.array([np.concatenate([r.jacobian for r in run]) for run in runs])
        sites = _build_slices([r.force_N.size for r in runs[0]])
        peaks = np.array([[find_largest_magnitude(f[s]) for s in sites] for f in forces])
        middle = softening * np.maximum(np.median(peaks, axis=0), 1e-9)
        soft = np.concatenate([np.full(s.stop - s.start, v) for s, v in zip(sites, middle)])
        centre, width = _find_box(np.log(points))
        unit = (np.log(points) - centre) / width
        scaled = slopes * (points * width)[:, None, :] / np.hypot(forces, soft)[:, :, None]
        observed = np.hstack([np.arcsinh(forces / soft)[:, None, :], scaled.transpose(0, 2, 1)])
        chosen = _choose_kernel(unit, observed.reshape(-1, forces.shape[1]), forces, soft, sites, peaks)
        return cls(
            names=tuple(names),
            points=points,
            _sites=sites,
            _soft=soft,
            _centre=centre,
            _width=width,
            _unit=unit,
            _peaks=np.median(peaks, axis=0),
            **chosen,
        )

    @property
    def lower(self) -> Array:
        return self.points.min(axis=0)

    @property
    def upper(self) -> Array:
        return self.points.max(axis=0)

    def __call__(self, parameters: Array) -> tuple[SiteResponse, ...]:
        """Return force (n,) and derivatives (n, p) of every site at parameters (p,)."""
        parameters = np.asarray(parameters, dtype=float)
        at = self._to_unit(parameters)
        rows = np.vstack(
            [_build_cross_rows(at, self._unit, self.length, self._quadratic, order) for order in (0, 1)]
        )
        found = rows @ self._weights
        found[0] = np.clip(found[0], -_MAX_SOFT_FORCE, _MAX_SOFT_FORCE)
        force = self._soft * np.sinh(found[0])
        slope = self._soft * np.cosh(found[0])
        jacobian = slope[:, None] * found[1:].T / (parameters * self._width)
        return tuple(SiteResponse(force[s], jacobian[s]) for s in self._sites)

    def predict_forces(self, parameters: Array) -> Array:
        """Return the forces (m, N) of all sites, one after the other, at parameters (m, p)."""
        at = self._to_unit(np.atleast_2d(parameters))
        return self._forces_of(_build_cross_rows(at, self._unit, self.length, self._quadratic, 0))

    def predict_forces_and_sd(self, parameters: Array) -> tuple[Array, Array]:
        """Return the forces (m, N), and the emulator's own expected error: one sd (m, sites) in N."""
        at = self._to_unit(np.atleast_2d(parameters))
        rows = _build_cross_rows(at, self._unit, self.length, self._quadratic, 0)
        force = self._forces_of(rows)
        variance = np.maximum(1.0 - np.einsum("mi,mi->m", rows @ self._inverse, rows), 0.0)
        spread = self._spread * np.hypot(force, self._soft)
        sd = np.stack([spread[:, s].mean(axis=1) for s in self._sites], axis=1)
        return force, np.sqrt(variance)[:, None] * sd

    def _forces_of(self, rows: Array) -> Array:
        return self._soft * np.sinh(np.clip(rows @ self._weights, -_MAX_SOFT_FORCE, _MAX_SOFT_FORCE))

    def expected_error_percent(self, parameters: Array) -> Array:
        """Expected error of the emulator itself (sites,), in percent of the largest force: one sd."""
        force, doubt = (found[0] for found in self.predict_forces_and_sd(np.asarray(parameters)))
        return np.array(
            [100 * sd / max(find_largest_magnitude(force[s]), 1e-12) for sd, s in zip(doubt, self._sites)]
        )

    def is_inside(self, parameters: Array, margin: float = 0.1) -> bool:
        """True if the parameters (p,) lie in the box of the points, widened by a share of its width."""
        return bool(np.all(np.abs(self._to_unit(np.asarray(parameters))) <= 1 + 2 * margin + _ROUNDING_SHARE))

    def compute_errors_percent(self, parameters: Array, responses: Sequence[SiteResponse]) -> Array:
        """Return the error (sites,) of the emulated force at a simulation of the solver, in percent."""
        found = self(parameters)
        return np.array(
            [compute_error_percent(ours.force_N, run.force_N) for ours, run in zip(found, responses)]
        )

    def _to_unit(self, parameters: Array) -> Array:
        return (np.log(parameters) - self._centre) / self._width


def _is_finite(response: SiteResponse) -> bool:
    return bool(np.isfinite(response.force_N).all() and np.isfinite(response.jacobian).all())


def _build_slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    ends = np.cumsum([0, *sizes])
    return tuple(slice(int(a), int(b)) for a, b in pairwise(ends))


def _find_box(logs: Array) -> tuple[Array, Array]:
    """Return middle and half-width of the points."""
    low, high = logs.min(axis=0), logs.max(axis=0)
    return (low + high) / 2, np.maximum((high - low) / 2, _MIN_WIDTH)


def _choose_kernel(
    unit: Array, observed: Array, forces: Array, soft: Array, sites: Sequence[slice], peaks: Array
) -> dict:
    """Choose the kernel that predicts each run best from the others; return it with its weights."""
    k, p = unit.shape
    quadratic = _is_determined(_build_trend(unit, True))
    border = _build_trend(unit, quadratic)
    best: tuple[float, dict] | None = None
    for length in _LENGTHS:
        K = _build_kernel(unit, unit, length)
        for nugget in _NUGGETS:
            n, b = len(K), border.shape[1]
            bordered = np.block([[K + nugget * np.eye(n), border], [border.T, np.zeros((b, b))]])
            inverse = np.linalg.pinv(bordered, rcond=1e-14, hermitian=True)
            weights = inverse[:, :n] @ observed
            left_out = _predict_left_out(inverse[:n, :n], weights[:n], observed, k, p)
            errors = np.abs(soft * np.sinh(left_out) - forces)
            loo = 100 * np.stack([errors[:, s].mean(axis=1) for s in sites], axis=1) / peaks
            score = float(np.median(loo) + 0.1 * np.sqrt(np.mean(np.minimum(loo, 1e3) ** 2)))
            if best is None or score < best[0]:
                spread = np.sqrt(np.maximum(np.sum(observed * weights[:n], axis=0) / n, 0.0))
                best = (
                    score,
                    {
                        "loo_percent": loo,
                        "length": length,
                        "nugget": nugget,
                        "_quadratic": quadratic,
                        "_weights": weights,
                        "_inverse": inverse,
                        "_spread": spread,
                    },
                )
    assert best is not None
    return best[1]


def _predict_left_out(inverse: Array, weights: Array, observed: Array, k: int, p: int) -> Array:
    """Return predictions (k, outputs) of each run's values from all other runs (Dubrule 1983)."""
    found = []
    for i in range(k):
        block = slice(i * (p + 1), (i + 1) * (p + 1))
        error = np.linalg.lstsq(inverse[block, block], weights[block], rcond=1e-12)[0]
        found.append(observed[block][0] - error[0])
    return np.clip(np.array(found), -20.0, 20.0)


def _is_determined(trend: Array) -> bool:
    """True if the observations fix all coefficients of the trend, with some to spare."""
    if trend.shape[0] < 1.2 * trend.shape[1]:
        return False
    values = np.linalg.svd(trend, compute_uv=False)
    return bool(values[0] < _TRUSTED_CONDITION * values[-1])


def _evaluate_monomials(points: Array, quadratic: bool) -> Array:
    """Return 1, x_i and, if quadratic, x_i x_j at points (m, p): (m, features)."""
    columns = [np.ones(len(points)), *points.T]
    if quadratic:
        columns += [points[:, i] * points[:, j] for i, j in _list_pairs(points.shape[1])]
    return np.stack(columns, axis=1)


def _differentiate_monomials(points: Array, quadratic: bool) -> Array:
    """Return the derivatives of the monomials, (m, p, features)."""
    m, p = points.shape
    eye = np.eye(p)
    columns = [np.zeros((m, p)), *(np.tile(row, (m, 1)) for row in eye)]
    if quadratic:
        columns += [points[:, [i]] * eye[j] + points[:, [j]] * eye[i] for i, j in _list_pairs(p)]
    return np.stack(columns, axis=2)


def _list_pairs(p: int) -> list[tuple[int, int]]:
    return list(combinations_with_replacement(range(p), 2))


def _build_trend(unit: Array, quadratic: bool) -> Array:
    """Return values and derivatives of the trend at every point, (k (p + 1), features)."""
    both = np.concatenate(
        [_evaluate_monomials(unit, quadratic)[:, None, :], _differentiate_monomials(unit, quadratic)], axis=1
    )
    return both.reshape(-1, both.shape[2])


def _build_kernel(a: Array, b: Array, length: float) -> Array:
    """Return the squared-exponential covariance of values and derivatives at a (m, p) and b (k, p).

    Its shape is (m (p + 1), k (p + 1)); each point's value comes first, then its derivatives.
    """
    m, p = a.shape
    k = len(b)
    difference = (a[:, None, :] - b[None, :, :]) / length**2
    value = np.exp(-0.5 * length**2 * np.sum(difference**2, axis=2))
    K = np.empty((m, p + 1, k, p + 1))
    K[:, 0, :, 0] = value
    K[:, 0, :, 1:] = value[:, :, None] * difference
    K[:, 1:, :, 0] = -np.swapaxes(K[:, 0, :, 1:], 1, 2)
    second = np.eye(p) / length**2 - difference[:, :, :, None] * difference[:, :, None, :]
    K[:, 1:, :, 1:] = np.moveaxis(value[:, :, None, None] * second, 1, 2)
    return K.reshape(m * (p + 1), k * (p + 1))


def _build_cross_rows(points: Array, unit: Array, length: float, quadratic: bool, order: int) -> Array:
    """Return covariances and trend of new points with all observations.

    Order 0 is of the values at ``points`` (m, p), (m, n); order 1 of the derivatives at one point, (p, n).
    """
    points = np.atleast_2d(points)
    if order == 1:
        K = _build_kernel(points, unit, length)[1:]
        return np.hstack([K, _differentiate_monomials(points, quadratic)[0]])
    difference = (points[:, None, :] - unit[None, :, :]) / length**2
    value = np.exp(-0.5 * length**2 * np.sum(difference**2, axis=2))
    K = np.concatenate([value[:, :, None], value[:, :, None] * difference], axis=2)
    return np.hstack([K.reshape(len(points), -1), _evaluate_monomials(points, quadratic)])
