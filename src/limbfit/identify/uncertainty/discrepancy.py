"""The misfit of the model: a smooth error of its own at every site, separated from noise.

The residuals of a good fit come mostly from the model: they drift along the record instead of scattering.
Each site has a Gaussian process of its own (Kennedy and O'Hagan 2001; Matern 3/2). Its standard deviation is
a share of the largest force, and its correlation length, common to all sites, a share of the record. Both are
estimated by restricted maximum likelihood (Patterson and Thompson 1971), which counts what the parameters
have absorbed.

A site as a whole may be off as well, because its tissue differs or its surfaces are not where the image shows
them. That is a random effect of every site on the stiffness of all its tissue, whose size is estimated, too.

Part of a misfit may be the mesh's. As the footprint of the indenter grows over the elements, the force rises
and falls by a little, on another mesh at other depths. What no parameter and no stiffer site explains of the
difference of two meshes tells how much of that there is (`estimate_mesh_misfit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, cholesky, eigh, solve_triangular
from scipy.optimize import brentq, minimize
from scipy.special import ndtr, stdtrit

from ...arrays import Array
from ...results.identification import MeshMisfitSummary, RecordResiduals, ResidualsSummary
from ..fit.prediction import MAX_FREEDOM
from .noise import SiteNoise

# Of a record; longer ones cannot be told from an offset
CORRELATION_LENGTHS = (0.04, 0.07, 0.12, 0.2, 0.35, 0.6)
_MIN_MISFIT, _MAX_MISFIT = 1e-5, 1.0  # of the largest force
# How far sites are off, over what was expected: its log has a Cauchy distribution about 0 of this scale. It
# lets the residuals say that a limb differs by much more than was expected, as real limbs do.
_SITE_FACTOR_SCALE_LOG = np.log(4.0)
_SITE_FACTOR_BOUNDS = (0.2, 50.0)
_SITE_FACTOR_GRID = np.linspace(np.log(_SITE_FACTOR_BOUNDS[0]), np.log(_SITE_FACTOR_BOUNDS[1]), 56)
_SITE_FACTORS = 40  # equally likely values
_MISFIT_SD_LOG = 0.5  # sd of log(sd) between sites: a site with a lucky fit is not trusted beyond its fellows


def compute_matern(times_s: Array, correlation: float) -> Array:
    """Return the Matern 3/2 correlation (n, n); ``correlation`` is its length over the length of the record.

    Times that are all the same are fully correlated.
    """
    share = times_s / (correlation * (np.ptp(times_s) or 1.0))
    distance = np.sqrt(3.0) * np.abs(share[:, None] - share[None, :])
    return (1 + distance) * np.exp(-distance)


@dataclass(frozen=True)
class MeshMisfit:
    """A misfit that the mesh alone would cause: standard deviation over the largest force of a record
    (``share``) and correlation length over its duration (``correlation``)."""

    share: float
    correlation: float

    def compute_covariance(self, times_s: Array, peak_N: float) -> Array:
        """Return its covariance (n, n) in N^2 for a record with so large a force."""
        return (self.share * peak_N) ** 2 * compute_matern(times_s, self.correlation)


@dataclass(frozen=True)
class ResidualModel:
    """Covariance of the residuals: the noise of each record, the misfit of the model, and what records share.

    ``mesh_N`` (n,) per record is one standard deviation of the mesh's error; it is empty if it was not
    measured. Records of one site (`SiteNoise.site_name`) have one mesh, whose error is one deviation of them
    all. ``site_N`` (n,) is the same for the expected difference of a site's stiffness, and ``site_factor``
    the estimated difference over the expected one; empty: it is left out. Few sites tell this factor poorly:
    ``site_factors`` (m,) are equally likely values of it. ``misfit`` (records,) is the
    standard deviation of the misfit over the largest force ``peaks_N`` (records,). ``known_scale`` is the
    number of independent residuals from which the size of the misfit is known. ``mesh_misfit`` is the part
    of the misfit that may be the mesh's.
    """

    noise: tuple[SiteNoise, ...]
    peaks_N: Array
    misfit: Array
    correlation: float
    known_scale: float
    criterion: float = field(default=0.0, repr=False)
    mesh_N: tuple[Array, ...] = ()
    site_N: tuple[Array, ...] = ()
    site_factor: float = 1.0
    site_factors: Array = field(default_factory=lambda: np.ones(1))
    mesh_misfit: MeshMisfit | None = None

    @cached_property
    def site_freedom(self) -> float:
        """Degrees of freedom with which Student's 95 % interval of a site's deviation is as wide as it is.

        The deviation is normal for each value of the site factor, and that is uncertain.
        """

        def compute_excess(half: float) -> float:
            return float(np.mean(ndtr(half / self.site_factors))) - 0.975

        half = brentq(compute_excess, 0.0, 10 * float(self.site_factors.max())) / self.site_factor
        if half <= stdtrit(MAX_FREEDOM, 0.975):
            return MAX_FREEDOM
        if half >= stdtrit(1.0, 0.975):
            return 1.0
        return float(brentq(lambda freedom: stdtrit(freedom, 0.975) - half, 1.0, MAX_FREEDOM))

    @property
    def misfit_elsewhere(self) -> float:
        """Misfit to expect at a site that was not fitted, over its largest force: root mean square.

        Only records of forces count if there are any: small depths have a large relative misfit.
        """
        of_force = np.array([noise.unit == "N" for noise in self.noise])
        return float(np.sqrt(np.mean(self.misfit[of_force if of_force.any() else ~of_force] ** 2)))

    def summarise(self) -> ResidualsSummary:
        """Return what is stored: forces in N (depths under force in mm), misfits over the largest force."""
        return ResidualsSummary(
            sites={
                noise.name: RecordResiduals(
                    unit=noise.unit,
                    noise_sd_N=noise.sd_N,
                    noise_autocorrelation=noise.autocorrelation,
                    touch_down_sd_mm=noise.touch_down_sd_mm,
                    compared_noise_sd_N=float(np.sqrt(np.trace(noise.covariance) / len(noise.times_s))),
                    misfit_sd_N=float(misfit * peak),
                    misfit_share=float(misfit),
                    mesh_share=self._share(self.mesh_N, i),
                    mesh_N=self.mesh_N[i].tolist() if self.mesh_N else None,
                    site_share=self._share([self.site_factor * one for one in self.site_N], i),
                )
                for i, (noise, misfit, peak) in enumerate(zip(self.noise, self.misfit, self.peaks_N))
            },
            site_factor=self.site_factor if self.site_N else None,
            site_freedom=self.site_freedom if self.site_N else None,
            misfit_elsewhere=self.misfit_elsewhere,
            mesh_misfit=None
            if self.mesh_misfit is None
            else MeshMisfitSummary.model_validate(self.mesh_misfit),
            correlation=self.correlation,
            known_scale=self.known_scale,
            effective_samples=self.effective_samples(),
        )

    def _share(self, sd_N: Sequence[Array], i: int) -> float | None:
        """Root mean square over the largest force of record i; None if nothing is given."""
        return float(np.sqrt(np.mean(sd_N[i] ** 2)) / self.peaks_N[i]) if sd_N else None

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites, each once."""
        return tuple(dict.fromkeys(noise.site_name for noise in self.noise))

    @property
    def shared_deviations(self) -> tuple[Array, ...]:
        """Per record (n, q): one standard deviation of each of the q deviations that records have in common.

        First come those of the meshes, then those of the sites, each as many as there are `sites`, or none.
        """
        kinds = [(self.mesh_N, 1.0), (self.site_N, self.site_factor)]
        kinds = [(rows, factor) for rows, factor in kinds if rows]
        found = [np.zeros((len(noise.times_s), len(kinds), len(self.sites))) for noise in self.noise]
        for k, (rows, factor) in enumerate(kinds):
            for row, noise, columns in zip(rows, self.noise, found, strict=True):
                columns[:, k, self.sites.index(noise.site_name)] = factor * row
        return tuple(columns.reshape(len(columns), -1) for columns in found)

    @property
    def site_deviations(self) -> tuple[Array, ...]:
        """Those of the `shared_deviations` that come from the sites' stiffness: (n, sites) per record."""
        return tuple(
            row[:, row.shape[1] - len(self.sites) * bool(self.site_N) :] for row in self.shared_deviations
        )

    def own_covariance(self, i: int) -> Array:
        """Covariance (n, n) of what record i shares with no other: its noise and its misfit."""
        return self.noise[i].covariance + self.misfit_covariance(i)

    def solve(self, rows: Sequence[Array]) -> list[Array]:
        """Return the inverse covariance of all records times ``rows`` (n, k) of each, record by record."""
        factors = [cho_factor(self.own_covariance(i)) for i in range(len(self.noise))]
        found = [cho_solve(factor, one) for factor, one in zip(factors, rows, strict=True)]
        shared = self.shared_deviations
        if not shared[0].shape[1]:
            return found
        known = [cho_solve(factor, one) for factor, one in zip(factors, shared)]
        inner = np.eye(shared[0].shape[1]) + sum(E.T @ K for E, K in zip(shared, known))
        amount = np.linalg.solve(inner, sum(E.T @ one for E, one in zip(shared, found)))
        return [one - K @ amount for one, K in zip(found, known)]

    def misfit_covariance(self, i: int) -> Array:
        """Covariance (n, n) of the misfit of record i."""
        noise = self.noise[i]
        shape = compute_matern(noise.times_s, self.correlation)
        shape = shape if noise.similarity is None else shape * noise.similarity
        return (self.misfit[i] * self.peaks_N[i]) ** 2 * shape

    def covariance(self, i: int) -> Array:
        """Covariance (n, n) of the residuals of record i."""
        return self.own_covariance(i) + self.shared_deviations[i] @ self.shared_deviations[i].T

    def effective_samples(self) -> float:
        """The number of independent residuals: n^2 / ||R||^2 of the correlations R, summed over records."""
        total = 0.0
        for i in range(len(self.noise)):
            C = self.covariance(i)
            sd = np.sqrt(np.diag(C))
            total += len(C) ** 2 / float(np.sum((C / np.outer(sd, sd)) ** 2))
        return total

    def compute_spectra(self) -> tuple[Spectrum, ...]:
        """Return the spectrum of each record, without what it shares with others."""
        return tuple(
            Spectrum.from_covariances(noise.covariance, self.misfit_covariance(i))
            for i, noise in enumerate(self.noise)
        )


