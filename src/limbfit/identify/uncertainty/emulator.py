"""An emulator: forces over the logarithms of the parameters, from simulations that were already made.

Every simulation brings its exact derivatives, so k runs of p parameters are k (p + 1) observations of each
point of each curve. A Gaussian process with a polynomial trend interpolates values and derivatives together
(gradient-enhanced universal kriging: Morris, Mitchell and Ylvisaker 1993). It works on ``asinh(F / s)`` with
s a share of the site's force: a logarithm that also takes a force of zero, and that is close to a polynomial.
One kernel matrix serves all points of all curves; its length is the one that predicts each run best from the
others (Dubrule 1983).
"""

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from ..fit.objective import SiteResponse, find_largest_magnitude

_LENGTHS = (1.0, 2.0, 4.0, 8.0)  # of the kernel, in half-widths of the points
_NUGGETS = (1e-9, 1e-7, 1e-5)  # variance that the solver's own tolerances add, over that of the kernel
_TRUSTED_CONDITION = 1e6
_ROUNDING_SHARE = 1e-9  # of half a width: runs and questions may both lie on a bound
_MAX_SOFT_FORCE = 50.0  # asinh of a force over s: far outside of its runs the trend would pass any number
_MIN_WIDTH = 0.02  # of the points, in the logarithm


class Emulator:
    """Forces and derivatives at any parameters; calling it simulates (see ``Simulate``).

    ``points`` (k, p) are the parameters of its runs; ``loo_percent`` (k, sites) is the force error at each
    run when it is left out; ``length`` and ``nugget`` are those of the kernel. It interpolates within
    ``lower`` and ``upper``, the box of its points; ``expected_error_percent`` says what to expect anywhere.
    """

    def __init__(
        self, points: Array, responses: Sequence[Sequence[SiteResponse]], *, softening: float = 0.3
    ) -> None:
        """Fit the emulator to k runs: ``points`` (k, p), all positive, and their responses per site.

        Runs in which a site failed are left out.

        Raises `CalibrationError` if fewer than two complete runs are left.

        ``softening``: s over the median of a site's largest forces. Above s the scale is logarithmic, which
        suits forces that differ manifold between the points; far above 1 it is the force itself.
        """
        whole = [i for i, run in enumerate(responses) if not any(response.fault for response in run)]
        if len(whole) < 2:
            raise CalibrationError(f"an emulator needs two complete simulations, has {len(whole)}")
        runs = [responses[i] for i in whole]
        forces = np.array([np.concatenate([r.force_N for r in run]) for run in runs])
        slopes = np.array([np.concatenate([r.jacobian for r in run]) for run in runs])
        ends = np.cumsum([0, *(r.force_N.size for r in runs[0])])
        self._sites = [slice(a, b) for a, b in pairwise(ends.tolist())]
        peaks = np.array([[find_largest_magnitude(f[s]) for s in self._sites] for f in forces])
        # s of every output, and the box of the points in logarithms
        self._soft = np.repeat(softening * np.maximum(np.median(peaks, axis=0), 1e-9), np.diff(ends))
        self.points = np.asarray(points, dtype=float)[whole]
        self.lower, self.upper = self.points.min(axis=0), self.points.max(axis=0)
        self._centre = (np.log(self.lower) + np.log(self.upper)) / 2
        self._width = np.maximum((np.log(self.upper) - np.log(self.lower)) / 2, _MIN_WIDTH)
        self._unit = self._to_unit(self.points)
        scaled = slopes * (self.points * self._width)[:, None, :] / np.hypot(forces, self._soft)[:, :, None]
        observed = np.hstack([np.arcsinh(forces / self._soft)[:, None, :], scaled.transpose(0, 2, 1)])
        self._choose_kernel(observed.reshape(-1, forces.shape[1]), forces, peaks)

    def _choose_kernel(self, observed: Array, forces: Array, peaks: Array) -> None:
        """Choose the kernel that predicts each run best from the others; keep it and its weights.

        ``observed`` (k (p + 1), outputs) are values and derivatives at the points.
        """
        n, (k, p) = len(observed), self._unit.shape
        self._quadratic = _is_determined(_build_trend(self._unit, True).reshape(n, -1))
        border = _build_trend(self._unit, self._quadratic).reshape(n, -1)
        corner = np.zeros((border.shape[1], border.shape[1]))
        best = np.inf
        for length, nugget in product(_LENGTHS, _NUGGETS):
            K = _build_kernel(self._unit, self._unit, length) + nugget * np.eye(n)
            inverse = np.linalg.pinv(np.block([[K, border], [border.T, corner]]), rcond=1e-14, hermitian=True)
            weights = inverse[:, :n] @ observed
            left_out = _predict_left_out(inverse[:n, :n], weights[:n], observed, k, p)
            errors = np.abs(self._soft * np.sinh(left_out) - forces)
            loo = 100 * np.stack([errors[:, s].mean(axis=1) for s in self._sites], axis=1) / peaks
            score = float(np.median(loo) + 0.1 * np.sqrt(np.mean(np.minimum(loo, 1e3) ** 2)))
            if score < best:
                best, self.loo_percent, self.length, self.nugget = score, loo, length, nugget
                self._weights, self._inverse = weights, inverse
        # standard deviation of the process, per output
        self._spread = np.sqrt(np.maximum(np.sum(observed * self._weights[:n], axis=0) / n, 0.0))

    def __call__(self, parameters: Array) -> tuple[SiteResponse, ...]:
        """Return force (n,) and derivatives (n, p) of every site at parameters (p,)."""
        parameters = np.asarray(parameters, dtype=float)
        found = self._build_rows(parameters[None]) @ self._weights
        found[0] = np.clip(found[0], -_MAX_SOFT_FORCE, _MAX_SOFT_FORCE)
        force = self._soft * np.sinh(found[0])
        slope = self._soft * np.cosh(found[0])
        jacobian = slope[:, None] * found[1:].T / (parameters * self._width)
        return tuple(SiteResponse(force[s], jacobian[s]) for s in self._sites)

    def predict_forces(self, parameters: Array) -> Array:
        """Return the forces (m, N) of all sites, one after the other, at parameters (m, p)."""
        return self._compute_forces(self._build_rows(np.atleast_2d(parameters), slopes=False))

    def predict_forces_and_sd(self, parameters: Array) -> tuple[Array, Array]:
        """Return the forces (m, N), and the emulator's own expected error: one sd (m, sites) in N."""
        rows = self._build_rows(np.atleast_2d(parameters), slopes=False)
        force = self._compute_forces(rows)
        variance = np.maximum(1.0 - np.einsum("mi,mi->m", rows @ self._inverse, rows), 0.0)
        spread = self._spread * np.hypot(force, self._soft)
        sd = np.stack([spread[:, s].mean(axis=1) for s in self._sites], axis=1)
        return force, np.sqrt(variance)[:, None] * sd

    def _compute_forces(self, rows: Array) -> Array:
        return self._soft * np.sinh(np.clip(rows @ self._weights, -_MAX_SOFT_FORCE, _MAX_SOFT_FORCE))

    def _build_rows(self, parameters: Array, slopes: bool = True) -> Array:
        """Return covariances and trend of values, with ``slopes`` of derivatives too, at parameters (m, p).

        Rows (m or m (p + 1), observations + trend) are multiplied with the weights.
        """
        at = self._to_unit(parameters)
        trend = _build_trend(at, self._quadratic)
        trend = trend.reshape(-1, trend.shape[2]) if slopes else trend[:, 0]
        return np.hstack([_build_kernel(at, self._unit, self.length, slopes), trend])

    def expected_error_percent(self, parameters: Array) -> Array:
        """Expected error of the emulator itself (sites,), in percent of the largest force: one sd."""
        force, doubt = (found[0] for found in self.predict_forces_and_sd(np.asarray(parameters)))
        return np.array(
            [100 * sd / max(find_largest_magnitude(force[s]), 1e-12) for sd, s in zip(doubt, self._sites)]
        )

    def is_inside(self, parameters: Array, margin: float = 0.1) -> bool:
        """True if the parameters (p,) lie in the box of the points, widened by a share of its width."""
        return bool(np.all(np.abs(self._to_unit(np.asarray(parameters))) <= 1 + 2 * margin + _ROUNDING_SHARE))

    def _to_unit(self, parameters: Array) -> Array:
        return (np.log(parameters) - self._centre) / self._width


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


