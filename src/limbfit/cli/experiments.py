"""The commands of the experiments: each runs one and prints its result as JSON or in words."""

import json
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

import limbfit

from ..errors import InputError
from ..results.planning import DesignResult, ProtocolResult
from ..results.uncertainty import CrossvalidateResult, ModelsResult, RegionsResult, UncertaintyResult
from ..results.variants import CubeResult, RefinementResult, VolumeResult
from . import console
from .commands import Parameters, StudyPath, call_on_study
from .console import AsJson, Column


def _run_and_print(study: Path, name: str, show: console.Show, as_json: bool, **options: Any) -> None:
    """Do the experiment ``name`` with ``options``, print what it found and where it is stored."""
    result = call_on_study(study, limbfit.run_experiment, name, **options)
    console.print_stored(result, name, show, as_json)


def cube(
    study: Annotated[Path | None, Argument(help="a study; default: published tissues only")] = None,
    compression: Annotated[float, Option(help="compression in percent of the cube's side")] = 20.0,
    output: Annotated[Path | None, Option(help="without a study: the folder to write to")] = None,
    as_json: AsJson = False,
) -> None:
    """Compress a cube of this study's tissues and of published ones: the paper's figures 8 and 9."""
    if study is not None:
        if output is not None:
            raise InputError("a study has its own folder", place="--output", remedy="leave it out")
        _run_and_print(study, "cube", show_cube, as_json, compression_percent=compression)
        return
    folder = output or Path("cube")
    result = limbfit.compress_cube(folder, compression_percent=compression)
    if as_json:
        console.print_json(result | {"folder": str(folder)})
        return
    show_cube(CubeResult.model_validate(result))
    console.print_line(f"stored in {folder}: cube.json, cube.csv, cube.svg")


def show_cube(found: CubeResult) -> None:
    columns: dict[str, Column] = {
        "tissue": "tissue",
        "peak (kPa)": ("peak_kPa", ".3g"),
        "back (kPa)": ("back_kPa", ".2f"),
        "least J": ("J_min", ".4f"),
    }
    console.print_table(found.tissues, columns, unwrapped=("tissue",))


def regions(
    study: StudyPath,
    sites: Annotated[Literal["all", "fitted"], Option(help="of each region; all: as in the paper")] = "all",
    as_json: AsJson = False,
) -> None:
    """Identify each region separately, beside the model of the whole limb (the paper's table 3)."""
    _run_and_print(study, "regions", show_regions, as_json, sites=sites)


def show_regions(found: RegionsResult) -> None:
    whole = found.whole
    fits: list[tuple[Any, ...]] = [("whole limb", whole.fitted_sites, whole.parameters, None, None)]
    for one in found.regions:
        errors = one.own_error_percent, one.whole_error_percent
        fits.append((one.region, one.fitted_sites, one.parameters, *errors))
    rows: list[dict[str, Any]] = []
    for region, sites, parameters, own, error in fits:
        head = {"region": region, "sites": ", ".join(sites), "own": own, "whole": error}
        for tissue, values in parameters.items():
            rows.append(head | values | {"tissue": tissue})
            head = {"region": "", "sites": ""}
    keys = list(next(iter(whole.parameters.values())))
    columns: dict[str, Column] = {
        "region": "region",
        "sites": "sites",
        "tissue": "tissue",
        **console.build_parameter_columns(keys),
        "error (%)": ("own", ".2f"),
        "whole (%)": ("whole", ".2f"),
    }
    console.print_table(rows, columns, dash="")
    _show_left_out(found.left_out)


def _show_left_out(texts: Iterable[str]) -> None:
    for text in texts:
        console.print_line(f"left out: {text}")


