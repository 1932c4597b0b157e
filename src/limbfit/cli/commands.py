"""The verbs of a study, in the order of ``limbfit --help``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from ..study import Study
from .console import STDERR, STDOUT, AsJson, format_parameter_heads, listen_on_console, print_json

StudyPath = Annotated[
    Path, typer.Argument(help="study.toml, or the folder that holds it", show_default=False)
]


class Detail(StrEnum):
    coarse = "coarse"
    paper = "paper"


class LimbKind(StrEnum):
    transtibial = "transtibial"
    transfemoral = "transfemoral"


class SolverName(StrEnum):
    limbfit = "limbfit"
    febio = "febio"


def list_stage_names() -> list[str]:
    return list(limbfit.STAGE_NAMES)


def demo(
    folder: Annotated[Path, typer.Argument(help="where to put the demo study")] = Path("limbfit-demo"),
    seed: Annotated[int, typer.Option(help="which synthetic patient")] = 0,
    as_json: AsJson = False,
) -> None:
    """Make a coarse synthetic patient and identify it: the whole path, from DICOM to report."""
    start = perf_counter()
    with listen_on_console() as listener:
        summary = limbfit.run_demo(folder, seed=seed, listener=listener)
    summary["seconds"] = round(perf_counter() - start, 1)
    show_summary(summary, as_json)
    if not as_json:
        STDOUT.print(
            f"next: limbfit studio {folder} shows it all in a browser; limbfit uncertainty {folder} finds "
            f"what the records determine; {folder / 'study.toml'} is an example of a study file",
            soft_wrap=True,
        )


def phantom(
    folder: Annotated[Path, typer.Argument(help="a folder that does not exist yet", show_default=False)],
    detail: Annotated[
        Detail, typer.Option(help="coarse: 6 sites, minutes; paper: 256^3, 18 sites")
    ] = Detail.coarse,
    seed: Annotated[int, typer.Option(help="which synthetic patient")] = 0,
    limb: Annotated[LimbKind, typer.Option(help="which limb was amputated")] = LimbKind.transtibial,
    fat: Annotated[bool, typer.Option("--fat", help="three tissues: skin, fat and muscle")] = False,
    tendon: Annotated[
        bool, typer.Option("--tendon", help="also a patellar tendon, a tissue of its own in the muscle")
    ] = False,
    socket: Annotated[bool, typer.Option("--socket", help="also a rectified socket for it")] = False,
    ultrasound: Annotated[
        bool, typer.Option("--ultrasound", help="also what ultrasound sees under the indenter")
    ] = False,
    surface: Annotated[
        bool, typer.Option("--surface", help="also how the skin around the indenter moves")
    ] = False,
    shear_waves: Annotated[
        bool, typer.Option("--shear-waves", help="also how fast shear waves are under the indenter")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a synthetic patient with known truth: MRI as DICOM, traces, study.toml, truth.json."""
    with listen_on_console() as listener:
        truth = limbfit.make_phantom_study(
            folder,
            detail=detail.value,
            seed=seed,
            fat=fat,
            socket=socket,
            ultrasound=ultrasound,
            surface=surface,
            shear_waves=shear_waves,
            tendon=tendon,
            limb=limb.value,
            listener=listener,
        )
    if as_json:
        print_json({"study": str(folder / "study.toml"), **truth})
    else:
        STDOUT.print(f"synthetic patient in {folder}; next: limbfit run {folder}")


