"""What is known of relaxation beyond the records: fits with other relaxations, without a simulation.

Fitted to the records of force are the model's own terms alone, the same with a modulus that goes on to fall
as ``(1 + t/T)^-s``, T being the longest load in the records, a spectrum of fixed times whose amplitudes are a
power of time (`superposition`), and, where the records ask for it, the model's and a further term with and
without that fall. They are weighed by their restricted likelihoods, each with a misfit of its own. Up to T
these fits say how far the modulus is known. Beyond T it falls as ``(t/T)^-s``: no record shows that part. All
that is known of s is that it lies between 0 and what tissues have at most (`MAX_SLOPE`), so that intervals
hold for every such s: they reach from the one end to the other.

A force that falls slowly and by little looks the same if the limb gives way to the indenter. So each fit with
a tail, or with a further term that is slow and small, counts twice, half with that as relaxation, half
without. Where the records prefer such fits, `RelaxationAssessment.describe` says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.special import expit, logsumexp, softmax

from ...arrays import Array
from ...results.identification import LongTermModulus, RelaxationBeyond, RelaxationPrior, RelaxationSummary
from ..fit.objective import SiteResponse
from ..fit.parameters import SearchSpace
from ..fit.prediction import NORMAL_95, RelaxationSpread
from ..fit.trust_region import SearchPoint, minimise
from .discrepancy import estimate_discrepancy
from .superposition import RelaxationModel, Superposition, TissueParameters, find_tissue_parameters
from .uncertainty import DETERMINED, WEAK, PriorPrecision, Uncertainty, choose_verdict

# Slopes of log G over log t. Muscle: 0.25 in vivo (Klatt et al. 2010); six pieces ex vivo (Iaquinta 2023,
# perineal_indentation): 0.13 to 0.16 before 1 s, 0.18 to 0.22 from 3 to 10 s.
MAX_SLOPE = 0.3
SOURCE = (
    "muscle has a slope of 0.25 in vivo (Klatt et al. 2010, doi 10.1088/0031-9155/55/21/007) and of 0.13 to "
    "0.22 between 0.3 and 10 s ex vivo (Iaquinta, perineal_indentation)"
)
_TAIL_SLOPES = (0.1, 0.2, 0.3)
_SPECTRUM_SLOPES = (0.0, 0.1, 0.2, 0.3)
_SPECTRUM_START = 0.3, 3.0  # amplitude and end, where fits of a spectrum begin
_SHORTEST, _LONGEST, _SPECTRUM_TIMES = 0.02, 30.0, 12  # of the shortest ramp; of the longest load
OWN, FURTHER, POWER_LAW, UNDECIDED = "the model's terms", "a further term", "a power law", "undecided"
NOT_LONG_TERM = "determined at {}; its long-term value not"
NOT_ALONE = "not determined: another relaxation fits as well"
GIVES_WAY = (
    "the force falls slowly until the records end: a limb that gives way to the indenter looks the same, and "
    "its tissue is stiffer in the long term; intervals count both, and are narrower where the limb is held"
)
_MIN_WEIGHT = 0.5  # of slow fits, from which a limb may give way; of a further term, to be preferred
_FURTHER_AMPLITUDES = (0.01, 10.0)  # of the modulus: bounds of a further term
_SLOW = 0.5  # of the shortest ramp: from which a further term is
_MAX_GIVEN_WAY = 0.3  # of the force: by how much a limb that recedes may seem to relax
_FURTHER_STARTS = (0.1, 10.0, 100.0)  # of the model's first time: where the fits of a further term begin
MIN_OWN_WEIGHT = 0.1  # of the answer: no other relaxation is quite that of the tissue
LONG_TERM_S = 3600.0  # after which a modulus is long-term: a socket worn for an hour
STATED_S = (1.0, 10.0)  # at which moduli are stated
_DURATIONS_S = np.geomspace(1.0, 10 * LONG_TERM_S, 19)
_STRONG_EVIDENCE = 6.0  # of twice the log of the ratio of two evidences (Kass and Raftery 1995)
_MAX_FIT_STEPS, _FURTHER_FIT_STEPS, _FIT_TOLERANCE = 25, 5, 1e-3
_ALIKE = 0.01  # of the largest force: with which a fit begins
_DIFFERENCE = 1e-3
_IN_CONTACT = 0.01  # of the largest force


@dataclass(frozen=True)
class _Fit:
    """A relaxation fitted to the records: z (k,), covariance (k, k), -2 log evidence, and mean log misfit."""

    relaxation: RelaxationModel
    z: Array
    covariance: Array
    criterion: float
    misfit_log: float


@dataclass(frozen=True)
class RelaxationAssessment:
    """Which relaxations fit the records at the ``known`` answer, and what they leave open.

    ``evidence`` is twice the logarithm of how much more probable the records are with other relaxations than
    with the model's own terms. ``further_weight`` and ``tail_weight`` are the parts of the weights that fits
    with a further term have, and those in which the limb may give way. ``spread`` is what they leave open of
    each tissue's modulus at any time.
    """

    known: Uncertainty
    tissues: tuple[TissueParameters, ...]
    evidence: float
    further_weight: float
    tail_weight: float
    spread: RelaxationSpread

    @property
    def preferred_model(self) -> str:
        """Which relaxation the records prefer, if they tell."""
        if abs(self.evidence) < _STRONG_EVIDENCE:
            return UNDECIDED
        if self.evidence < 0:
            return OWN
        return FURTHER if self.further_weight > _MIN_WEIGHT else POWER_LAW

    def state_modulus(self, number: int, duration_s: float) -> tuple[float, Array]:
        """Return the model's modulus so long after a step, and the 95 % interval (2,) that holds it; kPa."""
        tissue, p = self.tissues[number], self.known.parameters
        at = tissue.modulus_log(p, duration_s)
        steps = np.exp(_DIFFERENCE * np.eye(len(p)))
        slopes = np.array([tissue.modulus_log(p * step, duration_s) - at for step in steps]) / _DIFFERENCE
        shift, covariance, fall = self.spread.interpolate(duration_s)
        i, weight = tissue.moduli[0], self.spread.own_weight
        half = NORMAL_95 * np.sqrt(weight * slopes @ self.known.covariance @ slopes + covariance[i, i])
        off = weight * float(slopes @ np.log(self.known.centre / p))
        ends = at + shift[i] + np.array([min(off, 0.0) - half - fall[i], max(off, 0.0) + half])
        return float(np.exp(at)), np.exp([min(ends[0], at), max(ends[1], at)])

    def describe(self) -> list[str]:
        """Return what the records tell of relaxation, in sentences."""
        longest = f"the records, whose longest load lasts {self.spread.longest_s:.0f} s,"
        preferred = {
            OWN: f"{longest} prefer the relaxation of the model to a power law of time",
            FURTHER: f"{longest} prefer a further relaxation time to the model's alone",
            POWER_LAW: f"{longest} prefer relaxation as a power of time to that of the model",
            UNDECIDED: f"{longest} cannot tell the relaxation of the model from a power law of time",
        }
        found = [f"{preferred[self.preferred_model]} (2 ln B = {abs(self.evidence):.0f})"]
        if self.preferred_model in (FURTHER, POWER_LAW) and self.tail_weight > _MIN_WEIGHT:
            found.append(GIVES_WAY)
        for number, tissue in enumerate(self.tissues):
            modulus, (low, high) = self.state_modulus(number, LONG_TERM_S)
            found.append(
                f"{tissue.name}: an hour after a step the modulus is {low:.3g} to {high:.3g} kPa (95 %); "
                f"the model has {modulus:.3g} kPa"
            )
        return found

    def summarise(self) -> RelaxationSummary:
        """Return what is stored, with moduli at `STATED_S` and `LONG_TERM_S`."""
        moduli = []
        for (number, tissue), time in product(enumerate(self.tissues), (*STATED_S, LONG_TERM_S)):
            value, (low, high) = self.state_modulus(number, time)
            moduli.append(
                LongTermModulus(tissue=tissue.name, time_s=time, modulus_kPa=value, interval_95=(low, high))
            )
        return RelaxationSummary(
            prefers=self.preferred_model,
            evidence=self.evidence,
            tail_weight=self.tail_weight,
            words=self.describe(),
            moduli=moduli,
            prior=RelaxationPrior(slope=(0.0, MAX_SLOPE), source=SOURCE),
            beyond=RelaxationBeyond.model_validate(self.spread),
        )