@dataclass(frozen=True)
class Spectrum:
    """A record's residuals in coordinates in which noise has variance 1 and misfit ``values`` (n,)."""

    transform: Array
    values: Array
    log_determinant: float  # of the noise

    @classmethod
    def from_covariances(cls, noise: Array, misfit: Array) -> Spectrum:
        L = cholesky(noise, lower=True)
        inner = solve_triangular(L, solve_triangular(L, misfit, lower=True).T, lower=True)
        values, vectors = eigh((inner + inner.T) / 2)
        transform = solve_triangular(L, vectors, lower=True, trans="T").T
        return cls(transform, np.maximum(values, 0.0), 2 * float(np.log(np.diag(L)).sum()))


def estimate_discrepancy(
    residuals: Sequence[Array],
    jacobians: Sequence[Array],
    noise: Sequence[SiteNoise],
    peaks_N: Array,
    precision: Array,
    mesh_N: Sequence[Array] = (),
    site_N: Sequence[Array] = (),
) -> ResidualModel:
    """Estimate size and correlation of the misfit from residuals (n,) and derivatives (n, p) per record.

    The derivatives are with respect to the logarithms of the parameters. ``precision`` (p, p) is what is
    known of these beforehand, ``mesh_N`` (n,) per record the error of the mesh, which records of one site
    have in common, and ``site_N`` (n,) what is expected of the site's own stiffness. Misfits are similar
    within a factor of about two, and sites as far off as expected within a factor of four, unless the
    residuals say otherwise.
    """
    best: tuple[float, Array, float, _RestrictedLikelihood] | None = None
    unit = np.ones(len(noise))
    model = ResidualModel(
        tuple(noise), np.asarray(peaks_N), unit, 0.0, 0.0,
        mesh_N=tuple(mesh_N), site_N=tuple(site_N),
    )  # fmt: skip
    start = np.array([_guess_misfit(r, s, p) for r, s, p in zip(residuals, noise, peaks_N)])
    bounds = [(np.log(_MIN_MISFIT), np.log(_MAX_MISFIT))] * len(start)
    if site_N:
        start, bounds = np.append(start, 0.0), [*bounds, tuple(np.log(_SITE_FACTOR_BOUNDS))]
    for correlation in CORRELATION_LENGTHS:
        rows = _RestrictedLikelihood(residuals, jacobians, replace(model, correlation=correlation), precision)
        optimum = minimize(rows.criterion, start, jac=True, method="L-BFGS-B", bounds=bounds)
        if best is None or optimum.fun < best[0]:
            best = float(optimum.fun), optimum.x, correlation, rows
        start = optimum.x
    assert best is not None
    value, logs, correlation, rows = best
    return replace(
        model,
        misfit=np.exp(logs[: len(noise)]),
        site_factor=float(np.exp(logs[-1])) if site_N else 1.0,
        site_factors=rows.sample_site_factors(logs) if site_N else np.ones(1),
        correlation=correlation,
        known_scale=rows.known_scale(logs),
        criterion=value,
    )


