"""Other solvers: FEBio's inputs on limbfit's own, a study's sites as their inputs, both side by side."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

import limbfit

from .commands import Parameters, StudyPath, call_on_study
from .console import AsJson, call_with_progress, fail, print_aside, print_json, print_line, print_warnings


def febio(
    file: Annotated[Path, Argument(help="input of FEBio 3 or 4 (.feb)", show_default=False)],
    output: Annotated[Path | None, Option(help="folder to write to; default: beside it")] = None,
    threads: Annotated[int, Option(min=1, help="threads of assembly and linear algebra")] = 1,
    as_json: AsJson = False,
) -> None:
    """Solve a FEBio input with limbfit's solver, and write the log-file tables that it asks for."""
    result = call_with_progress(limbfit.simulate_feb, file, output, threads=threads)
    if as_json:
        print_json(result)
    else:
        for note in result["notes"]:
            print_aside(f"note: {file}: {note}")
        peak = "" if result["peak_force_N"] is None else f"peak force {result['peak_force_N']:.4g} N, "
        size = f"{peak}{result['steps']} steps, {result['element']}, {result['unknowns']} unknowns"
        print_line(f"{size}; {', '.join(result['files']) or 'no table asked for'}")
    print_warnings(result["warnings"])
    if not result["completed"]:
        fail(f"{file}: the simulation is partial: {result['reason']}", 1)


def export(
    study: StudyPath,
    to: Annotated[
        Literal["feb", "febio-optimize", "inp", "calculix"],
        Option(
            help="feb: FEBio 4; febio-optimize: FEBio's fit of the parameters; inp: Abaqus; calculix",
            show_default=False,
        ),
    ],
    site: Annotated[str | None, Option(help="name; default: all, for febio-optimize all fitted ones")] = None,
    output: Annotated[Path | None, Option(help="a folder; default: results/export")] = None,
    parameters: Parameters = None,
    as_json: AsJson = False,
) -> None:
    """Write indentations as inputs of FEBio, Abaqus or CalculiX, with the numbers of limbfit simulate."""
    options = {"site": site, "output": output, "parameters": parameters}
    result = call_on_study(study, limbfit.export_study, to, **options)
    if as_json:
        print_json(result)
        return
    for row in result["sites"]:
        head = f"site {row['site']}, parameters {row['parameters_from']}"
        print_line(f"{head}: {', '.join(row['files'])}")
        for note in row["notes"]:
            print_aside(f"note: {note}")
    if to == "febio-optimize":
        print_line("run: febio4 -i SITE-model.feb -s SITE-optimize.feb; FEBio fits one site at a time")


def compare(
    study: StudyPath,
    site: Annotated[str, Option(help="name of the site", show_default=False)],
    parameters: Parameters = None,
    febio_log: Annotated[Path | None, Option(help="the table of FEBio elsewhere; it is not run here")] = None,
    as_json: AsJson = False,
) -> None:
    """Solve a site by limbfit and by FEBio; curves and difference go to results/compare."""
    options = {"parameters": parameters, "febio_log": febio_log}
    result = call_on_study(study, limbfit.compare_site, site, **options)
    if as_json:
        print_json(result)
    else:
        print_line(f"FEBio: peak force {result['febio']['peak_force_N']:.4g} N")
        for key, words in (
            ("limbfit", "limbfit"),
            ("limbfit_matched", "limbfit with FEBio's contact penalty and steps"),
        ):
            row = result[key]
            percent = row["difference"]["max_percent"]
            gap = "-" if percent is None else f"{percent:.2f} % of FEBio's peak at most"
            print_line(f"{words}: peak force {row['peak_force_N']:.4g} N, difference {gap}")
        theirs, ours = (result[key]["seconds"] for key in ("febio", "limbfit"))
        if theirs:
            print_line(f"FEBio took {theirs:.1f} s, limbfit {ours:.1f} s: {theirs / ours:.1f} times less")
        print_line(", ".join(result["files"].values()))
    partial = [result[key]["reason"] for key in ("febio", "limbfit", "limbfit_matched")]
    if any(partial):
        fail(f"site {site}: partial: {'; '.join(filter(None, partial))}", 1)


VERBS = (export, febio, compare)