def uncertainty(
    study: StudyPath,
    models: Annotated[
        str | None,
        Option(
            help="instead, calibrate other models on the same records and weigh them: all, or some of "
            "two-terms, power, fung, fibres, thinner, thicker, friction, separated by commas; each takes as "
            "long as limbfit run"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find what the records determine, what else changes the answer, and how far to trust predictions."""
    if models is None:
        _run_and_print(study, "uncertainty", show_uncertainty, as_json)
        return
    names = [name.strip() for name in models.split(",") if name.strip()]
    result = call_on_study(study, limbfit.compare_models, names)
    console.print_stored(result, "models", show_models, as_json)


def show_models(found: ModelsResult) -> None:
    """The weight of each model, and the interval of each record's peak with all of them."""
    columns: dict[str, Column] = {
        "model": "words",
        "fitted (%)": ("error_fitted_percent", ".2f"),
        "held out (%)": ("error_heldout_percent", ".2f"),
        "2 ln B against the study's": ("evidence", "+.1f"),
        "weight (%)": lambda row: f"{100 * row.weight:.0f}",
    }
    console.print_table(found.models, columns, dash="")
    columns = {
        "record": "record",
        "": console.format_use,
        "measured peak": lambda row: f"{row.peak:.3g} {row.unit}",
        "95 % by the study's model": lambda row: f"{console.format_ends(row.own_interval_95)} {row.unit}",
        "95 % by all models": lambda row: f"{console.format_ends(row.interval_95)} {row.unit}",
    }
    console.print_table(found.records, columns)
    _show_left_out(found.left_out.values())


def show_uncertainty(found: UncertaintyResult) -> None:
    columns: dict[str, Column] = {
        "parameter": "name",
        "identified": ("calibrated", ".3g"),
        "95 % by the records": lambda row: console.format_ends(row.posterior_95),
        "95 % with all sources": lambda row: console.format_ends(row.with_sources_95),
        "verdict": "verdict",
    }
    console.print_table(found.parameters, columns)
    for text in found.verdict:
        console.print_line(text)


SENSITIVITIES = ("c", "kappa", "contact", "indenter", "mesh")


def sensitivity(
    study: StudyPath,
    only: Annotated[str | None, Option(help="some of c,kappa,contact,indenter,mesh; default: all")] = None,
    site: Annotated[list[str] | None, Option(help="repeatable; default: over thin and thick tissue")] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate again with another c, bulk modulus, friction, indenter or mesh."""
    results, names = {}, list(SENSITIVITIES) if only is None else [name.strip() for name in only.split(",")]
    if wrong := [name for name in names if name not in SENSITIVITIES]:
        remedy = f"use {', '.join(SENSITIVITIES)}"
        raise InputError(f"{wrong[0]!r} cannot be changed", place="--only", remedy=remedy)
    for name in names:
        result = call_on_study(study, limbfit.run_experiment, f"sensitivity-{name}", sites=site or [])
        results[name] = result
        if not as_json:
            console.print_stored(result, f"sensitivity_{name}", partial(show_sensitivity, name), False)
    if as_json:
        console.print_json(results)


def show_sensitivity(name: str, found: Any) -> None:
    columns: dict[str, Column] = {
        f"sensitivity to {name}": "label",
        "site": "site",
        "peak (N)": ("peak_force_N", ".2f"),
        "change (%)": ("peak_change_percent", ".2f"),
        "mean (%)": ("mean_change_percent", ".2f"),
    }
    if isinstance(found, VolumeResult):
        columns |= {"least J": ("J_min", ".4f"), "largest J": ("J_max", ".4f")}
    console.print_table(found.runs, columns)
    for row in found.sites if isinstance(found, RefinementResult) else ():
        if row.limit_N is not None:
            text = f"{row.limit_N:.3f} N on the finest mesh, from which nothing can be extrapolated"
            if row.order:
                text = f"tends to {row.limit_N:.3f} N, order {row.order:.2g}"
            console.print_line(f"site {row.site}: {text}; the study's mesh is {row.error_percent:+.2f} % off")
    for row in found.runs:
        if not row.completed:
            console.print_warning(f"partial: site {row.site}, {row.label}: {row.reason}")


def experiment(
    study: StudyPath,
    name: Annotated[str, Argument(help="name of an experiment, such as one that the study registers")],
    option: Annotated[list[str] | None, Option(help="NAME=VALUE, in JSON or plain text, repeatable")] = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment that has no command of its own."""
    checked, options = limbfit.load_study(study), parse_options(option or ())
    result = console.call_with_progress(limbfit.run_experiment, checked, name, **options)
    console.print_json(result)
    if not as_json:
        console.print_line(f"stored in {result['folder']}; limbfit report shows it")


def parse_options(words: Iterable[str]) -> dict[str, Any]:
    """``--option``: what an experiment is run with, by name."""
    result = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{word!r} says no value", place="--option", remedy="write NAME=VALUE")
        try:
            result[name] = json.loads(value)
        except ValueError:
            result[name] = value
    return result


def crossvalidate(
    study: StudyPath,
    fit: Annotated[int, Option(help="sites to fit; 0: as many as the study fits", min=0)] = 0,
    choices: Annotated[int, Option(help="choices of sites, drawn where there are more", min=1)] = 200,
    seed: Annotated[int, Option(help="which choices are drawn", min=0)] = 0,
    runs: Annotated[int, Option(help="simulations of all sites that make the emulator", min=4)] = 12,
    as_json: AsJson = False,
) -> None:
    """Fit other choices of sites and predict the rest; leave out whole regions."""
    options = {"fit": fit, "choices": choices, "seed": seed, "runs": runs}
    _run_and_print(study, "crossvalidate", show_crossvalidation, as_json, **options)


def show_crossvalidation(found: CrossvalidateResult) -> None:
    own, checks = found.own, found.emulator.checks
    choices = f"{found.choices} of {found.choices_possible} choices of {found.fitted_sites} sites"
    quantiles = f"median; 5 to 95 %: {own.low_percent:.2f} to {own.high_percent:.2f} %"
    console.print_line(f"{choices}: mean held-out error {own.median_percent:.2f} % ({quantiles})")
    if own.share_better is not None:  # the study's own choice leaves sites to be predicted
        error = f"the study's own choice ({', '.join(own.fitted)}): {own.mean_error_heldout_percent:.2f} %"
        console.print_line(f"{error}; {100 * own.share_better:.0f} % of the choices do better")
    known = [row for row in found.sites if row.mean_percent is not None]
    rows = [{"name": f"site {row.site}", "error": row.mean_percent} for row in known]
    for fit in found.regions:
        rows.append({"name": f"region {fit.label}", "error": fit.mean_error_heldout_percent})
    console.print_table(rows, {"left out": "name", "error (%)": ("error", ".2f")})
    if checks:
        largest = max(row.emulator_error_percent for row in checks)
        console.print_line(
            f"the emulator at {len(checks)} of the fits, against the solver: within {largest:.2f} %"
        )


def _session_option(help: str, **limits: Any) -> Any:
    """An option of ``design --protocol``; None where it is not given."""
    return Option(help=f"with --protocol: {help}", **limits)


def design(
    study: StudyPath,
    sites: Annotated[int | None, Option(help="how many to choose; default: as the study fits", min=0)] = None,
    depths: Annotated[str | None, Option(help="depths in mm, such as 3,5,7; default: the study's")] = None,
    parameters: Parameters = None,
    protocol: Annotated[bool, Option("--protocol", help="choose the records of a session instead")] = False,
    minutes: Annotated[float | None, _session_option("its length in minutes; default: 25", min=1)] = None,
    speeds: Annotated[str | None, _session_option("speeds, mm/s; default: the study's, 5 times it")] = None,
    holds: Annotated[str | None, _session_option("holds, s; default: 0,30, for a socket its loads'")] = None,
    determine: Annotated[str | None, _session_option("such as muscle.c_kPa, or socket; default: all")] = None,
    criterion: Annotated[Literal["D", "A"] | None, _session_option("default: D, for a socket A")] = None,
    draws: Annotated[int | None, _session_option("how many tissues; default: 3", min=1, max=64)] = None,
    ultrasound: Annotated[float | None, _session_option("deviation of ultrasound, mm", min=1e-3)] = None,
    surface: Annotated[float | None, _session_option("deviation of cameras, mm", min=1e-3)] = None,
    shear_waves: Annotated[float | None, _session_option("deviation of elastography, m/s", min=1e-3)] = None,
    as_json: AsJson = False,
) -> None:
    """Choose the sites and depths that determine the parameters best, for records or for a plan.

    With --protocol: the records (site, indenter, depth, speed, hold) of a session of stated length, judged at
    several tissues; records.toml has them as a study's [[records]].
    """
    depths_mm = parse_list(depths, "--depths", "give millimetres, such as 3,5,7")
    options: dict[str, Any] = {"depths_mm": depths_mm, "parameters": parameters}
    of_session = {
        "minutes": minutes,
        "speeds": speeds,
        "holds": holds,
        "determine": determine,
        "criterion": criterion,
        "draws": draws,
        "ultrasound": ultrasound,
        "surface": surface,
        "shear-waves": shear_waves,
    }
    if not protocol:
        console.refuse_idle_options(of_session, "without --protocol")
        result = call_on_study(study, limbfit.design_study, sites=sites or 0, **options)
        console.print_stored(result, "design", show_design, as_json)
        return
    console.refuse_idle_options({"sites": sites}, "with --protocol")
    result = call_on_study(
        study,
        limbfit.plan_protocol,
        minutes=25.0 if minutes is None else minutes,
        speeds_mm_s=parse_list(speeds, "--speeds", "give mm/s, such as 0.96,4.8"),
        holds_s=parse_list(holds, "--holds", "give seconds, such as 0,30", least=0.0),
        determine=determine.split(",") if determine else (),
        criterion=criterion,
        draws=3 if draws is None else draws,
        ultrasound_sd_mm=ultrasound,
        surface_sd_mm=surface,
        shear_waves_sd_m_s=shear_waves,
        **options,
    )
    console.print_stored(result, "protocol", show_protocol, as_json)


def parse_list(text: str | None, place: str, remedy: str, least: float = 1e-3) -> tuple[float, ...]:
    """Numbers with commas between them, from ``least`` to 600; none where nothing is given."""
    if text is None:
        return ()
    values = console.parse_numbers(text, least, 600.0)
    if not values:
        raise InputError(f"{text!r} will not do", place=place, remedy=remedy)
    return tuple(values)


def show_design(found: DesignResult) -> None:
    columns: dict[str, Column] = {
        "design": "design",
        "sites (depth in mm)": lambda row: ", ".join(f"{one.site} ({one.depth_mm:.1f})" for one in row.sites),
        "D (%)": lambda row: f"{100 * row.d_efficiency:.0f}",
        "A (%)": lambda row: f"{100 * row.a_efficiency:.0f}",
    }
    console.print_table(found.designs, columns)
    _show_expected({one.design: one.factor_95 for one in found.designs}, found.verdict)
    _show_left_out(found.left_out)


def show_protocol(found: ProtocolResult) -> None:
    """The records, then what each protocol would determine."""
    columns: dict[str, Column] = {
        "site": "site",
        "indenter": "indenter",
        "depth (mm)": ("depth_mm", ".3g"),
        "speed (mm/s)": ("speed_mm_s", ".3g"),
        "hold (s)": ("hold_s", ".3g"),
        "force (N)": ("peak_force_N", ".3g"),
    }
    console.print_table(found.records, columns)
    expected = {one.design: {**one.factor_95, **one.pressures_95} for one in found.protocols}
    _show_expected(expected, found.verdict)
    _show_left_out(found.left_out)


def _show_expected(choices: Mapping[str, Mapping[str, float]], verdict: str) -> None:
    """The factors of the 95 % intervals that each choice promises, and the verdict."""
    rows = [
        {"parameter": name, **{choice: f"x/ {min(of[name], 999):.3g}" for choice, of in choices.items()}}
        for name in next(iter(choices.values()))
    ]
    console.print_table(rows, {head: head for head in ("parameter", *choices)})
    console.print_line(verdict)


VERBS = (cube, regions, sensitivity, uncertainty, experiment, crossvalidate, design)
