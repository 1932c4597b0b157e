"""The experiment ``protocol``: which records a session of stated length should make, and what they tell."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from ...anatomy.sites.sites import measure_tissue_under
from ...anatomy.surfaces.surfaces import load_anatomy
from ...arrays import Array
from ...errors import InputError, RunError
from ...identify.checks.design import (
    Budget,
    DesignTarget,
    NoiseModel,
    RecordNoise,
    RecordOption,
    compute_duration_s,
    compute_factors_95,
    compute_information,
    compute_prior_information,
    plan_records,
    sample_tissues,
)
from ...identify.fit.objective import SiteResponse
from ...identify.fit.parameters import build_space
from ...indentation import (
    Simulation,
    SimulationJob,
    SiteModel,
    find_layers_under,
    find_nearby_skin_points,
    place_waves_under,
)
from ...laws import Parameters
from ...mesh import read_vtu
from ...results.planning import ExpectedNoise, ProtocolPlan, ProtocolRecord, ProtocolResult
from ...study import Study
from ..engine.context import NO_PARAMETERS, Context
from ..engine.store import write_result
from ..identification.search import build_problem
from ..records.records import build_model, compute_expected_share, estimate_surface_error_mm, is_modulus
from ..simulation.limb_geometry import LimbGeometry, build_site_model, coarsen_model
from ..simulation.loading import LoadHistory, describe_untested_times
from ..simulation.simulations import build_curve_job, open_experiment_cache
from .design import DEEPEST_SHARE

DETERMINED = 1.25  # largest factor of a 95 % interval that counts as determined
READING_S = 1.0
# Standard deviations of what can be read beside the force, and how their files end.
SEEN = {
    "ultrasound_sd_mm": "layers",  # of a thickness
    "surface_sd_mm": "surface",  # of a component of a move of the skin
    "shear_waves_sd_m_s": "waves",  # of a speed, of which there is one in `READING_S`
}
_STATED = ("site", "indenter", "depth_mm", "speed_mm_s", "hold_s")  # of a record, as stored
DESIGNED, PLAIN, UNSEEN = "designed", "one ramp at each site", "by force alone"


@dataclass(frozen=True)
class PlannedRecord:
    """A record that could be made: the indenter pressed in at one rate, held, and taken back at that rate.

    ``usual``: as deep as the site was recorded or is planned, or nearest to that.
    """

    site: str
    indenter: str
    depth_mm: float
    speed_mm_s: float
    hold_s: float
    model: SiteModel
    usual: bool

    @property
    def seconds(self) -> float:
        """From the first touch to the last."""
        return 2.0 * self.depth_mm / self.speed_mm_s + self.hold_s

    @property
    def words(self) -> str:
        held = f", held for {self.hold_s:g} s" if self.hold_s else ""
        return f"site {self.site}, {self.indenter}, {self.depth_mm:.1f} mm at {self.speed_mm_s:g} mm/s{held}"


def press(model: SiteModel, depth: float, speed: float, hold: float) -> SiteModel:
    """In to ``depth`` mm at ``speed`` mm/s, held for ``hold`` s, and out."""
    ramp = depth / speed
    knots = [(0.0, 0.0), (ramp, depth)] + ([(ramp + hold, depth)] if hold else [])
    knots.append((knots[-1][0] + ramp, 0.0))
    times, depths = zip(*knots)
    return replace(model, knots_s=times, knots_mm=depths)


def check_protocol(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse unknown parameters, what sees nothing, and a session too short for set-up, rest and hold."""
    _select_named(study, options["determine"])
    taut, tense = study.material.prestretch, study.material.course
    blind = [key for key, seen in SEEN.items() if options.get(key) and (taut or (tense and seen == "waves"))]
    if blind:
        what = f"{blind[0]} is planned, which sees no {'pre-stretch' if taut else 'contraction'}"
        raise InputError(what, file=study.file, place="material", remedy="plan without it")
    budget = Budget(60.0 * options["minutes"], options["setup_s"])
    _check_minutes([options["rest_s"] + min(options["holds_s"], default=0.0)], budget)


def _check_minutes(seconds: Sequence[float], budget: Budget) -> None:
    """Refuse a session into which no record of so many ``seconds``, or more, fits."""
    least = budget.setup_s + min(seconds)
    if least > budget.seconds:
        raise InputError(
            f"no record fits into {budget.seconds / 60:g} min: the shortest takes {least / 60:.1f} min or "
            "more, set-up included",
            place="--minutes",
            remedy="allow more time",
        )