def estimate_mesh_misfit(
    mesh_N: Sequence[Array],
    jacobians: Sequence[Array],
    noise: Sequence[SiteNoise],
    peaks_N: Array,
    precision: Array,
    site_N: Sequence[Array] = (),
) -> MeshMisfit | None:
    """Estimate the misfit that a study sees in records of a limb that its model describes, on another mesh.

    The errors ``mesh_N`` (n,) of the mesh, from the difference of two, take the place of the residuals of
    `estimate_discrepancy`, which has the other arguments. None if no record's error is known.
    """
    chosen = [i for i, error in enumerate(mesh_N) if np.any(error)]
    if not chosen:
        return None
    found = estimate_discrepancy(
        [mesh_N[i] for i in chosen],
        [jacobians[i] for i in chosen],
        [noise[i] for i in chosen],
        np.asarray(peaks_N)[chosen],
        precision,
        site_N=[site_N[i] for i in chosen] if site_N else (),
    )
    return MeshMisfit(found.misfit_elsewhere, found.correlation)


def _guess_misfit(residual: Array, noise: SiteNoise, peak: float) -> float:
    excess = max(float(np.mean(residual**2) - np.trace(noise.covariance) / residual.size), 0.0)
    return float(np.log(np.clip(np.sqrt(excess) / peak, 10 * _MIN_MISFIT, 0.5)))