def series(
    folder: Annotated[Path, typer.Argument(help="a folder of DICOM files", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """List the DICOM series of a folder, to choose one by its UID (image.series in study.toml)."""
    found = limbfit.describe_series(folder)
    if as_json:
        print_json({"series": found})
        return
    for row in found:
        number = f"series {row['number']}: " if row["number"] else ""
        size = f"{row['slices']} slices of {row['rows']} x {row['columns']}"
        step = " x ".join(f"{s:.4g}" for s in row["spacing_mm"]) + " mm, whole" if row["whole"] else ""
        state = step or f"no volume: {row['why_not']}"
        STDOUT.print(f"{number}{row['modality'] or '?'}, {size}, {state}\n  {row['uid']}", soft_wrap=True)


def check(study: StudyPath, as_json: AsJson = False) -> None:
    """Read every input of a study and report what is wrong, before anything runs."""
    with listen_on_console() as listener:
        findings = limbfit.check_study(limbfit.load_study(study), listener=listener)
    if as_json:
        print_json(findings)
        return
    for line in findings["facts"]:
        STDOUT.print(line)
    show_flags(findings["flags"])
    show_outside(findings["outside_text"])
    STDOUT.print("the study can be run" + (", but see the warnings" if findings["flags"] else ""))


def run(
    study: StudyPath,
    until: Annotated[
        str | None,
        typer.Option(help="stop after this stage of limbfit status", autocompletion=list_stage_names),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option("--from", help="redo this stage and all after it", autocompletion=list_stage_names),
    ] = None,
    force: Annotated[
        list[str] | None,
        typer.Option(
            help="redo this stage, repeatable; kept simulations are used", autocompletion=list_stage_names
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run every stage that is missing or stale; a stopped run continues where it stopped."""
    began = perf_counter()
    with listen_on_console() as listener:
        summary = limbfit.run_study(
            limbfit.load_study(study),
            until=until,
            start=start,
            force=force or (),
            listener=listener,
        )
    summary["seconds"] = round(perf_counter() - began, 1)
    show_summary(summary, as_json)


def status(study: StudyPath, as_json: AsJson = False) -> None:
    """List the stages that are done, begun, stale (and why) or missing."""
    states = limbfit.study_status(limbfit.load_study(study))
    if as_json:
        print_json({"stages": states})
        return
    table = Table("stage", "state", "seconds", "finished", box=None)
    for row in states:
        seconds = "" if row["seconds"] is None else f"{row['seconds']:.1f}"
        table.add_row(row["stage"], row["state"], seconds, row["finished"] or "")
    STDOUT.print(table)
    for row in states:
        if row["why"]:
            STDOUT.print(f"{row['stage']} is stale: {'; '.join(row['why'])}", soft_wrap=True)


def simulate(
    study: StudyPath,
    site: Annotated[str, typer.Option(help="name of the site", show_default=False)],
    parameters: Annotated[
        str | None,
        typer.Option(
            help="the law's parameters of each tissue (c_kPa,m,gamma,tau_s unless the study has another), "
            "outermost first (skin, then muscle, unless the study has layers); default: identified, or the "
            "study's start where nothing is"
        ),
    ] = None,
    animation: Annotated[
        bool, typer.Option("--animation", help="also store the fields of every step, for ParaView")
    ] = False,
    solver: Annotated[
        SolverName | None, typer.Option(help="limbfit's own or FEBio; default: what the study says")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate one indentation; curve and fields go to results/simulate."""
    checked = limbfit.load_study(study)
    with listen_on_console() as listener:
        found = limbfit.simulate_site(
            checked,
            site,
            parameters=parse_parameters(parameters, checked),
            animation=animation,
            solver=None if solver is None else solver.value,
            listener=listener,
        )
    if as_json:
        print_json(found)
    else:
        deep = found["penetration_mm"]
        STDOUT.print(
            f"site {site}: peak force {found['peak_force_N']:.3f} N at {found['depth_mm']:.2f} mm, "
            + (f"penetration {deep:.3f} mm, " if deep is not None else f"{found['solver']}, ")
            + f"{found['element']}, {found['unknowns']} unknowns\n"
            f"parameters: {found['parameters_from']}\n"
            f"curve: {found['curve']}\nfields: {found['fields']}"
        )
    show_warnings([found])
    show_outside(found["outside_text"])
    if not found["completed"]:
        STDERR.print(f"error: site {site}: the simulation is partial: {found['reason']}")
        raise typer.Exit(1)


def report(study: StudyPath, as_json: AsJson = False) -> None:
    """Make the report again from stored results; nothing is solved."""
    with listen_on_console() as listener:
        summary = limbfit.report_study(limbfit.load_study(study), listener=listener)
    show_summary(summary, as_json)


def parse_parameters(text: str | None, study: Study) -> dict[str, dict[str, float]] | None:
    """``--parameters``: the numbers of each tissue, in the order of the study's tissues."""
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    wanted, keys = len(study.parameters), ",".join(study.law.keys)
    if len(values) != wanted or not all(0 <= v < float("inf") for v in values):
        raise InputError(
            f"{text!r} is not {wanted} numbers",
            place="--parameters",
            remedy=f"give {keys} of {', then of '.join(study.tissues)}, separated by commas",
        )
    return study.by_tissue(values)


def show_summary(summary: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(summary)
        return
    if "parameters" in summary:
        show_parameters(summary)
    elif "until" in summary:
        STDOUT.print(f"done until {summary['until']}; results in {summary['results']}")
        return
    if "sites" in summary:  # as the report, not before its stage
        show_sites(summary)
        show_warnings(summary["sites"])
        show_outside(summary["outside_text"])
    show_flags(summary.get("flags", ()))
    if "report" in summary:
        STDOUT.print(f"report: {summary['report']}")


def show_warnings(sites: Sequence[Mapping[str, Any]]) -> None:
    """What is doubtful about the simulations of the sites."""
    for site in sites:
        for text in site["warnings"]:
            STDERR.print(f"warning: site {site.get('record', site['site'])}: {text}", soft_wrap=True)


def show_outside(texts: Sequence[str]) -> None:
    """What predictions do to the tissue that no fitted record did."""
    for text in texts:
        STDERR.print(f"warning: {text}", soft_wrap=True)


def show_flags(flags: Sequence[Mapping[str, Any]]) -> None:
    """What looks wrong about records, names and places."""
    for flag in flags:
        STDERR.print(f"warning: {flag['text']}", soft_wrap=True)


def show_parameters(summary: dict[str, Any]) -> None:
    names = list(next(iter(summary["parameters"].values())))
    table = Table("tissue", *format_parameter_heads(names), box=None)
    rows = [("identified", summary["parameters"])]
    if "truth" in summary:
        rows.append(("truth", summary["truth"]))
    for kind, values in rows:
        for tissue, known in values.items():
            table.add_row(f"{tissue}, {kind}", *(f"{known[name]:.3g}" for name in names))
    STDOUT.print(table)
    for text in summary.get("relaxation", {}).get("words", ()):
        STDOUT.print(f"relaxation: {text}", soft_wrap=True)


def show_sites(summary: dict[str, Any]) -> None:
    table = Table("site", "region", "used", "peak force (N)", "error (%)", box=None)
    for site in summary["sites"]:
        used = "fitted" if site["fitted"] else "held out"
        error = "-" if site["error_percent"] is None else f"{site['error_percent']:.2f}"
        table.add_row(site["record"], site["region"], used, f"{site['peak_force_N']:.2f}", error)
    STDOUT.print(table)
    for kind, key in (("fitted", "mean_error_fitted_percent"), ("held-out", "mean_error_heldout_percent")):
        if summary.get(key) is not None:
            STDOUT.print(f"mean error at the {kind} sites: {summary[key]:.2f} %")
    if summary.get("fit_quality"):
        STDOUT.print(f"fit: {summary['fit_quality']}")


def schema(
    result: Annotated[str, typer.Argument(help="name of the result, such as predict")],
) -> None:
    """Print the JSON schema of a stored result: its keys, their types and what they mean."""
    print_json(limbfit.build_schema(result))


VERBS = (demo, phantom, series, check, run, status, simulate, report, schema)