def run_protocol(
    context: Context,
    folder: Path,
    *,
    minutes: float = 25.0,
    setup_s: float = 60.0,
    rest_s: float = 30.0,
    speeds_mm_s: Sequence[float] = (),
    holds_s: Sequence[float] = (),
    depths_mm: Sequence[float] = (),
    determine: Sequence[str] = (),
    criterion: str = "D",
    draws: int = 3,
    seed: int = 0,
    parameters: Parameters = NO_PARAMETERS,
    parameters_from: str = "",
    noise: Mapping[str, float] = {},
    seen: Mapping[str, float | None] = dict.fromkeys(SEEN),
    pressures: Mapping[str, Sequence[float]] = {},
    socket_times: Mapping[str, tuple[float, float]] = {},
) -> None:
    """Simulate every possible record at every draw, with derivatives, and choose within the time.

    ``seen``: how well what is read (`SEEN`); None: there is none. ``pressures``: derivatives (p,) of their
    logarithms by those of the parameters; none: parameters count. ``socket_times``: ramp and end, s, of
    donning and each load that they are of.
    """
    study = context.study
    problem, centre = build_problem(study), study.vector(parameters)
    determine = _select_named(study, determine)
    known = problem.unknowns.with_start(centre)
    space, names = build_space(known, problem.stages[-1]), known.names
    of_parameters = np.eye(len(names))[[names.index(name) for name in determine]]
    rows = np.array(list(pressures.values())) if pressures else of_parameters
    tissues = sample_tissues(known, space, centre, draws, seed)
    noises = RecordNoise(NoiseModel(**noise), **seen)
    planned, left_out = _plan_records(context, speeds_mm_s, holds_s, depths_mm, noises)
    budget = Budget(60.0 * minutes, setup_s)
    _check_minutes([one.seconds + rest_s for one in planned], budget)
    found, unusable = _simulate_planned(context, folder, planned, tissues, noises)
    left_out += unusable
    if not found:
        raise RunError(f"no record could be simulated: {'; '.join(left_out)}")
    stiffness = is_modulus(study).astype(np.float64)
    wanted = DesignTarget(
        compute_prior_information(known, space), rows, "A" if criterion == "A" else "D", stiffness
    )
    off_mm = estimate_surface_error_mm(study, context.store)
    recorded, information, peaks_N = zip(*found)
    seconds = [one.seconds + rest_s for one in recorded]
    shares = [compute_expected_share(one.model, off_mm) for one in recorded]
    options, blind = (
        [
            RecordOption((one.site, one.indenter), *rest)
            for one, *rest in zip(recorded, seconds, which, shares)
        ]
        for which in zip(*information)
    )
    plans = _build_plans(recorded, options, budget, wanted)
    options_of: dict[str, Sequence[RecordOption]] = dict.fromkeys(plans, options)
    if noises.has_secondary:
        plans[UNSEEN] = plan_records(blind, budget, wanted)
        options_of |= dict.fromkeys((UNSEEN, PLAIN), blind)
    protocols = [
        _judge_plan(name, chosen, options_of[name], budget, wanted, names, determine, pressures)
        for name, chosen in plans.items()
    ]
    candidates = [
        ProtocolRecord(**{key: getattr(one, key) for key in _STATED}, seconds=of, peak_force_N=peak)
        for one, of, peak in zip(recorded, seconds, peaks_N)
    ]
    chosen = (recorded[i].model for i in plans[DESIGNED])
    histories = [LoadHistory.from_knots(model.knots_s, model.knots_mm) for model in chosen]
    left_out += describe_untested_times(histories, socket_times)
    content = ProtocolResult(
        minutes=minutes,
        setup_s=setup_s,
        rest_s=rest_s,
        criterion=wanted.criterion,
        determine=determine,
        draws=tissues.tolist(),
        records=[candidates[i] for i in plans[DESIGNED]],
        pressures=list(pressures),
        protocols=protocols,
        verdict=_describe_verdict(protocols[0], determine),
        candidates=candidates,
        left_out=left_out,
        parameters=parameters,
        parameters_from=parameters_from,
        noise=ExpectedNoise(**noise),
        **seen,
    )
    write_result(folder / "protocol.json", content)
    _write_records(folder / "records.toml", content.records, seen)


def _select_named(study: Study, determine: Sequence[str]) -> list[str]:
    """The parameters to be determined, in flat order: all that the study does not fix where none is named."""
    names = [f"{tissue}.{name}" for tissue, name in study.parameters]
    free = [name for name in names if name not in study.fixed]
    for name in determine:
        if name not in free:
            what = "the study fixes" if name in names else "no parameter is named"
            raise InputError(f"{what} {name!r}", place="--determine", remedy=f"use {', '.join(free)}")
    return [name for name in free if not determine or name in determine]


