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
from typing import Any

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve, eigh
from scipy.optimize import brentq, minimize
from scipy.special import ndtr, stdtrit
from scipy.stats import chi2

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


def compute_mesh_covariance(misfit: MeshMisfitSummary, times_s: Array, peak_N: float) -> Array:
    """Return the covariance (n, n) in N^2 of the mesh's misfit for a record with so large a force."""
    return (misfit.share * peak_N) ** 2 * compute_matern(times_s, misfit.correlation)


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
    correlation: float = 1.0
    known_scale: float = 0.0
    criterion: float = field(default=0.0, repr=False)
    mesh_N: tuple[Array, ...] = ()
    site_N: tuple[Array, ...] = ()
    site_factor: float = 1.0
    site_factors: Array = field(default_factory=lambda: np.ones(1))
    mesh_misfit: MeshMisfitSummary | None = None

    @cached_property
    def site_freedom(self) -> float:
        """Degrees of freedom with which Student's 95 % interval of a site's deviation is as wide as it is.

        The deviation is normal for each value of the site factor, and that is uncertain.
        """

        def compute_excess(half: float) -> float:
            return float(np.mean(ndtr(half / self.site_factors))) - 0.975

        half = brentq(compute_excess, 0.0, 10 * float(self.site_factors.max())) / self.site_factor
        half = np.clip(half, *stdtrit([MAX_FREEDOM, 1.0], 0.975))
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
            mesh_misfit=self.mesh_misfit,
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

    def _place_by_site(self, rows: Sequence[Array]) -> list[Array]:
        """Put the row (n,) of each record into its site's column: (n, sites), or (n, 0) if there are none."""
        if not rows:
            return [np.zeros((len(noise.times_s), 0)) for noise in self.noise]
        columns = dict(zip(self.sites, np.eye(len(self.sites))))
        return [np.outer(row, columns[noise.site_name]) for row, noise in zip(rows, self.noise, strict=True)]

    @property
    def site_deviations(self) -> list[Array]:
        """Per record (n, sites): one standard deviation of what each site's stiffness changes."""
        return self._place_by_site([self.site_factor * row for row in self.site_N])

    @property
    def shared_deviations(self) -> list[Array]:
        """Per record (n, q): one standard deviation of each of the q deviations that records have in common.

        First come those of the meshes, then those of the sites, each as many as there are `sites`, or none.
        """
        pairs = zip(self._place_by_site(self.mesh_N), self.site_deviations, strict=True)
        return [np.hstack(pair) for pair in pairs]

    def select(self, chosen: Sequence[int]) -> ResidualModel:
        """Return the model of the records of these numbers."""
        rows = {name: getattr(self, name) for name in ("noise", "mesh_N", "site_N")}
        picked: dict[str, Any] = {name: tuple(own[i] for i in chosen) for name, own in rows.items() if own}
        return replace(self, peaks_N=self.peaks_N[chosen], misfit=self.misfit[chosen], **picked)

    def own_covariance(self, i: int) -> Array:
        """Covariance (n, n) of what record i shares with no other: its noise and its misfit."""
        return self.noise[i].covariance + self.misfit_covariance(i)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (N, N) of the residuals of all records, one after the other."""
        shared = np.concatenate(self.shared_deviations)
        return block_diag(*(self.own_covariance(i) for i in range(len(self.noise)))) + shared @ shared.T

    def solve(self, rows: Sequence[Array]) -> list[Array]:
        """Return the inverse covariance of all records times ``rows`` (n, k) of each, record by record."""
        ends = np.cumsum([len(one) for one in rows])[:-1]
        return np.split(cho_solve(cho_factor(self.covariance), np.concatenate(rows)), ends)

    def misfit_covariance(self, i: int) -> Array:
        """Covariance (n, n) of the misfit of record i."""
        noise = self.noise[i]
        shape = compute_matern(noise.times_s, self.correlation)
        shape = shape if noise.similarity is None else shape * noise.similarity
        return (self.misfit[i] * self.peaks_N[i]) ** 2 * shape

    def effective_samples(self) -> float:
        """The number of independent residuals: n^2 / ||R||^2 of the correlations R, summed over records."""
        total = 0.0
        for i, E in enumerate(self.shared_deviations):
            C = self.own_covariance(i) + E @ E.T
            sd = np.sqrt(np.diag(C))
            total += len(C) ** 2 / float(np.sum((C / np.outer(sd, sd)) ** 2))
        return total


class Spectrum:
    """The N residuals of all records in coordinates in which noise has variance 1 and misfit is diagonal.

    What records share is left out. ``transforms`` (n, n) of each record lead there; ``values`` (N,) are the
    variances of the misfit and ``record`` (N,) the numbers of the records; ``log_determinant`` is that of the
    noise's covariance.
    """

    def __init__(self, model: ResidualModel) -> None:
        noises = [noise.covariance for noise in model.noise]
        pairs = [eigh(model.misfit_covariance(i), noise) for i, noise in enumerate(noises)]
        self.transforms = [vectors.T for _, vectors in pairs]
        self.values = np.concatenate([np.maximum(variances, 0.0) for variances, _ in pairs])
        self.record = np.repeat(np.arange(len(noises)), [len(noise) for noise in noises])
        self.log_determinant = sum(float(np.linalg.slogdet(noise)[1]) for noise in noises)

    def transform(self, rows: Array) -> Array:
        """Transform residuals (N, ...) of all records, one after the other."""
        parts = np.split(rows, np.cumsum([len(own) for own in self.transforms])[:-1])
        return np.concatenate([own @ part for own, part in zip(self.transforms, parts)])


def estimate_discrepancy(
    model: ResidualModel, residuals: Sequence[Array], jacobians: Sequence[Array], precision: Array
) -> ResidualModel:
    """Estimate size and correlation of the misfit from residuals (n,) and derivatives (n, p) per record.

    Of ``model`` noise, mesh and expected difference of the sites count; what is estimated is replaced. The
    derivatives are with respect to the logarithms of the parameters, and ``precision`` (p, p) is what is
    known of these beforehand. Misfits are similar within a factor of about two, and sites as far off as
    expected within a factor of four, unless the residuals say otherwise.
    """
    model = replace(model, misfit=np.ones(len(model.noise)), site_factor=1.0, site_factors=np.ones(1))
    excess = [
        np.mean(residual**2) - np.trace(noise.covariance) / residual.size
        for residual, noise in zip(residuals, model.noise, strict=True)
    ]
    guess = np.sqrt(np.maximum(excess, 0.0)) / model.peaks_N
    start = np.log(np.clip(guess, 10 * _MIN_MISFIT, 0.5))
    bounds = [(np.log(_MIN_MISFIT), np.log(_MAX_MISFIT))] * len(start)
    if model.site_N:
        start, bounds = np.append(start, 0.0), [*bounds, tuple(np.log(_SITE_FACTOR_BOUNDS))]
    fits = []
    for correlation in CORRELATION_LENGTHS:
        rows = _RestrictedLikelihood(residuals, jacobians, replace(model, correlation=correlation), precision)
        optimum = minimize(rows.criterion, start, jac=True, method="L-BFGS-B", bounds=bounds)
        fits.append((float(optimum.fun), optimum.x, correlation, rows))
        start = optimum.x
    value, logs, correlation, rows = min(fits, key=lambda fit: fit[0])
    found = replace(
        model,
        misfit=np.exp(logs[: len(model.noise)]),
        correlation=correlation,
        known_scale=rows.known_scale(logs),
        criterion=value,
    )
    if not model.site_N:
        return found
    return replace(found, site_factor=float(np.exp(logs[-1])), site_factors=rows.sample_site_factors(logs))


def limit_to_mean_square(
    model: ResidualModel, residuals: Sequence[Array], jacobians: Sequence[Array]
) -> ResidualModel:
    """Lower the misfits and the site factor of `estimate_discrepancy` to what residuals so small allow.

    The likelihood goes by how residuals change from one moment to the next. Residuals that are smooth but for
    a few kinks, as a wrong law of relaxation leaves where the indenter turns, seem to it a long process that
    is many times larger than they are, most of which the parameters must have absorbed. Their mean square
    tells whether that can be. Here it is compared with what is left of the model's covariance after a fit by
    least squares, by a chi-squared distribution of the same mean and variance (Satterthwaite 1946): then
    residuals as small as these have a probability of at least 2.5 %.
    """
    scale = np.concatenate([np.full(len(r), len(r) ** -0.5 / p) for r, p in zip(residuals, model.peaks_N)])
    residual, jacobian = scale * np.concatenate(residuals), scale[:, None] * np.concatenate(jacobians)
    if len(residual) <= jacobian.shape[1]:  # the fit leaves nothing that could tell
        return model
    covariance = scale[:, None] * replace(model, mesh_N=()).covariance * scale
    directions = np.linalg.qr(jacobian)[0]
    along = covariance @ directions
    within = directions.T @ along
    # Trace and squares of what is left when the fit has taken these directions.
    expected = float(np.trace(covariance) - np.trace(within))
    squares = float(np.sum(covariance**2) - 2.0 * np.sum(along**2) + np.sum(within**2))
    freedom = expected**2 / squares
    share = float(residual @ residual) / expected * freedom / chi2.ppf(0.025, freedom)
    if share >= 1.0:
        return model
    by, least = float(np.sqrt(share)), _SITE_FACTOR_BOUNDS[0]
    return replace(
        model,
        misfit=np.maximum(by * model.misfit, _MIN_MISFIT),
        site_factor=max(by * model.site_factor, least),
        site_factors=np.maximum(by * model.site_factors, least),
    )


def estimate_mesh_misfit(
    model: ResidualModel, jacobians: Sequence[Array], precision: Array
) -> MeshMisfitSummary | None:
    """Estimate the misfit that a study sees in records of a limb that its model describes, on another mesh.

    The errors of the mesh, from the difference of two, take the place of the residuals of
    `estimate_discrepancy`. None if no record's error is known.
    """
    chosen = [i for i, error in enumerate(model.mesh_N) if np.any(error)]
    if not chosen:
        return None
    own = model.select(chosen)
    found = estimate_discrepancy(
        replace(own, mesh_N=()), own.mesh_N, [jacobians[i] for i in chosen], precision
    )
    return MeshMisfitSummary(share=found.misfit_elsewhere, correlation=found.correlation)


class _RestrictedLikelihood:
    """All records in coordinates in which the misfit of ``unit``, of the size of the largest forces, is
    diagonal.

    What records share are further unknowns, known beforehand to one standard deviation. The logarithms are
    those of the misfits and last, if sites may be off as a whole, that of the site factor.
    """

    def __init__(
        self, residuals: Sequence[Array], jacobians: Sequence[Array], unit: ResidualModel, precision: Array
    ) -> None:
        spectrum, shared = Spectrum(unit), np.concatenate(unit.shared_deviations)
        self.records, self.record, self.values = len(unit.noise), spectrum.record, spectrum.values
        self.residual = spectrum.transform(np.concatenate(residuals))
        self.jacobian = spectrum.transform(np.hstack([np.concatenate(jacobians), shared]))
        self.known = block_diag(precision, np.eye(shared.shape[1]))
        self.places = len(unit.sites) if unit.site_N else 0  # the last unknowns

    def variances(self, logs: Array) -> Array:
        return 1.0 + np.exp(2 * logs[: self.records])[self.record] * self.values

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
        slope = 2 * np.bincount(self.record, share * (1 - fit - leverage), minlength=self.records)
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
        share, half = (variances - 1) / variances, self.jacobian / np.sqrt(variances)[:, None]
        A = half.T @ half + self.precision(logs)
        left = np.eye(len(half)) - half @ np.linalg.solve(A, half.T)
        return float(share @ left**2 @ share)