def limit_verdicts(
    verdicts: Sequence[str], known: Uncertainty, relaxation: RelaxationSummary | None
) -> tuple[str, ...]:
    """Return ``verdicts`` (p,) on the ``known`` parameters for what relaxation beyond the records leaves.

    A modulus is as well determined as `LONG_TERM_S` after a step, amplitudes and times if the records prefer
    the model's terms to other relaxations. Where relaxation was not assessed, verdicts stay.
    """
    qualified = list(verdicts)
    for tissue in find_tissue_parameters(known.names, known.space) if relaxation else ():
        assert relaxation is not None
        for i in (*tissue.amplitudes, *tissue.times):
            if verdicts[i] in (DETERMINED, WEAK) and relaxation.prefers != OWN:
                qualified[i] = NOT_ALONE
        after = {
            one.time_s: choose_verdict(float(np.sqrt(one.interval_95[1] / one.interval_95[0])), 0.0)
            for one in relaxation.moduli
            if one.tissue == tissue.name
        }
        modulus, long_term = tissue.moduli[0], after[LONG_TERM_S]
        if verdicts[modulus] in (DETERMINED, WEAK) and long_term != DETERMINED:
            times = [f"{time:g} s" for time in STATED_S if after[time] == DETERMINED]
            qualified[modulus] = NOT_LONG_TERM.format(" and ".join(times)) if times else long_term
    return tuple(qualified)


