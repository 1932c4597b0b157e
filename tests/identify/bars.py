"""A closed-form viscoelastic model whose truth is known, to be identified.

At each site incompressible bars, one of each tissue, compressed together between plates
(uniaxial stress, second-order Ogden, quasi-linear viscoelasticity of the nominal stress). Bars differ in
length and section from site to site, as tissue does. Derivatives come by complex step, exact to rounding.
"""

from dataclasses import dataclass

import numpy as np

from limbfit.identify.fit.objective import MeasuredCurve, SiteResponse
from limbfit.identify.fit.parameters import Unknowns
from limbfit.identify.uncertainty.intervals import EvaluationStore
from limbfit.identify.uncertainty.noise import estimate_curve_noise
from limbfit.identify.uncertainty.uncertainty import Uncertainty, estimate_uncertainty

NAMES = tuple(
    f"{tissue}.{name}" for tissue in ("skin", "muscle") for name in ("c_kPa", "m", "gamma", "tau_s")
)
TRUTH = np.array([9.0, 6.0, 2.0, 0.5, 4.0, 4.0, 3.0, 0.3])
# The paper's start and bounds (section 2.3, table 1).
PAPER = Unknowns(
    NAMES,
    np.tile([4.7, 3.0, 1.2, 2.0], 2),
    np.tile([0.047, 2.0, 0.01, 0.01], 2),
    np.tile([47.0, 20.0, 10.0, 10.0], 2),
)


