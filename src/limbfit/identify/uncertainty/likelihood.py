"""The likelihood of parameters, given the records, which posterior, profiles and model comparison share.

The residuals have the covariance of ``discrepancy``. The size of the misfit is not known exactly, so a factor
on all misfits remains an unknown of its own; it is 1 where the misfit was estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ...arrays import Array
from ..fit.objective import MeasuredCurve, SiteResponse
from ..fit.parameters import SearchSpace, Unknowns
from ..fit.trust_region import SearchPoint, minimise
from .discrepancy import ResidualModel

_MAX_ITERATIONS = 60
_TOLERANCE = 1e-5
MISFIT_FACTOR_BOUNDS = (0.2, 5.0)  # of the misfit


class ForceSurrogate(Protocol):
    """A model fast enough to be asked thousands of times: an `Emulator`, or one that is made of it."""

    def __call__(self, parameters: Array) -> Sequence[SiteResponse]:
        """Return force (n,) and derivatives (n, p) of every site at parameters (p,)."""
        ...

    def predict_forces(self, parameters: Array) -> Array:
        """Return the forces (m, N) of all sites, one after the other, at parameters (m, p)."""
        ...


ForcesAndSd = Callable[[Array], tuple[Array, Array]]
_MIN_MISFIT = 1e-7  # over the largest force: much less than any noise


@dataclass(frozen=True)
class Optimum:
    """The most probable z (k,) of a space: ``parameters`` (p,), ``minus_2_log`` of the likelihood there."""

    z: Array
    parameters: Array
    minus_2_log: float


class Likelihood:
    """The likelihood of the records over a search space, with the emulator in place of the solver.

    The coordinates ``z`` (k,) are those of ``space``. Stated priors of ``unknowns`` count as data; bounds
    hold. ``forces_and_sd`` returns forces (m, N) and their expected error (m, sites), one sd in N, at
    parameters (m, p). That error counts as misfit that grows away from the simulated points (Kennedy and
    O'Hagan 2001).
    """

    def __init__(
        self,
        emulator: ForceSurrogate,
        measured: Sequence[MeasuredCurve],
        model: ResidualModel,
        unknowns: Unknowns,
        space: SearchSpace,
        forces_and_sd: ForcesAndSd | None = None,
    ) -> None:
        self.forces_and_sd = forces_and_sd
        if forces_and_sd is not None:  # an expected error has the shape of misfit, which none would not have
            model = replace(model, misfit=np.maximum(model.misfit, _MIN_MISFIT))
        self.emulator, self.measured, self.model = emulator, tuple(measured), model
        self.unknowns, self.space = unknowns, space
        spectra = model.compute_spectra()
        sizes = np.cumsum([0, *(len(s.values) for s in spectra)])
        self._sites = tuple(
            (spectrum.transform, slice(a, b)) for spectrum, a, b in zip(spectra, sizes[:-1], sizes[1:])
        )
        self._misfit = np.concatenate([s.values for s in spectra])
        self._site = np.repeat(np.arange(len(spectra)), np.diff(sizes))
        unit = model.misfit * model.peaks_N if forces_and_sd is not None else np.ones(len(spectra))
        self._per_N2 = self._misfit / unit[self._site] ** 2
        self._constant = sum(s.log_determinant for s in spectra) + sizes[-1] * np.log(2 * np.pi)
        self._shared = self._whiten(np.concatenate(model.shared_deviations))
        self._target = self._whiten(np.concatenate([site.force_N for site in measured]))
        self._rows, self._known = unknowns.build_prior_rows()

    @property
    def has_misfit(self) -> bool:
        """True if the size of the misfit makes a difference."""
        return bool(self._misfit.max(initial=0.0) > 1e-6)

    def _whiten(self, forces: Array) -> Array:
        """Transform forces of all sites (N, ...) so that noise has variance 1 and misfit is diagonal."""
        return np.concatenate([transform @ forces[where] for transform, where in self._sites])

    def to_parameters(self, z: Array) -> Array:
        """Return the full parameters (m, p) at z (m, k)."""
        return np.exp(self.space.fixed_log + np.atleast_2d(z) @ self.space.tie.T)

    def compute_minus_2_log(self, z: Array, factor: Array | float = 1.0) -> Array:
        """Return minus twice the log-likelihood (m,) at z (m, k), with the misfit ``factor`` (m,) times as
        large.

        It is infinite outside the bounds.
        """
        z = np.atleast_2d(z)
        p = self.to_parameters(z)
        if self.forces_and_sd is None:
            forces, sd_N = self.emulator.predict_forces(p), np.zeros((1, len(self.measured)))
        else:
            forces, sd_N = self.forces_and_sd(p)
        residual = self._whiten(forces.T).T - self._target
        variances = 1.0 + np.atleast_1d(factor)[:, None] ** 2 * self._misfit
        prior_deviations = np.log(p) @ self._rows.T - self._known
        with np.errstate(over="ignore", invalid="ignore"):  # far from all runs: not finite, so infinite
            variances = variances + sd_N[:, self._site] ** 2 * self._per_N2
            found = self._whitened_minus_2_log(residual, variances) + np.sum(prior_deviations**2, axis=1)
        found = np.where(np.isfinite(found), found, np.inf) + self._constant
        outside = np.any((z < self.space.lower - 1e-9) | (z > self.space.upper + 1e-9), axis=1)
        return np.where(outside, np.inf, found)

    def minus_2_log_of(self, responses: Sequence[SiteResponse], parameters: Array) -> float:
        """Return the same for forces of the solver, to check the emulator."""
        forces = np.concatenate([response.force_N for response in responses])
        residual = self._whiten(forces) - self._target
        variances = 1.0 + self._misfit
        prior_deviations = self._rows @ np.log(parameters) - self._known
        return float(
            self._whitened_minus_2_log(residual[None], variances[None])[0]
            + prior_deviations @ prior_deviations
            + self._constant
        )

    def _whitened_minus_2_log(self, residual: Array, variances: Array) -> Array:
        """Return minus twice the log-likelihood (m,) of whitened residuals (m, N), up to a constant.

        What records share is integrated out (Woodbury).
        """
        found = np.sum(residual**2 / variances + np.log(variances), axis=1)
        E = self._shared
        if not E.shape[1]:
            return np.asarray(found)
        amount = (residual / variances) @ E
        inner = np.eye(E.shape[1]) + np.einsum("ni,mn,nj->mij", E, 1.0 / variances, E, optimize=True)
        explained = np.einsum("mi,mi->m", amount, np.linalg.solve(inner, amount[..., None])[..., 0])
        return np.asarray(found - explained + np.linalg.slogdet(inner)[1])

    def linearise(self, z: Array, factor: float = 1.0) -> SearchPoint | None:
        """Return residuals of unit variance and their derivatives at z (k,), for least squares."""
        parameters = self.to_parameters(z)[0]
        responses = self.emulator(parameters)
        sd = np.sqrt(1.0 + factor**2 * self._misfit)
        axes, sizes, _ = np.linalg.svd(self._shared / sd[:, None], full_matrices=False)
        shrunk = 1.0 - 1.0 / np.sqrt(1.0 + sizes**2)  # of what records share: (I + F F')^(-1/2)

        def scaled(rows: Array) -> Array:
            """Rows (N, ...) where all residuals together have variance 1."""
            rows = (rows.T / sd).T
            return np.asarray(rows - (axes * shrunk) @ (axes.T @ rows))

        forces = np.concatenate([response.force_N for response in responses])
        slopes = np.concatenate([self.space.pull_back(r.jacobian, parameters) for r in responses])
        if not (np.isfinite(forces).all() and np.isfinite(slopes).all()):
            return None
        residual = scaled(self._whiten(forces) - self._target)
        prior_deviations = self._rows @ np.log(parameters) - self._known
        jacobian = np.concatenate([scaled(self._whiten(slopes)), self._rows @ self.space.tie])
        return SearchPoint(z, np.concatenate([residual, prior_deviations]), jacobian)

    def find_optimum(self, start: Array, fixed_entry: int | None = None, factor: float = 1.0) -> Optimum:
        """Find the most probable z from ``start`` (k,); the entry ``fixed_entry`` stays as it is."""
        free = np.arange(len(start)) != (-1 if fixed_entry is None else fixed_entry)

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
        return Optimum(z, self.to_parameters(z)[0], float(self.compute_minus_2_log(z, factor)[0]))

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
        bounds = np.diag(12.0 / (self.space.upper - self.space.lower) ** 2)
        return np.asarray(np.linalg.inv(point.jacobian.T @ point.jacobian + bounds), dtype=np.float64)