class _RestrictedLikelihood:
    """All records in coordinates in which the misfit of ``unit``, of the size of the largest forces, is
    diagonal.

    What records share are further unknowns, known beforehand to one standard deviation. The logarithms are
    those of the misfits and last, if sites may be off as a whole, that of the site factor.
    """

    def __init__(
        self, residuals: Sequence[Array], jacobians: Sequence[Array], unit: ResidualModel, precision: Array
    ) -> None:
        spectra = unit.compute_spectra()
        self.records = len(spectra)
        self.site = np.concatenate([np.full(len(s.values), i) for i, s in enumerate(spectra)])
        self.values = np.concatenate([s.values for s in spectra])
        self.residual = np.concatenate([s.transform @ r for s, r in zip(spectra, residuals)])
        both = [np.hstack([J, E]) for J, E in zip(jacobians, unit.shared_deviations, strict=True)]
        self.jacobian = np.concatenate([s.transform @ J for s, J in zip(spectra, both)])
        self.known = block_diag(precision, np.eye(unit.shared_deviations[0].shape[1]))
        self.places = len(unit.sites) if unit.site_N else 0  # the last unknowns

    def variances(self, logs: Array) -> Array:
        return 1.0 + np.exp(2 * logs[: self.records])[self.site] * self.values

    def precision(self, logs: Array) -> Array:
        """What is known of the unknowns beforehand."""
        found = self.known.copy()
        if self.places:
            last = np.arange(len(found))[-self.places :]
            found[last, last] = np.exp(-2 * logs[-1])
        return found

    def criterion(self, logs: Array) -> tuple[float, Array]:
        """Return minus twice the restricted log-likelihood with the prior on sites, and its gradient."""
        variances, precision = self.variances(logs), self.precision(logs)
        share = (variances - 1) / variances
        J = self.jacobian / variances[:, None]
        A = self.jacobian.T @ J + precision
        inverse = np.linalg.inv(A)
        step = inverse @ (J.T @ self.residual)
        left = self.residual - self.jacobian @ step
        fit = left**2 / variances
        leverage = np.einsum("ni,ij,nj->n", J, inverse, self.jacobian)
        misfits = logs[: self.records]
        from_mean = misfits - misfits.mean()
        value = (
            float(fit.sum() + step @ precision @ step + np.log(variances).sum())
            + float(np.linalg.slogdet(A)[1])
            + float(from_mean @ from_mean) / _MISFIT_SD_LOG**2
        )
        slope = 2 * np.bincount(self.site, share * (1 - fit - leverage), minlength=self.records)
        slope = slope + 2 * from_mean / _MISFIT_SD_LOG**2
        if not self.places:
            return value, slope
        moved = step[-self.places :] ** 2 + np.diag(inverse)[-self.places :]
        off = logs[-1] / _SITE_FACTOR_SCALE_LOG
        value += 2 * self.places * logs[-1] + 2 * np.log1p(off**2)
        of_prior = 4 * off / (1 + off**2) / _SITE_FACTOR_SCALE_LOG
        of_sites = 2 * (self.places - np.exp(-2 * logs[-1]) * moved.sum()) + of_prior
        return value, np.append(slope, of_sites)

    def sample_site_factors(self, logs: Array) -> Array:
        """Return equally likely values of the site factor (m,): quantiles of its posterior.

        The misfits stay where they are.
        """
        values = np.array([self.criterion(np.append(logs[:-1], one))[0] for one in _SITE_FACTOR_GRID])
        below = np.cumsum(np.exp(-(values - values.min()) / 2))
        levels = (np.arange(_SITE_FACTORS) + 0.5) / _SITE_FACTORS
        return np.exp(np.interp(levels, below / below[-1], _SITE_FACTOR_GRID))

    def known_scale(self, logs: Array) -> float:
        """Twice the information on the log of the misfit's variance (Satterthwaite's degrees of freedom)."""
        variances = self.variances(logs)
        share = (variances - 1) / variances
        half = self.jacobian / np.sqrt(variances)[:, None]
        A = half.T @ half + self.precision(logs)
        inner = half.T @ (share[:, None] * half)
        solved = np.linalg.solve(A, inner)
        double = np.linalg.solve(A, half.T @ (share[:, None] ** 2 * half))
        return float(np.sum(share**2) - 2 * np.trace(double) + np.trace(solved @ solved))