def _build_trend(points: Array, quadratic: bool) -> Array:
    """Return 1, x_i and, if quadratic, x_i x_j at points (m, p): (m, p + 1, features).

    Each point's values come first, then their derivatives.
    """
    m, p = points.shape
    eye = np.eye(p)
    linear = np.zeros((m, p + 1, p + 1))
    linear[:, 0] = np.column_stack([np.ones(m), points])
    linear[:, 1:, 1:] = eye
    if not quadratic:
        return linear
    i, j = np.triu_indices(p)
    values = (points[:, i] * points[:, j])[:, None]
    slopes = points[:, None, i] * eye[:, j] + points[:, None, j] * eye[:, i]
    return np.dstack([linear, np.hstack([values, slopes])])


def _build_kernel(a: Array, b: Array, length: float, slopes: bool = True) -> Array:
    """Return the squared-exponential covariance at a (m, p) with values and derivatives at b (k, p).

    Its shape is (m, k (p + 1)), with ``slopes`` at a too (m (p + 1), k (p + 1)); each point's value comes
    first, then its derivatives.
    """
    m, p = a.shape
    difference = (a[:, None, :] - b[None, :, :]) / length**2
    value = np.exp(-0.5 * length**2 * np.sum(difference**2, axis=2))[:, :, None]
    of_values = np.concatenate([value, value * difference], axis=2)
    if not slopes:
        return of_values.reshape(m, -1)
    second = np.eye(p) / length**2 - difference[:, :, :, None] * difference[:, :, None, :]
    K = np.empty((m, p + 1, len(b), p + 1))
    K[:, 0] = of_values
    K[:, 1:, :, 0] = -np.swapaxes(of_values[:, :, 1:], 1, 2)
    K[:, 1:, :, 1:] = np.moveaxis(value[..., None] * second, 1, 2)
    return K.reshape(m * (p + 1), -1)