def assess_relaxation(known: Uncertainty, responses: Sequence[SiteResponse]) -> RelaxationAssessment | None:
    """Fit other relaxations to the records of force, and weigh them; nothing is simulated.

    ``responses`` are those at the ``known`` answer. None where no record is of force under a stated
    displacement, or no tissue relaxes.
    """
    tissues = find_tissue_parameters(known.names, known.space)
    chosen = [i for i, noise in enumerate(known.residual_model.noise) if noise.unit == "N"]
    if not chosen or not all(tissue.amplitudes for tissue in tissues):
        return None
    records = _ForceRecords(known, [responses[i] for i in chosen], chosen, tissues)
    longest = records.longest_s
    times = np.geomspace(*records.span_s, _SPECTRUM_TIMES)
    relaxations = [RelaxationModel(), *(RelaxationModel(slope, longest) for slope in _TAIL_SLOPES)]
    relaxations += [RelaxationModel(slope, longest, times) for slope in _SPECTRUM_SLOPES]
    fits = [records.fit(relaxation, records.build_start(relaxation)) for relaxation in relaxations]
    fits += records.fit_further_terms(min(fit.criterion for fit in fits))
    weights, evidence = _weigh(fits)
    # The model's own terms keep the answer, whose covariance is counted with it.
    fits[0] = replace(fits[0], z=records.answer, covariance=0 * fits[0].covariance)
    readings = [records.list_readings(fit) for fit in fits]
    parts = [(fit, one, share / len(own)) for fit, share, own in zip(fits, weights, readings) for one in own]
    durations = np.unique(np.r_[_DURATIONS_S, longest])  # between these all is linear, but for that corner
    shifts, covariances = zip(*(records.spread(parts, t) for t in durations), strict=True)
    is_modulus = np.array([name.endswith("_kPa") for name in known.names])
    falls = MAX_SLOPE * np.outer(np.log(np.maximum(durations / longest, 1.0)), is_modulus)
    spread = RelaxationSpread(
        longest, float(weights[0]), durations, np.array(shifts), np.array(covariances), falls
    )
    tails = float(weights[[len(own) > 1 for own in readings]].sum())
    furthers = float(weights[[fit.relaxation.has_further for fit in fits]].sum())
    return RelaxationAssessment(known, tissues, evidence, furthers, tails, spread)


def _weigh(fits: Sequence[_Fit]) -> tuple[Array, float]:
    """Return the weights (w,), the model's own terms first, and the evidence for the other relaxations."""
    half = -0.5 * np.array([fit.criterion for fit in fits])
    evidence = float(2 * (logsumexp(half[1:]) - np.log(len(half) - 1) - half[0]))
    # Where relaxation explains little of the misfit, as of sites that differ, it is not what the model lacks.
    left = float(np.exp(fits[1 + int(np.argmax(half[1:]))].misfit_log - fits[0].misfit_log))
    own = max(float(expit(-evidence / 2)), min(left, 1.0), MIN_OWN_WEIGHT)
    return np.r_[own, (1 - own) * softmax(half[1:])], evidence