def _plan_records(
    context: Context,
    speeds_mm_s: Sequence[float],
    holds_s: Sequence[float],
    depths_mm: Sequence[float],
    noises: RecordNoise,
) -> tuple[list[PlannedRecord], list[str]]:
    """Every site with every indenter, speed and hold, as deep as asked for, else as recorded or planned.

    Nowhere deeper than its tissue allows.
    """
    study, found, left_out = context.study, [], []
    anatomy = load_anatomy(context.store["surfaces"])
    deepest: dict[str, float] = {}
    for one in study.indentations:
        own = build_model(context, one)
        deepest[own.site] = max(deepest.get(own.site, 0.0), max(own.knots_mm))
    for site in study.sites:
        usual = deepest[site.name]
        wanted = depths_mm or (usual,)
        for name in study.all_indenters:
            planned_site = site.model_copy(update={"indenter": name})
            model = build_site_model(context, planned_site, (0.0, 1.0), (0.0, max(wanted)))
            model = _add_gauges(coarsen_model(context, model), noises)
            thickness = measure_tissue_under(anatomy, model.position, model.axis, model.indenter.width_mm)
            most = DEEPEST_SHARE * thickness
            if most < max(wanted):
                half = f"half of the tissue's {thickness:.1f} mm"
                left_out.append(f"site {site.name}: no deeper than {most:.1f} mm, {half}")
            depths = dict.fromkeys(min(depth, most) for depth in wanted)
            nearest = min(depths, key=lambda depth: abs(depth - usual))
            for depth, speed, hold in product(depths, speeds_mm_s, holds_s):
                planned = press(model, depth, speed, hold)
                tool, is_usual = name or "indenter", depth == nearest
                found.append(PlannedRecord(site.name, tool, depth, speed, hold, planned, is_usual))
    return found, list(dict.fromkeys(left_out))


def _add_gauges(model: SiteModel, noises: RecordNoise) -> SiteModel:
    """The model with all that can be read beside its force."""
    if noises.layers is not None:
        model = replace(model, layers=find_layers_under(model))
    if noises.skin is not None:
        model = replace(model, skin_points=find_nearby_skin_points(model))
    if noises.waves is not None:
        model = replace(model, waves=place_waves_under(model, read_vtu(model.mesh)))
    return model


def _simulate_planned(
    context: Context, folder: Path, planned: Sequence[PlannedRecord], tissues: Array, noise: RecordNoise
) -> tuple[list[tuple[PlannedRecord, Array, float]], list[str]]:
    """Simulate each record at each draw, with derivatives; and what was left out.

    That is what does not come to its end, or presses harder at the first draw than the device may. Beside
    each record is what it tells, (2, d, p, p) with what is seen beside its force and without, zero where its
    simulation does not come to its end; and its largest force at the first draw.
    """
    cache, (draws, p), found, left_out = open_experiment_cache(context, folder), tissues.shape, [], []
    names, limit = context.study.tissues, context.study.acquire.force_limit_N
    jobs = [build_curve_job(one.model, names, tissue) for one in planned for tissue in tissues]
    simulations = zip(jobs, cache.run(jobs, context.executor), strict=True)
    for k, one in enumerate(planned):
        information, peak_N, failed = np.zeros((2, draws, p, p)), 0.0, 0
        for draw, (job, simulation) in enumerate(islice(simulations, draws)):
            context.tell("protocol", k * draws + draw + 1, len(jobs), one.words)
            if draw == 0:
                peak_N = float(simulation.force_N.max())
            if simulation.completed:
                information[:, draw] = _compute_information(job, simulation, noise)
            else:
                failed += 1
        if peak_N > limit:
            left_out.append(f"{one.words}: {peak_N:.1f} N, over acquire.force_limit_N ({limit:g} N)")
        elif failed == draws:
            left_out.append(f"{one.words}: not simulated to the end")
        else:
            found.append((one, information, peak_N))
            if failed:
                where = f"at {failed} of {draws} draws"
                left_out.append(f"{one.words}: not simulated to the end {where}, and is not counted there")
    return found, left_out


def _compute_information(
    job: SimulationJob, simulation: Simulation, noises: RecordNoise
) -> tuple[Array, Array]:
    """The information (p, p) of a record with what is seen beside its force, and of its force alone."""
    assert simulation.jacobian is not None
    parameters, points = np.array(job.parameters), np.array(job.model.skin_points).reshape(-1, 3)
    force = SiteResponse(simulation.force_N, simulation.jacobian)
    alone = compute_information(force, parameters, noises.force)
    if not noises.has_secondary:
        return alone, alone
    assert simulation.observed_jacobian is not None
    beside = simulation.observed, simulation.observed_jacobian
    parts = len(job.model.layers), points, job.model.knots_s[-1] / READING_S
    return noises.compute_information(force, *beside, parts, parameters), alone


