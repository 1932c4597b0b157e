"""The experiment ``uncertainty``: what the records determine, and what else would change the answer."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import build_space
from ...identify.fit.prediction import NORMAL_95, RelaxationSpread, compute_force_range, compute_half_width_95
from ...identify.uncertainty.likelihood import Likelihood, compare_models, fit_alternative
from ...identify.uncertainty.posterior import Exploration, ExplorationSettings, explore_posterior
from ...identify.uncertainty.relaxation import limit_verdicts
from ...identify.uncertainty.uncertainty import (
    DETERMINED,
    GIVEN,
    UNDETERMINED,
    WEAK,
    FitSensitivity,
    Uncertainty,
    choose_verdicts,
    compute_correlation,
    compute_principal_axes,
    format_product,
)
from ...indentation import SimulationJob
from ...results import uncertainty as stored
from ...results.base import ResultPart
from ...results.identification import CalibrationResult, CorrelationMatrix, RelaxationSummary
from ...results.uncertainty import EvidenceComparison
from ...study import Study
from ..engine.context import Context
from ..engine.store import write_atomically, write_curves, write_result, write_rows, write_table
from ..identification.answer import correct_to_fine_meshes, estimate_linearised
from ..identification.predict import Answer, build_answer_jobs
from ..identification.search import CalibrationProblem, RecordSimulator, build_problem
from ..records.records import (
    SiteRecord,
    estimate_site_deviation,
    estimate_site_noise,
    load_records,
    to_response,
)
from ..simulation.simulations import SimulationCache, open_experiment_cache
from .sources import Change, simulate_sources

_NEAR = 4.0  # runs of the calibration whose error is at most this many times the least, plus 3 %, are used
NAME = "uncertainty"
EMULATOR = "emulator.npz"
_DRAWS = 1500  # written
_SHARES = {name: f"{name}_sd_percent" for name in ("parameters", "sources", "site", "noise", "misfit")}
_MOST_OFF = 0.5  # of the rise that ends an interval: differences beyond it are told


def run_uncertainty(context: Context, folder: Path) -> dict[str, Any]:
    """Posterior, profiles, evidence, further sources and prediction intervals (see docs/uncertainty.md)."""
    study, report = context.study, partial(context.tell, NAME, 0, 0)
    calibration = context.results.calibration
    best = study.vector(calibration.parameters)
    earlier = _select_earlier_points(study, calibration)
    problem, table = build_problem(study, calibration), study.uncertainty
    records = load_records(context, study.records_at(*study.fitted), secondary=True)
    cache = open_experiment_cache(context, folder)
    simulator = RecordSimulator(problem, records, cache, context.executor, report)
    correction = correct_to_fine_meshes(simulator, best)
    known = estimate_linearised(simulator, best, correction)

    def simulate(points: Sequence[Array]) -> list[list[SiteResponse]]:
        """All sites at parameters (p,), with derivatives; they start as in the calibration, or from the
        answer, itself from rest."""
        jobs, responses = list[SimulationJob](), list[SiteResponse]()
        for point in points:
            is_best = np.array_equal(point, best)
            starts = () if is_best else earlier.get(tuple(point.tolist()), (best,))
            jobs += [record.job(point, starts=starts) for record in records.searched]
        for record, simulation in zip(cycle(records.own), cache.run(jobs, context.executor)):
            responses.append(record.respond(simulation))
            context.tell(NAME, len(responses), len(jobs), f"site {simulation.site}")
        n = len(records.own)
        return [correction.as_fine(responses[i : i + n]) for i in range(0, len(responses), n)]

    explored = explore_posterior(
        simulate,
        known,
        [np.array(point) for point in sorted(earlier)],
        ExplorationSettings(table.runs, max(4, table.runs // 4), checked=table.checked, seed=table.seed),
        report=report,
    )
    evidence = _compare_groupings(context, problem, explored) if len(problem.stages) > 1 else None
    gain = FitSensitivity.linearise(known, correction.responses)
    changes = simulate_sources(context, folder, cache, records, best) if table.sources else []
    relaxation = calibration.uncertainty.relaxation
    found = Findings(known, explored, evidence, gain, tuple(changes), relaxation)
    write_results(folder, study, found, _predict_records(context, cache, calibration))
    return {"runs": explored.rounds[-1].runs}


def _select_earlier_points(
    study: Study, calibration: CalibrationResult
) -> dict[tuple[float, ...], Sequence[Array]]:
    """Parameters of the calibration's iterates that came near the records, and where it started them from."""
    iterates = [iterate for stage in calibration.stages for iterate in stage.iterations]
    least = min(iterate.error_percent for iterate in iterates)
    return {
        tuple(study.vector(one.parameters).tolist()): [study.vector(s) for s in one.starts]
        for one in iterates
        if one.error_percent <= _NEAR * least + 3.0
    }