class _ForceRecords:
    """The records of force, and how well their residuals are known.

    Every fit is over the model's unknowns and, for each tissue that relaxes freely, amplitude and time of a
    further term (k,). Only fits with that term use them; what is known of them beforehand counts in all.
    """

    def __init__(
        self,
        known: Uncertainty,
        responses: Sequence[SiteResponse],
        chosen: Sequence[int],
        tissues: tuple[TissueParameters, ...],
    ) -> None:
        """Take the records of the numbers ``chosen``, whose ``responses`` are those at the answer."""
        self.count = len(known.parameters)
        self.model = known.residual_model.select(chosen)
        self.measured = [known.measured[i] for i in chosen]
        pairs = [(one.times_s, r) for one, r in zip(self.model.noise, responses, strict=True)]
        self.shortest_ramp_s = min(float(times[int(np.argmax(r.force_N))] - times[0]) for times, r in pairs)
        self.longest_s = max(_find_longest_load(times, r.force_N) for times, r in pairs)
        self.span_s = _SHORTEST * self.shortest_ramp_s, _LONGEST * self.longest_s
        self._add_further_terms(known, tissues)
        self.superpositions = [Superposition(times, r, known.parameters, self.tissues) for times, r in pairs]

    def _add_further_terms(self, known: Uncertainty, tissues: Sequence[TissueParameters]) -> None:
        free = [tissue.name for tissue in tissues if not tissue.is_given]
        further = {name: (self.count + 2 * i, self.count + 2 * i + 1) for i, name in enumerate(free)}
        self.tissues = tuple(replace(one, further=further.get(one.name, ())) for one in tissues)
        bounds = np.tile(np.log([_FURTHER_AMPLITUDES, self.span_s]), (len(free), 1))
        middle, space = bounds.mean(axis=1), known.space
        self.parameters = np.r_[known.parameters, np.exp(middle)]
        self.space = SearchSpace(
            np.r_[space.fixed_log, 0.0 * middle],
            block_diag(space.tie, np.eye(len(bounds))),
            np.r_[space.lower, bounds[:, 0]],
            np.r_[space.upper, bounds[:, 1]],
            np.r_[space.fixed_values, np.exp(middle)],
        )
        self.answer = self.space.reduce(np.log(self.parameters))
        stated = PriorPrecision.from_unknowns(known.unknowns, space)
        rows = np.pad(stated.rows, ((0, 0), (0, len(bounds))))
        self.prior = PriorPrecision(self.space.bounds_sd, rows, stated.target)

    def build_start(self, relaxation: RelaxationModel, factor: float = 1.0) -> Array:
        """Where the fit of a relaxation (k,) begins; a further time is a factor times the model's first."""
        p = self.parameters.copy()
        for tissue in self.tissues:
            if relaxation.spectrum_s is not None and not tissue.is_given:
                p[[tissue.amplitudes[0], tissue.times[0]]] = _SPECTRUM_START
            if relaxation.has_further and tissue.further:
                p[tissue.further[1]] = factor * p[tissue.times[0]]
        return self.space.reduce(np.log(p))

    def fit_further_terms(self, least: float) -> list[_Fit]:
        """Fits with a further term, with and without a tail, of which the records ask for it.

        ``least`` is the criterion of the fits without. A term that the records do not ask for is another
        relaxation once more.
        """
        terms = RelaxationModel(longest_s=self.longest_s, has_further=True)
        starts = [self.build_start(terms, factor) for factor in _FURTHER_STARTS]
        best = min((self.fit(terms, start) for start in starts), key=lambda fit: fit.criterion)
        fits = [best, *(self.fit(replace(terms, slope=slope), best.z) for slope in _TAIL_SLOPES)]
        return [fit for fit in fits if fit.criterion < least - _STRONG_EVIDENCE]

    def list_readings(self, fit: _Fit) -> list[RelaxationModel]:
        """The relaxation of a fit and, if it may be that of a limb that gives way, what is left without."""
        own, held_s, p = fit.relaxation, _SLOW * self.shortest_ramp_s, self.space.expand(fit.z)
        if own.spectrum_s is not None:
            return [own]
        held = RelaxationModel(has_further=own.has_further, held_s=held_s)
        force, force_held = (
            sum(float(one.respond(relaxation, p).force_N.sum()) for one in self.superpositions)
            for relaxation in (own, held)
        )
        return [own, held] if 1.0 < force_held / force < 1.0 + _MAX_GIVEN_WAY else [own]

    def fit(self, relaxation: RelaxationModel, start: Array) -> _Fit:
        """Fit a relaxation, first with equal errors everywhere, then by what its residuals say of misfit."""
        alike_N = _ALIKE * np.concatenate([np.full(len(one.force_N), one.peak_N) for one in self.measured])
        z, _ = self._solve(relaxation, start, lambda rows: rows / alike_N[:, None], _MAX_FIT_STEPS)
        found = estimate_discrepancy(self.model, *self._linearise(relaxation, z), self.prior.precision)
        stated = self.prior.compute_deviations(z)
        whiten = partial(solve_triangular, np.linalg.cholesky(found.covariance), lower=True)
        z, covariance = self._solve(relaxation, z, whiten, _FURTHER_FIT_STEPS)
        criterion = found.criterion + float(stated @ stated)
        return _Fit(relaxation, z, covariance, criterion, float(np.mean(np.log(found.misfit))))

    def _solve(
        self, relaxation: RelaxationModel, z: Array, whiten: Callable[[Array], Array], steps: int
    ) -> tuple[Array, Array]:
        """Generalised least squares from z (k,) on, of rows (N, ...) that ``whiten`` gives unit errors; the
        answer and its covariance (k, k)."""
        prior = self.prior

        def evaluate(z: Array) -> SearchPoint:
            residuals, scaled = self._linearise(relaxation, z)
            rows = np.column_stack([np.concatenate(residuals), np.concatenate(scaled)])
            known = np.column_stack([(z - self.answer) / prior.sd, np.diag(1.0 / prior.sd)])
            stated = np.column_stack([prior.compute_deviations(z), prior.rows])
            whole = np.concatenate([whiten(rows), known, stated])
            return SearchPoint(z, whole[:, 0], whole[:, 1:])

        point, bounds = evaluate(z), (self.space.lower, self.space.upper)
        for step in minimise(evaluate, point, *bounds, tolerance=_FIT_TOLERANCE, max_iterations=steps):
            point = step.point
        return point.z, np.asarray(np.linalg.inv(point.jacobian.T @ point.jacobian))

    def _linearise(self, relaxation: RelaxationModel, z: Array) -> tuple[list[Array], list[Array]]:
        p = self.space.expand(z)
        found = [one.respond(relaxation, p) for one in self.superpositions]
        residuals = [r.force_N - one.force_N for r, one in zip(found, self.measured, strict=True)]
        return residuals, [self.space.pull_back(r.jacobian, p) for r in found]

    def spread(
        self, parts: Sequence[tuple[_Fit, RelaxationModel, float]], duration_s: float
    ) -> tuple[Array, Array]:
        """Mean (p,) and covariance (p, p) of elastic parameters at a time, over those of the answer.

        ``parts`` are fits, a reading of each, and its weight. Later than the longest load, a modulus is that
        at its end.
        """
        within, own, shares = min(duration_s, self.longest_s), RelaxationModel(), [part[2] for part in parts]
        changes, inner = [], []
        for fit, relaxation, _ in parts:
            at = self._elastic_log(relaxation, fit.z, within)
            points = fit.z + _DIFFERENCE * np.eye(len(fit.z))
            D = np.array([self._elastic_log(relaxation, z, within) - at for z in points]) / _DIFFERENCE
            changes.append(at)
            inner.append(D.T @ fit.covariance @ D)
        change = np.array(changes) - self._elastic_log(own, self.answer, duration_s)
        mean = np.array(shares) @ change
        apart, kept = change - mean, slice(self.count)
        covariance = np.einsum("w,wi,wj->ij", shares, apart, apart) + np.tensordot(shares, inner, 1)
        return mean[kept], covariance[kept, kept]

    def _elastic_log(self, relaxation: RelaxationModel, z: Array, duration_s: float) -> Array:
        """Logarithms (p,) of moduli so long after a step and of other elastic parameters; 0 of the rest."""
        p = self.space.expand(z)
        found = np.zeros(len(p))
        for tissue in self.tissues:
            elastic = [*tissue.moduli, *tissue.others]
            found[elastic] = np.log(p[elastic])
            found[list(tissue.moduli)] += np.log(relaxation.terms(tissue, p).evaluate(duration_s))
        return found


def _find_longest_load(times_s: Array, force_N: Array) -> float:
    """Return the longest time without losing contact, s."""
    loaded = np.flatnonzero(force_N > _IN_CONTACT * force_N.max())
    runs = np.split(loaded, np.flatnonzero(np.diff(loaded) > 1) + 1)
    return max(float(times_s[run[-1]] - times_s[run[0]]) for run in runs)