def _build_plans(
    found: Sequence[PlannedRecord], options: Sequence[RecordOption], budget: Budget, wanted: DesignTarget
) -> dict[str, tuple[int, ...]]:
    """The designed protocol, one slow ramp at every site, as deep as usual, and the best without each
    ingredient."""
    slow, tool = min(one.speed_mm_s for one in found), found[0].indenter
    most: dict[tuple[str, str], float] = {}
    for one in found:
        place = one.site, one.indenter
        most[place] = max(most.get(place, 0.0), one.depth_mm)
    kinds: dict[str, Callable[[PlannedRecord], bool]] = {
        DESIGNED: lambda one: True,
        "without holds": lambda one: not one.hold_s,
        "at one speed": lambda one: one.speed_mm_s == slow,
        "with one indenter": lambda one: one.indenter == tool,
        "at one depth": lambda one: one.depth_mm == most[one.site, one.indenter],
    }
    plans: dict[str, tuple[int, ...]] = {}
    for name, is_allowed in kinds.items():
        chosen = [i for i, one in enumerate(found) if is_allowed(one)]
        fits = any(compute_duration_s(options, [i], budget) <= budget.seconds for i in chosen)
        if fits and (name == DESIGNED or len(chosen) < len(found)):
            best = plan_records([options[i] for i in chosen], budget, wanted)
            plans[name] = tuple(chosen[i] for i in best)
    if DESIGNED not in plans:
        raise RunError(f"no record that could be simulated fits into {budget.seconds / 60:g} min")
    plain = tuple(
        i
        for i, one in enumerate(found)
        if one.speed_mm_s == slow and not one.hold_s and one.indenter == tool and one.usual
    )
    if plain:
        plans[PLAIN] = plain
    return plans


def _judge_plan(
    name: str,
    chosen: Sequence[int],
    options: Sequence[RecordOption],
    budget: Budget,
    wanted: DesignTarget,
    names: Sequence[str],
    determine: Collection[str],
    pressures: Iterable[str],
) -> ProtocolPlan:
    """A protocol, and what to expect of it: the middle of the draws and the worst, of all parameters."""
    covariances = wanted.compute_covariances(options, chosen, len(options[0].information))
    factors = compute_factors_95(covariances)
    middle = dict(zip(names, np.median(factors, axis=0).tolist(), strict=True))
    worst = dict(zip(names, factors.max(axis=0).tolist(), strict=True))
    of_pressures = np.median(compute_factors_95(wanted.project(covariances)), axis=0)
    return ProtocolPlan(
        design=name,
        records=len(chosen),
        minutes=compute_duration_s(options, chosen, budget) / 60.0,
        factor_95=middle,
        worst_95=worst,
        pressures_95=dict(zip(pressures, of_pressures.tolist())),
        determined=sum(middle[name] <= DETERMINED for name in determine),
        cost=wanted.compute_cost(covariances),
    )


def _write_records(file: Path, records: Sequence[ProtocolRecord], seen: Mapping[str, Any]) -> None:
    """The tables ``[[records]]`` of a study that makes them."""
    tables, number = tomlkit.aot(), dict.fromkeys((row.site for row in records), 0)
    for row in records:
        number[row.site] += 1
        table = tomlkit.table()
        name = f"{number[row.site]}"
        table.update({"site": row.site, "name": name, "trace": f"records/{row.site}-{name}.csv"})
        if row.indenter != "indenter":
            table["indenter"] = row.indenter
        for key, end in SEEN.items():
            if seen[key] is not None:
                table[key.partition("_sd")[0]] = f"records/{row.site}-{name}-{end}.csv"
                table[key] = seen[key]
        table.update({key: round(getattr(row, key), 3) for key in ("depth_mm", "speed_mm_s", "hold_s")})
        tables.append(table)
    document = tomlkit.document()
    document["records"] = tables
    file.write_text(tomlkit.dumps(document), encoding="utf-8")


def _describe_verdict(best: ProtocolPlan, wanted: Sequence[str]) -> str:
    """In words: how much of what is wanted the protocol determines."""
    if best.pressures_95:
        worst = max(best.pressures_95, key=best.pressures_95.__getitem__)
        return (
            f"{best.records} records in {best.minutes:.0f} min tell the mean pressures of the socket's "
            f"regions within {100 * (best.pressures_95[worst] - 1):.1f} % (95 %) as far as tissue decides "
            f"them, the worst at {worst}; {best.determined} of {len(wanted)} parameters within 25 %"
        )
    open_ones = [name for name in wanted if best.factor_95[name] > DETERMINED]
    head = (
        f"{best.records} records in {best.minutes:.0f} min determine {best.determined} of "
        f"{len(wanted)} parameters within 25 %"
    )
    return f"{head}; not {', '.join(open_ones)}" if open_ones else head
