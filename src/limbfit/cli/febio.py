"""Other solvers: FEBio's inputs on limbfit's own, a study's sites as their inputs, both side by side."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

import limbfit

from .commands import StudyPath, parse_parameters
from .console import STDERR, STDOUT, AsJson, listen_on_console, print_json

Parameters = Annotated[
    str | None,
    typer.Option(help="as in limbfit simulate; default: identified, or the study's start where nothing is"),
]


class Format(StrEnum):
    feb = "feb"
    optimize = "febio-optimize"
    inp = "inp"
    calculix = "calculix"


def febio(
    file: Annotated[Path, typer.Argument(help="input of FEBio 3 or 4 (.feb)", show_default=False)],
    output: Annotated[
        Path | None, typer.Option(help="folder for what the input asks to be written; default: beside it")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="threads of assembly and linear algebra")] = 1,
    as_json: AsJson = False,
) -> None:
    """Solve a FEBio input with limbfit's solver, and write the log-file tables that it asks for."""
    with listen_on_console() as listener:
        found = limbfit.simulate_feb(file, output, threads=threads, listener=listener)
    if as_json:
        print_json(found)
    else:
        for note in found["notes"]:
            STDERR.print(f"note: {file}: {note}", soft_wrap=True)
        peak = "" if found["peak_force_N"] is None else f"peak force {found['peak_force_N']:.4g} N, "
        STDOUT.print(
            f"{peak}{found['steps']} steps, {found['element']}, {found['unknowns']} unknowns; "
            f"{', '.join(found['files']) or 'no table asked for'}",
            soft_wrap=True,
        )
    for warning in found["warnings"]:
        STDERR.print(f"warning: {warning}", soft_wrap=True)
    if not found["completed"]:
        STDERR.print(f"error: {file}: the simulation is partial: {found['reason']}", soft_wrap=True)
        raise typer.Exit(1)


def export(
    study: StudyPath,
    to: Annotated[
        Format,
        typer.Option(
            help="feb: FEBio 4; febio-optimize: FEBio's fit of the parameters; inp: Abaqus; calculix",
            show_default=False,
        ),
    ],
    site: Annotated[
        str | None, typer.Option(help="name of the site; default: all, for febio-optimize all fitted ones")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="a folder; default: results/export")] = None,
    parameters: Parameters = None,
    as_json: AsJson = False,
) -> None:
    """Write indentations as inputs of FEBio, Abaqus or CalculiX, with the numbers of limbfit simulate."""
    checked = limbfit.load_study(study)
    with listen_on_console() as listener:
        found = limbfit.export_study(
            checked,
            to.value,
            site=site,
            output=output,
            parameters=parse_parameters(parameters, checked),
            listener=listener,
        )
    if as_json:
        print_json(found)
        return
    for row in found["sites"]:
        head = f"site {row['site']}, parameters {row['parameters_from']}"
        STDOUT.print(f"{head}: {', '.join(row['files'])}", soft_wrap=True)
        for note in row["notes"]:
            STDERR.print(f"note: {note}", soft_wrap=True)
    if to is Format.optimize:
        STDOUT.print("run: febio4 -i SITE-model.feb -s SITE-optimize.feb; FEBio fits one site at a time")


def compare(
    study: StudyPath,
    site: Annotated[str, typer.Option(help="name of the site", show_default=False)],
    parameters: Parameters = None,
    febio_log: Annotated[
        Path | None,
        typer.Option(help="the table that FEBio wrote elsewhere for the exported input; FEBio is not run"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Solve a site by limbfit and by FEBio; curves and difference go to results/compare."""
    checked = limbfit.load_study(study)
    with listen_on_console() as listener:
        found = limbfit.compare_site(
            checked,
            site,
            parameters=parse_parameters(parameters, checked),
            febio_log=febio_log,
            listener=listener,
        )
    if as_json:
        print_json(found)
    else:
        STDOUT.print(f"FEBio: peak force {found['febio']['peak_force_N']:.4g} N")
        for key, words in (
            ("limbfit", "limbfit"),
            ("limbfit_matched", "limbfit with FEBio's contact penalty and steps"),
        ):
            row = found[key]
            most = row["difference"]["max_percent"]
            gap = "-" if most is None else f"{most:.2f} % of FEBio's peak at most"
            STDOUT.print(f"{words}: peak force {row['peak_force_N']:.4g} N, difference {gap}")
        STDOUT.print(", ".join(found["files"].values()), soft_wrap=True)
    partial = [found[key]["reason"] for key in ("febio", "limbfit", "limbfit_matched")]
    if any(partial):
        STDERR.print(f"error: site {site}: partial: {'; '.join(filter(None, partial))}", soft_wrap=True)
        raise typer.Exit(1)


VERBS = (export, febio, compare)