def _compare_groupings(
    context: Context, problem: CalibrationProblem, explored: Exploration
) -> EvidenceComparison:
    """One material against the study's own, on one emulator and covariance, and where nothing was fitted."""
    unknowns, titles, likelihood = problem.unknowns, problem.titles, explored.likelihood
    space = build_space(unknowns, problem.stages[0])
    single = Likelihood(likelihood.emulator, likelihood.measured, likelihood.model, unknowns, space)
    start = context.study.vector(context.results.calibration.stages[0].parameters)
    one, _ = fit_alternative(titles[0], single, space.reduce(np.log(start)))
    several, _ = fit_alternative(titles[1], likelihood, explored.best.z)
    return compare_models(one, several, *context.results.predict.compare_held_out())


def _predict_records(
    context: Context, cache: SimulationCache, calibration: CalibrationResult
) -> list[tuple[SiteRecord, SiteResponse]]:
    """Every record at the identified parameters, from what the stage ``predict`` has simulated."""
    study, records = context.study, load_records(context, context.study.recorded)
    jobs = build_answer_jobs(records, Answer.from_stage(calibration.stages[-1], study))
    responses = [to_response(simulation) for simulation in cache.run(jobs, context.executor)]
    if records.is_coarsened:
        n = len(records.own)
        responses = MeshCorrection(responses[n:], responses[:n])(responses[n:])
    return list(zip(records.searched, responses, strict=True))


@dataclass(frozen=True)
class Findings:
    """All that the experiment found; see the parts for what they are."""

    known: Uncertainty
    explored: Exploration
    evidence: stored.EvidenceComparison | None
    gain: FitSensitivity
    changes: tuple[Change, ...]
    relaxation: RelaxationSummary | None

    def compute_covariance(self, change: Change) -> Array:
        """Of the logarithms (p, p), by one source."""
        return self.gain.compute_covariance(change.force_N, change.shared, change.sites)

    @property
    def source_covariance(self) -> Array:
        """Of the logarithms (p, p), by all counted sources."""
        parts = [self.compute_covariance(change) for change in self.changes if change.counted]
        return np.sum([np.zeros_like(self.known.covariance), *parts], axis=0)


