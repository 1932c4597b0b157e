"""The verbs of the experiments: each runs one, then prints its JSON, or tells of it in its own words."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from .commands import StudyPath
from .console import (
    STDERR,
    STDOUT,
    AsJson,
    format_parameter_heads,
    listen_on_console,
    print_json,
    tell_stored,
)


def run_verb(
    study: Path, name: str, tell: Callable[[dict[str, Any]], None], *, as_json: bool, **options: Any
) -> None:
    """Do the experiment ``name`` with ``options``, tell of it, and say where it is stored."""
    with listen_on_console() as listener:
        found = limbfit.run_experiment(limbfit.load_study(study), name, listener=listener, **options)
    tell_stored(found, tell, as_json)


def cube(
    study: Annotated[
        Path | None,
        typer.Argument(help="study.toml or its folder; without: published tissues only", show_default=False),
    ] = None,
    compression: Annotated[float, typer.Option(help="compression in percent of the cube's side")] = 20.0,
    output: Annotated[Path | None, typer.Option(help="without a study: the folder to write to")] = None,
    as_json: AsJson = False,
) -> None:
    """Compress a cube of this study's tissues and of published ones: the paper's figures 8 and 9."""
    if study is not None:
        if output is not None:
            raise InputError("a study has its own folder", place="--output", remedy="leave it out")
        run_verb(study, "cube", show_cube, as_json=as_json, compression_percent=compression)
        return
    folder = output or Path("cube")
    found = limbfit.compress_cube(folder, compression_percent=compression)
    if as_json:
        print_json(found | {"folder": str(folder)})
        return
    show_cube(found)
    STDOUT.print(f"stored in {folder}: cube.json, cube.csv, cube.svg", soft_wrap=True)


def show_cube(found: dict[str, Any]) -> None:
    table = Table("tissue", "peak (kPa)", "back (kPa)", "least J", box=None)
    table.columns[0].no_wrap = True
    for row in found["tissues"]:
        numbers = (f"{row['peak_kPa']:.3g}", f"{row['back_kPa']:.2f}", f"{row['J_min']:.4f}")
        table.add_row(row["tissue"], *numbers)
    STDOUT.print(table)


class RegionSites(StrEnum):
    all = "all"
    fitted = "fitted"


def regions(
    study: StudyPath,
    sites: Annotated[
        RegionSites,
        typer.Option(help="fit all recorded sites of a region, as the paper, or the study's fitted ones"),
    ] = RegionSites.all,
    as_json: AsJson = False,
) -> None:
    """Identify each region separately, beside the model of the whole limb (the paper's table 3)."""
    run_verb(study, "regions", show_regions, as_json=as_json, sites=sites.value)


def show_regions(found: dict[str, Any]) -> None:
    names = format_parameter_heads(next(iter(found["whole"]["parameters"].values())))
    table = Table("region", "sites", "tissue", *names, "error (%)", "whole (%)", box=None)
    rows = [("whole limb", found["whole"]["fitted_sites"], found["whole"]["parameters"], None, None)]
    errors = ("own_error_percent", "whole_error_percent")
    rows += [
        (row["region"], row["fitted_sites"], row["parameters"], *(row[key] for key in errors))
        for row in found["regions"]
    ]
    for name, sites, parameters, *known in rows:
        words = [name, ", ".join(sites)]
        told = ["" if error is None else f"{error:.2f}" for error in known]
        for tissue, values in parameters.items():
            table.add_row(*words, tissue, *(f"{value:.3g}" for value in values.values()), *told)
            words, told = ["", ""], ["", ""]
    STDOUT.print(table)
    for text in found["left_out"]:
        STDOUT.print(f"left out: {text}", soft_wrap=True)


def uncertainty(
    study: StudyPath,
    models: Annotated[
        str | None,
        typer.Option(
            help="instead, calibrate other models on the same records and weigh them: all, or some of "
            "two-terms, power, fung, fibres, thinner, thicker, friction, separated by commas; each takes as "
            "long as limbfit run",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find what the records determine, what else changes the answer, and how far to trust predictions."""
    if models is None:
        run_verb(study, "uncertainty", show_uncertainty, as_json=as_json)
        return
    names = [name.strip() for name in models.split(",") if name.strip()]
    with listen_on_console() as listener:
        found = limbfit.compare_models(limbfit.load_study(study), names, listener=listener)
    tell_stored(found, show_models, as_json)


def show_models(found: dict[str, Any]) -> None:
    """The weight of each model, and the interval of each record's peak with all of them."""
    columns = ("model", "fitted (%)", "held out (%)", "2 ln B against the study's", "weight (%)")
    table = Table(*columns, box=None)
    for row in found["models"]:
        errors = (row["error_fitted_percent"], row["error_heldout_percent"])
        words = ["" if error is None else f"{error:.2f}" for error in errors]
        table.add_row(row["words"], *words, f"{row['evidence']:+.1f}", f"{100 * row['weight']:.0f}")
    STDOUT.print(table)
    table = Table("record", "", "measured peak", "95 % by the study's model", "95 % by all models", box=None)
    for row in found["records"]:
        ends = (row["own_interval_95"], row["interval_95"])
        words = [f"{low:.3g} to {high:.3g} {row['unit']}" for low, high in ends]
        kind = "fitted" if row["fitted"] else "held out"
        table.add_row(row["record"], kind, f"{row['peak']:.3g} {row['unit']}", *words)
    STDOUT.print(table)
    for text in found["left_out"].values():
        STDOUT.print(f"left out: {text}", soft_wrap=True)


def show_uncertainty(found: dict[str, Any]) -> None:
    table = Table(
        "parameter", "identified", "95 % by the records", "95 % with all sources", "verdict", box=None
    )
    for row in found["parameters"]:
        ranges = [row[key] for key in ("posterior_95", "with_sources_95")]
        words = [f"{low:.3g} to {high:.3g}" for low, high in ranges]
        table.add_row(row["name"], f"{row['calibrated']:.3g}", *words, row["verdict"])
    STDOUT.print(table)
    for text in found["verdict"]:
        STDOUT.print(text, soft_wrap=True)


class Sensitivity(StrEnum):
    c = "c"
    kappa = "kappa"
    contact = "contact"
    indenter = "indenter"
    mesh = "mesh"


def sensitivity(
    study: StudyPath,
    only: Annotated[
        str | None,
        typer.Option(help="some of c, kappa, contact, indenter, mesh, separated by commas; default: all"),
    ] = None,
    site: Annotated[
        list[str] | None,
        typer.Option(help="site, repeatable; default: where tissue over bone is thinnest and thickest"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate again with another c, bulk modulus, friction, indenter or mesh."""
    checked, found = limbfit.load_study(study), {}
    with listen_on_console() as listener:
        for name in parse_sensitivities(only):
            found[name] = limbfit.run_experiment(
                checked, f"sensitivity-{name}", listener=listener, sites=site or []
            )
            if not as_json:
                show_sensitivity(name, found[name])
    if as_json:
        print_json(found)


def parse_sensitivities(only: str | None) -> list[str]:
    """``--only``: names of what is changed."""
    known = [kind.value for kind in Sensitivity]
    names = known if only is None else [name.strip() for name in only.split(",")]
    wrong = [name for name in names if name not in known]
    if wrong:
        raise InputError(f"{wrong[0]!r} cannot be changed", place="--only", remedy=f"use {', '.join(known)}")
    return names


def show_sensitivity(name: str, found: dict[str, Any]) -> None:
    head = ["site", "peak (N)", "change (%)", "mean (%)"] + (
        ["least J", "largest J"] if name == "kappa" else []
    )
    table = Table(f"sensitivity to {name}", *head, box=None)
    for row in found["runs"]:
        numbers = [row["peak_force_N"], row["peak_change_percent"], row["mean_change_percent"]]
        words = ["-" if number is None else f"{number:.2f}" for number in numbers]
        if name == "kappa":
            words += ["-" if row[key] is None else f"{row[key]:.4f}" for key in ("J_min", "J_max")]
        table.add_row(row["label"], row["site"], *words)
    STDOUT.print(table)
    if name == "mesh":
        for row in found["sites"]:
            if row["limit_N"] is not None:
                text = f"site {row['site']}: tends to {row['limit_N']:.3f} N, order {row['order']:.2g}"
                STDOUT.print(f"{text}; the study's mesh is {row['error_percent']:+.2f} % off", soft_wrap=True)
    for row in found["runs"]:
        if not row["completed"]:
            text = f"site {row['site']}, {row['label']}: {row['reason']}"
            STDERR.print(f"warning: partial: {text}", soft_wrap=True)
    STDOUT.print(f"stored in {found['folder']}; limbfit report shows it", soft_wrap=True)


def experiment(
    study: StudyPath,
    name: Annotated[str, typer.Argument(help="name of an experiment, such as one that the study registers")],
    option: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE, the value in JSON or plain text, repeatable")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run an experiment that has no command of its own."""
    run_verb(study, name, print_json, as_json=as_json, **parse_options(option or ()))


def parse_options(words: Iterable[str]) -> dict[str, Any]:
    """``--option``: what an experiment is run with, by name."""
    found = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{word!r} says no value", place="--option", remedy="write NAME=VALUE")
        try:
            found[name] = json.loads(value)
        except ValueError:
            found[name] = value
    return found


VERBS = (cube, regions, sensitivity, uncertainty, experiment)
