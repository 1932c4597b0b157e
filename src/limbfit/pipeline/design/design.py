"""The experiment ``design``: which sites to test, and how deep, to determine the parameters best."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.sites.sites import measure_tissue_under
from ...anatomy.surfaces.surfaces import load_anatomy
from ...arrays import Array
from ...errors import InputError, RunError, StudyError
from ...identify.checks.design import (
    Candidate,
    Design,
    NoiseModel,
    choose_design,
    compute_efficiency,
    compute_information,
    compute_prior_information,
    evaluate_design,
)
from ...identify.fit.objective import SiteResponse
from ...identify.fit.prediction import NORMAL_95
from ...identify.fit.readings import LinearisedReadings
from ...indentation import SiteModel
from ...laws import Parameters
from ...results.planning import DesignCandidate, DesignResult, DesignSite, ExpectedNoise, SiteDesign
from ...study import Study
from ..engine.context import NO_PARAMETERS, Context
from ..engine.store import write_result
from ..identification.search import build_problem
from ..records.records import build_model
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import build_curve_job, open_experiment_cache

DEFAULT_SITES = 4
SENSOR_KPA, SENSOR_PERCENT = 2.0, 10.0  # what 95 % of the readings of a sensor in a socket are within
OWN, WITH_SENSORS = "the study's own", "the study's own, with sensors in the socket"
_WORTH_TELLING = 0.05  # of the logarithm of an interval's factor
DEEPEST_SHARE = 0.5  # of the tissue's thickness that a candidate may go


def check_design(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse more sites than there are, sites with several records, and depths that fit at too few."""
    sites, depths = count_wanted_sites(study, options["sites"]), options["depths_mm"]
    if not 0 < sites <= len(study.sites):
        raise InputError(f"{sites} sites are wanted of {len(study.sites)}", place="--sites")
    for site in study.sites:
        records = study.records_at(site)
        if len(records) > 1 or any(record.forced for record in records):
            raise InputError(
                "a design chooses one indentation per site, under a stated displacement; a site has others",
                file=study.file,
                place=f"sites.{site.name}",
                remedy="leave one of that kind in a study for the design",
            )
    if limb is None or not depths:
        return
    fitting = []
    for site in study.sites:
        width = study.indenter_of((study.records_at(site) or (site,))[0]).width_mm
        if min(depths) <= DEEPEST_SHARE * measure_tissue_under(limb.anatomy, *limb.place(site), width):
            fitting.append(site)
    if len(fitting) < sites:
        what = f"{min(depths):g} mm is no deeper than half of the tissue at {len(fitting)} sites, not {sites}"
        raise StudyError(
            what, file=study.file, place="--depths", remedy="give smaller depths, or fewer sites"
        )


def count_wanted_sites(study: Study, sites: int) -> int:
    """How many sites to choose: of 0 as many as the study fits, else four, or all where it has fewer."""
    return sites or len(study.fitted) or min(DEFAULT_SITES, len(study.sites))


def run_design(
    context: Context,
    folder: Path,
    *,
    sites: int = 0,
    depths_mm: Sequence[float] = (),
    parameters: Parameters = NO_PARAMETERS,
    parameters_from: str = "",
    noise: Mapping[str, float] = {},
    socket_pressures: Mapping[str, Sequence[float]] = {},
) -> None:
    """Simulate every candidate once, with derivatives, and choose.

    ``socket_pressures``: mean pressures that sensors may measure, kPa, each followed by its derivatives (p,)
    with respect to the logarithms of the parameters.
    """
    study = context.study
    vector = study.vector(parameters)
    models, left_out = _build_candidate_models(context, depths_mm)
    cache = open_experiment_cache(context, folder)
    jobs = [build_curve_job(model, study.tissues, vector) for model in models]
    model_noise, found = NoiseModel(**noise), []
    for i, (model, simulation) in enumerate(zip(models, cache.run(jobs, context.executor))):
        depth = float(max(model.knots_mm))
        context.tell("design", i + 1, len(models), f"site {model.name}, {depth:.1f} mm")
        assert simulation.jacobian is not None
        if not simulation.completed:
            left_out.append(f"site {model.name} at {depth:.1f} mm: {simulation.reason}")
            continue
        response = SiteResponse(simulation.force_N, simulation.jacobian)
        information = compute_information(response, vector, model_noise)
        found.append((Candidate(model.site, depth, information), simulation.force_N.max()))
    content = DesignResult(
        **_choose_designs(context, found, count_wanted_sites(study, sites), left_out, socket_pressures),
        parameters=parameters,
        parameters_from=parameters_from,
        noise=ExpectedNoise(**noise),
    )
    write_result(folder / "design.json", content)


def _build_candidate_models(
    context: Context, depths_mm: Sequence[float]
) -> tuple[list[SiteModel], list[str]]:
    """Each site as recorded or planned, or at each depth that its tissue allows; and what was left out."""
    study, models, left_out = context.study, [], []
    anatomy = load_anatomy(context.store["surfaces"]) if depths_mm else None
    for one in study.indentations:
        own = build_model(context, one)
        if anatomy is None:
            models.append(own)
            continue
        thickness = measure_tissue_under(anatomy, own.position, own.axis, own.indenter.width_mm)
        for depth in depths_mm:
            if depth > DEEPEST_SHARE * thickness:
                left_out.append(f"site {own.site} at {depth:g} mm: the tissue is {thickness:.1f} mm thick")
            else:
                # The same phases to another depth: at the same rates, held for as long.
                phases, share = own.history.phases, depth / max(own.knots_mm)
                seconds = [phase.duration_s * (1.0 if phase.kind == "hold" else share) for phase in phases]
                knots_mm = share * np.array([phases[0].start_mm, *(phase.end_mm for phase in phases)])
                knots_s = np.r_[0.0, np.cumsum(seconds)]
                models.append(
                    replace(own, knots_s=tuple(knots_s.tolist()), knots_mm=tuple(knots_mm.tolist()))
                )
    return models, left_out