def write_results(
    folder: Path, study: Study, found: Findings, predicted: Sequence[tuple[SiteRecord, SiteResponse]]
) -> None:
    """``uncertainty.json``, and CSV: parameters, draws, profiles, sources, predictions.

    ``predicted`` is every record with what is predicted of it at the identified parameters.
    """
    (folder / "predictions").mkdir(exist_ok=True)
    parameters, combinations = _summarise_parameters(found), _summarise_combinations(found)
    rows = [_write_prediction(folder, study, found, *one) for one in predicted]
    explored, posterior = found.explored, found.explored.posterior
    emulator = explored.likelihood.emulator
    inside = [(row.fitted, row.inside_percent) for row in rows if row.inside_percent is not None]
    coverage = [[percent for of_fitted, percent in inside if of_fitted == kind] for kind in (True, False)]
    fitted, heldout = (float(np.mean(shares)) if shares else None for shares in coverage)
    predictions = stored.IntervalSummary(
        sites=rows, coverage_fitted_percent=fitted, coverage_heldout_percent=heldout
    )
    content = stored.UncertaintyResult(
        parameters=parameters,
        combinations=combinations,
        correlation=CorrelationMatrix(
            names=found.known.names, matrix=compute_correlation(posterior.covariance).tolist()
        ),
        covariance_log=posterior.covariance.tolist(),
        covariance_sources_log=found.source_covariance.tolist(),
        residuals=found.known.residual_model.summarise(),
        emulator=stored.EmulatorSummary(
            runs=len(emulator.points),
            needed_percent=explored.needed_percent,
            good_enough=explored.good_enough,
            rounds=explored.rounds,
            lower=emulator.lower.tolist(),
            upper=emulator.upper.tolist(),
            kernel_length=emulator.length,
            nugget=emulator.nugget,
        ),
        posterior=posterior.summarise(),
        profiles={one.name: stored.LikelihoodProfile.model_validate(one) for one in explored.profiles},
        checks=explored.checks,
        evidence=found.evidence,
        sources=[_summarise_source(found, change) for change in found.changes],
        predictions=predictions,
        verdict=_describe_verdict(found, parameters, combinations, predictions),
    )
    write_result(folder / "uncertainty.json", content)
    _write_flat(folder / "parameters.csv", parameters)
    _write_flat(folder / "sources.csv", content.sources)
    write_rows(folder / "predictions.csv", rows)
    with write_atomically(folder / EMULATOR) as stream:  # all sites, one after the other
        np.savez(
            stream,
            names=np.array(found.known.names),
            points=emulator.points,  # (k, p)
            sizes=np.array([response.force_N.size for response in explored.runs[0]]),
            forces=np.array([np.concatenate([r.force_N for r in run]) for run in explored.runs]),  # (k, N)
            jacobians=np.array(
                [np.concatenate([r.jacobian for r in run]) for run in explored.runs]
            ),  # (k, N, p)
        )
    draws = posterior.samples[:: max(len(posterior.samples) // _DRAWS, 1)]
    write_curves(folder / "draws.csv", **dict(zip(found.known.names, draws.T)))
    heads = ("parameter", "value", "rise", "extrapolated")
    lines = [
        (one.name, value, rise, bool(beyond))
        for one in explored.profiles
        for value, rise, beyond in zip(one.values, one.rise, one.extrapolated, strict=True)
    ]
    write_table(folder / "profiles.csv", heads, lines)


def _summarise_parameters(found: Findings) -> list[stored.ParameterUncertainty]:
    """One row for every parameter: calibrated, its interval by every method, the verdict on all sources."""
    known, posterior, space = found.known, found.explored.posterior, found.explored.likelihood.space
    profiles = {one.name: one for one in found.explored.profiles}
    more = np.sqrt(np.diag(posterior.covariance) + np.diag(found.source_covariance))
    ours = np.sqrt(np.diag(posterior.covariance))
    wider = more / np.maximum(ours, 1e-300)
    middle, ends = np.log(posterior.median), np.log(posterior.intervals_95.T)
    with_sources = np.exp(space.clip(middle + wider * (ends - middle))).T
    factors = np.sqrt(with_sources[:, 1] / with_sources[:, 0])
    verdicts = choose_verdicts(space, np.eye(len(more)), factors, more)
    shown = [profiles.get(name) for name in known.names]
    return [
        stored.ParameterUncertainty(
            name=known.names[i],
            calibrated=float(known.parameters[i]),
            median=float(posterior.median[i]),
            linearised_95=known.intervals_95[i].tolist(),
            posterior_95=posterior.intervals_95[i].tolist(),
            profile_95=None if profile is None else profile.interval_95,
            profile_verdict=None if profile is None else profile.verdict,
            profile_extrapolated=None if profile is None else profile.ends_extrapolated,
            with_sources_95=with_sources[i].tolist(),
            verdict=verdict,
        )
        for i, (profile, verdict) in enumerate(zip(shown, limit_verdicts(verdicts, known, found.relaxation)))
    ]


def _summarise_combinations(found: Findings) -> list[stored.ParameterCombination]:
    """The principal axes of the posterior, as its draws, the linearisation and the sources see them."""
    known, posterior, space = found.known, found.explored.posterior, found.explored.likelihood.space
    axes = compute_principal_axes(posterior.covariance, space)
    drawn = np.log(posterior.samples) @ axes.T
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    sd = drawn.std(axis=0, ddof=1)
    linear, sources = (
        np.sqrt(np.einsum("kp,pq,kq->k", axes, part, axes))
        for part in (known.covariance, found.source_covariance)
    )
    total, factors = np.hypot(sd, sources), np.exp((high - low) / 2)
    wider = factors ** (total / np.maximum(sd, 1e-300))
    return [
        stored.ParameterCombination(
            text=format_product(weights, known.names),
            weights=weights.tolist(),
            linearised_factor_95=float(np.exp(min(NORMAL_95 * linear[i], 50.0))),
            posterior_factor_95=float(factors[i]),
            with_sources_factor_95=float(wider[i]),
            verdict=verdict,
        )
        for i, (weights, verdict) in enumerate(zip(axes, choose_verdicts(space, axes, wider, total)))
    ]


def _summarise_source(found: Findings, change: Change) -> stored.SourceEffect:
    """One line of the table: change of force in percent of the largest, change of parameters in percent.

    A source of each site's own changes parameters by the root of the sum of squares over sites.
    """
    model = found.known.residual_model
    names = [noise.name for noise in model.noise]
    forces = [100 * float(np.mean(np.abs(d))) / peak for d, peak in zip(change.force_N, model.peaks_N)]
    if change.shared:
        shift = found.gain.compute_shift(change.force_N)
    else:
        shift = np.sqrt(np.diag(found.compute_covariance(change)))
    return stored.SourceEffect(
        source=change.source,
        change=change.change,
        shared=change.shared,
        counted=change.counted,
        failed=change.failed,
        force_percent=dict(zip(names, forces)),
        parameters_percent=dict(zip(found.known.names, (100 * np.expm1(shift)).tolist())),
    )


def _write_prediction(
    folder: Path, study: Study, found: Findings, record: SiteRecord, response: SiteResponse
) -> stored.IntervalParts:
    """A record's interval as CSV, and its row: how wide, why, and how much of the record lies inside.

    Where the prediction failed there is the reason only.
    """
    model, parameters, force = found.known.residual_model, found.known.parameters, response.force_N
    facts: dict[str, Any] = {
        "site": record.site.name,
        "record": record.name,
        "fitted": record.site.fitted,
        "reason": response.reason,
    }
    if not response.completed:
        missing = ("inside_percent", "half_width_percent", *_SHARES.values())
        return stored.IntervalParts(**facts | dict.fromkeys(missing))
    site_N = np.zeros(len(force))
    if not record.site.fitted:
        site_N = estimate_site_deviation(study, record, response, parameters)
    measured, noise = record.compared, estimate_site_noise(study, record, force)
    what, unit = ("displacement" if record.record.forced else "force"), record.record.unit
    peak = float(force.max())
    names = [noise.name for noise in model.noise]
    share = model.misfit[names.index(record.name)] if record.name in names else model.misfit_elsewhere
    scaled = response.jacobian * parameters
    variances = {
        "parameters": np.einsum("ni,ij,nj->n", scaled, found.explored.posterior.covariance, scaled),
        "sources": np.einsum("ni,ij,nj->n", scaled, found.source_covariance, scaled),
        "site": (model.site_factor * site_N) ** 2,
        "noise": np.diag(noise.covariance),
        "misfit": np.full(len(force), (share * peak) ** 2),
    }
    total = np.sum(list(variances.values()), axis=0)
    estimated = variances["misfit"], variances["site"]
    half = compute_half_width_95(total, *estimated, model.known_scale, model.site_freedom)
    ends = compute_force_range(response, parameters, found.explored.posterior.median)
    low, high = ends[0] - half, ends[1] + half
    if found.relaxation is not None:
        spread = RelaxationSpread.from_stored(found.relaxation.beyond)
        low, high = spread.widen_band(force, scaled, record.times_s, ends, half)
    half_width, low = float(np.mean(high - low)) / 2, np.maximum(low, 0.0)
    write_curves(
        folder / "predictions" / f"{record.name}.csv",
        time_s=record.times_s,
        **{
            f"{what}_{which}_{unit}": curve
            for which, curve in (("measured", measured), ("predicted", force), ("low", low), ("high", high))
        },
    )
    inside = (measured >= low) & (measured <= high)
    facts |= {_SHARES[k]: 100 * float(np.sqrt(v.mean())) / peak for k, v in variances.items()}
    return stored.IntervalParts(
        **facts, inside_percent=100 * float(inside.mean()), half_width_percent=100 * half_width / peak
    )


def _describe_verdict(
    found: Findings,
    parameters: Sequence[stored.ParameterUncertainty],
    combinations: Sequence[stored.ParameterCombination],
    predictions: stored.IntervalSummary,
) -> list[str]:
    words = []
    of_rows = (row.verdict for row in parameters if row.verdict != GIVEN)
    for word in dict.fromkeys((DETERMINED, WEAK, UNDETERMINED, *of_rows)):
        names = [row.name for row in parameters if row.verdict == word]
        if names:
            words.append(f"{word.capitalize()}: {', '.join(names)}.")
    told = [row for row in combinations if row.verdict == DETERMINED]
    words.append(
        f"{len(told)} of {len(combinations)} independent combinations are determined to within "
        "-20 to +25 %" + (f"; the best is {told[0].text}." if told else ".")
    )
    beyond = [
        row.name for row in parameters if not row.posterior_95[0] <= row.calibrated <= row.posterior_95[1]
    ]
    if beyond:
        words.append(
            f"The calibrated value lies outside its sampled interval: {', '.join(beyond)}; the calibration "
            "weighs all points of a record alike, the sampled interval by noise and misfit."
        )
    if found.evidence is not None:
        words.append(found.evidence.verdict[0].upper() + found.evidence.verdict[1:] + ".")
    counted = [change for change in found.changes if change.counted]
    if counted:
        largest = max(counted, key=lambda change: float(np.trace(found.compute_covariance(change))))
        words.append(
            f"Beyond the records, {largest.source} ({largest.change}) would change the parameters most."
        )
    coverage = predictions.coverage_heldout_percent
    if coverage is not None:
        words.append(f"{coverage:.0f} % of the held-out records lies inside the 95 % prediction intervals.")
    words += [f"Site {row.record} is not predicted: {row.reason}." for row in predictions.sites if row.reason]
    words += _describe_profiles(found.explored)
    if not found.explored.good_enough:
        words.append("The emulator is less accurate than the records: raise uncertainty.runs.")
    if not found.explored.posterior.long_enough:
        words.append("The sampler's chain is short for its autocorrelation: intervals are rough.")
    return words


def _describe_profiles(explored: Exploration) -> list[str]:
    """Where profiles rest on an emulator beyond its runs, and what the solver said there."""
    beyond = [one.name for one in explored.profiles if any(one.ends_extrapolated)]
    words = []
    if beyond:
        words.append(
            "Profiles end beyond the emulator's simulations, where they are extrapolated: "
            f"{', '.join(beyond)}."
        )
    thresholds = {one.name: one.threshold for one in explored.profiles}
    for check in explored.checks:
        if None in check.solved:
            words.append(f"An end of the profile of {check.name} could not be simulated.")
        off = check.largest_difference
        if off is not None and off > _MOST_OFF * thresholds[check.name]:
            words.append(
                f"At an end of the profile of {check.name} solver and emulator differ by {off:.1f} in "
                f"-2 ln L, where a rise of {thresholds[check.name]:.1f} ends an interval: it rests there on "
                "the emulator alone."
            )
    return words


def _write_flat(file: Path, rows: Sequence[ResultPart]) -> None:
    """Rows of one kind as CSV, their lists and dictionaries as columns; what is None has none."""
    flat = []
    for row in rows:
        cells: dict[str, Any] = {}
        for key, value in row.to_plain().items():
            if isinstance(value, dict):
                cells |= {f"{key}.{name}": number for name, number in value.items()}
            elif isinstance(value, list) and len(value) == 2 and not isinstance(value[0], str):
                cells |= {f"{key}_low": value[0], f"{key}_high": value[1]}
            elif value is not None:
                cells[key] = " ".join(map(str, value)) if isinstance(value, list) else value
        flat.append(cells)
    fullest: dict[str, Any] = max(flat, key=len, default={})  # a row without an interval lacks its columns
    write_table(file, list(fullest), [[row.get(head) for head in fullest] for row in flat])