@dataclass(frozen=True)
class Bars:
    """A site: sections in mm^2 and lengths in mm of each tissue's bar, depth in mm at 0.96 mm/s."""

    sections: tuple[float, ...]
    lengths: tuple[float, ...]
    depth: float
    points: int = 60

    @property
    def times_s(self) -> np.ndarray:
        """Evenly spread times (points,) of loading and unloading."""
        return np.linspace(0, 2 * self.depth / 0.96, self.points)

    @property
    def travel(self) -> np.ndarray:
        """How far the bars are pressed (points,) mm."""
        ramps = np.minimum(self.times_s, self.times_s[-1] - self.times_s)
        return np.minimum(0.96 * ramps, self.depth)

    def split(self, p: np.ndarray) -> np.ndarray:
        """Elastic force (..., tissues, points) N of each bar, of parameters (..., p)."""
        c, m = np.moveaxis(p.reshape(*p.shape[:-1], -1, 4), -1, 0)[:2, ..., None]
        stretch = 1 - self.travel / np.array(self.lengths)[:, None]
        half = stretch ** (m / 2)
        stress = -c * 1e-3 / m * (half**2 - half**-2 - 1 / half + half) / stretch
        return np.array(self.sections)[:, None] * stress

    def remember(self, elastic: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """What relaxation by times ``tau`` (...) s leaves of the rises of a force (..., points)."""
        x = np.moveaxis(np.diff(self.times_s) / tau[..., None], -1, 0)
        decays = np.exp(-x)
        rises = (1 - decays) / x * np.moveaxis(np.diff(elastic), -1, 0)
        history = [np.zeros_like(rises[0])]
        for decay, rise in zip(decays, rises):
            history.append(decay * history[-1] + rise)
        return np.stack(history, axis=-1)

    def force(self, p: np.ndarray) -> np.ndarray:
        """Force (..., points) N of parameters (..., p)."""
        elastic = self.split(p)
        gamma, tau = np.moveaxis(p.reshape(*p.shape[:-1], -1, 4), -1, 0)[2:]
        return (elastic + gamma[..., None] * self.remember(elastic, tau)).sum(axis=-2)

    def respond(self, p: np.ndarray) -> SiteResponse:
        step = 1e-30
        return SiteResponse(self.force(p), self.force(p + 1j * step * np.eye(len(p))).imag.T / step)


SITES = (
    Bars((320.0, 60.0), (14.0, 20.0), 4.0),
    Bars((250.0, 150.0), (11.0, 18.0), 3.5),
    Bars((120.0, 380.0), (20.0, 24.0), 6.0),
    Bars((60.0, 420.0), (25.0, 22.0), 7.0),
)


def simulate_at(sites):
    """What simulates these sites, in their order."""
    return lambda parameters: [site.respond(parameters) for site in sites]


simulate = simulate_at(SITES)


def records(noise: float = 0.0, seed: int = 0, truth: np.ndarray = TRUTH, sites=SITES) -> list[MeasuredCurve]:
    rng = np.random.default_rng(seed)
    forces = [site.force(truth) for site in sites]
    return [MeasuredCurve(f"s{k}", f + noise * rng.standard_normal(f.size)) for k, f in enumerate(forces)]


THREE = tuple(f"{tissue}.{name.split('.')[1]}" for tissue in ("skin", "fat", "muscle") for name in NAMES[:4])
TRUE_THREE = np.array([9.0, 6.0, 2.0, 0.5, 2.0, 4.0, 1.0, 1.5, 5.0, 5.0, 3.0, 0.2])
BARS = tuple(
    Bars(sections, lengths, depth)
    for sections, lengths, depth in (
        ((320.0, 60.0, 40.0), (14.0, 20.0, 18.0), 4.0),
        ((60.0, 500.0, 40.0), (18.0, 16.0, 25.0), 5.0),
        ((40.0, 80.0, 380.0), (20.0, 24.0, 17.0), 6.0),
        ((250.0, 250.0, 20.0), (11.0, 15.0, 20.0), 3.5),
        ((20.0, 250.0, 300.0), (20.0, 22.0, 26.0), 7.0),
        ((200.0, 20.0, 250.0), (16.0, 20.0, 14.0), 4.5),
    )
)


def three_tissues(**own: list[float]) -> Unknowns:
    """Three tissues with the paper's start and bounds; ``own`` are starts by tissue."""
    starts = [own.get(tissue, PAPER.start[:4]) for tissue in ("skin", "fat", "muscle")]
    return Unknowns(THREE, np.concatenate(starts), np.tile(PAPER.lower[:4], 3), np.tile(PAPER.upper[:4], 3))


respond_three = simulate_at(BARS)


def estimate(parameters, responses, data, unknowns=PAPER, **how) -> Uncertainty:
    """What records tell of parameters with these responses; their noise is the scatter of neighbours."""
    noise = estimate_curve_noise(responses, data)
    return estimate_uncertainty(parameters, responses, data, unknowns, noise, **how)


class Counted:
    """A simulation that counts its calls, fails at random, or in a part of the parameter space."""

    def __init__(self, failing: float = 0.0, seed: int = 0, forbidden=lambda p: False):
        self.calls, self.failing, self.forbidden = 0, failing, forbidden
        self.rng = np.random.default_rng(seed)

    def __call__(self, parameters):
        self.calls += 1
        responses = simulate(parameters)
        for k, response in enumerate(responses):
            if self.rng.random() < self.failing or self.forbidden(parameters):
                half = np.where(np.arange(response.force_N.size) < 30, response.force_N, np.nan)
                responses[k] = SiteResponse(half, response.jacobian, False, "did not converge")
        return responses


def coarsened(parameters):
    """The same sites on a mesh that is too stiff, by 3 to 9 %, more so where the tissue stiffens more."""
    responses = []
    for k, site in enumerate(SITES):
        factor = 1.03 + 0.015 * k

        def biased(p, site=site, factor=factor):
            return factor * site.force(p * np.array([1.03, 1.0, 0.98, 1.02, 1.02, 1.01, 1.0, 0.99]))

        derivatives = biased(parameters + 1e-30j * np.eye(len(parameters))).imag.T / 1e-30
        responses.append(SiteResponse(biased(parameters), derivatives))
    return responses


def storing(store: EvaluationStore, simulation):
    """The same simulation, whose evaluations are stored."""

    def simulate_and_store(parameters):
        responses = simulation(parameters)
        store.add(parameters, responses)
        return responses

    return simulate_and_store


def plain(parameters):
    """Forces of the true sites, no derivatives."""
    return [SiteResponse(site.force(parameters), np.zeros((site.points, 0))) for site in SITES]