def _choose_designs(
    context: Context,
    found: Sequence[tuple[Candidate, float]],
    sites: int,
    left_out: list[str],
    pressures: Mapping[str, Sequence[float]],
) -> dict[str, Any]:
    """The best choices, the study's own, all sites, and the candidates."""
    study = context.study
    every = [one for one, _ in found]
    if len({one.site for one in every}) < sites:
        there = len({one.site for one in every})
        raise RunError(f"only {there} of {sites} sites could be simulated: {'; '.join(left_out)}")
    problem = build_problem(study)
    names, prior = problem.unknowns.names, compute_prior_information(problem.unknowns, problem.space)
    before = np.linalg.slogdet(prior)[1]
    designs = {
        "D-optimal": choose_design(every, sites, prior, "D"),
        "A-optimal": choose_design(every, sites, prior, "A"),
    }
    # The fitted sites at the depth nearest to the recorded one; their deepest candidates otherwise.
    fitted = {site.name for site in study.fitted}
    own = tuple(i for i in _select_deepest(every) if every[i].site in fitted)
    if own:
        designs[OWN] = evaluate_design(every, own, prior)
    if own and pressures:
        with_sensors = prior + _compute_sensor_information(np.array(list(pressures.values())))
        designs[WITH_SENSORS] = evaluate_design(every, own, with_sensors)
    designs["all sites"] = evaluate_design(every, _select_deepest(every), prior)
    best_d, best_a = designs["D-optimal"], designs["A-optimal"]
    rows = []
    for name, design in designs.items():
        chosen = [every[i] for i in design.chosen]
        rows.append(
            SiteDesign(
                design=name,
                sites=[DesignSite(site=one.site, depth_mm=one.depth_mm) for one in chosen],
                d_efficiency=compute_efficiency(design, best_d, "D"),
                a_efficiency=compute_efficiency(design, best_a, "A"),
                factor_95=dict(zip(names, design.factors_95.tolist(), strict=True)),
                exhaustive=design.exhaustive,
            )
        )
    return {
        "wanted": sites,
        "designs": rows,
        "verdict": _describe_verdict(designs, names),
        "candidates": [
            DesignCandidate(
                site=one.site,
                depth_mm=one.depth_mm,
                peak_force_N=float(peak),
                # What it tells alone: bits of information over the bounds and priors.
                bits=float((np.linalg.slogdet(prior + one.information)[1] - before) / (2 * np.log(2))),
            )
            for one, peak in found
        ],
        "left_out": left_out,
    }


def _compute_sensor_information(pressures: Array) -> Array:
    """What sensors of the usual error tell of log(parameters), (p, p); ``pressures`` (k, 1 + p) as given."""
    mean, derivatives = pressures[:, 0], pressures[:, 1:]
    gain = 0.01 * SENSOR_PERCENT / NORMAL_95 * mean  # that of the whole sheet, too
    covariance = np.diag((SENSOR_KPA / NORMAL_95) ** 2 + gain**2) + np.outer(gain, gain)
    nothing = np.zeros(derivatives.shape[1])
    rows = LinearisedReadings.weigh(0.0 * mean, derivatives, covariance, nothing).rows
    return np.asarray(rows.T @ rows)


def _select_deepest(every: Sequence[Candidate]) -> tuple[int, ...]:
    best: dict[str, int] = {}
    for i, one in enumerate(every):
        if one.site not in best or one.depth_mm > every[best[one.site]].depth_mm:
            best[one.site] = i
    return tuple(best.values())


def _describe_verdict(designs: dict[str, Design], names: Sequence[str]) -> str:
    """In words: what the study's own choice gives away, and what no choice determines."""
    best, every = designs["D-optimal"], designs["all sites"]
    words = []
    own, with_sensors = designs.get(OWN), designs.get(WITH_SENSORS)
    if own is not None and len(own.chosen) == len(best.chosen):
        share = compute_efficiency(own, best, "D")
        worth = "as good as" if share > 0.95 else f"worth {100 * share:.0f} % of the data of"
        words.append(f"the study's own choice is {worth} the best")
    if own is not None and with_sensors is not None:
        narrowed = np.log(own.factors_95) - np.log(with_sensors.factors_95)
        i = int(narrowed.argmax())
        factors = f"from a factor of {own.factors_95[i]:.3g} to {with_sensors.factors_95[i]:.3g}"
        said = f"would narrow {names[i]} most, {factors}" if narrowed[i] > _WORTH_TELLING else "add little"
        words.append(f"pressures in the socket, measured in every region, {said}")
    wide = [name for name, factor in zip(names, best.factors_95) if factor > 2]
    open_too = [name for name, factor in zip(names, every.factors_95) if factor > 2]
    if wide:
        words.append(f"even the best choice does not determine within a factor of two: {', '.join(wide)}")
    if open_too:
        words.append(f"nor do all sites together: {', '.join(open_too)}")
    return "; ".join(words) or "the best choice determines every parameter within a factor of two"
