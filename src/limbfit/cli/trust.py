"""The verbs that ask how far a model can be trusted: other choices of sites, and the best ones to test."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from .commands import StudyPath, parse_parameters
from .console import STDOUT, AsJson, listening, print_json
from .experiments import run_verb


def crossvalidate(
    study: StudyPath,
    fit: Annotated[int, typer.Option(help="sites to fit; 0: as many as the study fits", min=0)] = 0,
    choices: Annotated[int, typer.Option(help="choices of sites, drawn where there are more", min=1)] = 200,
    seed: Annotated[int, typer.Option(help="which choices are drawn")] = 0,
    runs: Annotated[int, typer.Option(help="simulations of all sites that make the emulator", min=4)] = 12,
    as_json: AsJson = False,
) -> None:
    """Fit other choices of sites and predict the rest; leave out whole regions."""
    options = {"fit": fit, "choices": choices, "seed": seed, "runs": runs}
    run_verb(study, "crossvalidate", show_crossvalidation, as_json=as_json, **options)


def show_crossvalidation(found: dict[str, Any]) -> None:
    own = found["own"]
    STDOUT.print(
        f"{found['choices']} of {found['choices_possible']} choices of {found['fitted_sites']} sites: mean "
        f"held-out error {own['median_percent']:.2f} % (median; 5 to 95 %: {own['low_percent']:.2f} to "
        f"{own['high_percent']:.2f} %)\n"
        f"the study's own choice ({', '.join(own['fitted'])}): {own['mean_error_heldout_percent']:.2f} %; "
        f"{100 * own['share_better']:.0f} % of the choices do better",
        soft_wrap=True,
    )
    table = Table("left out", "error (%)", box=None)
    for row in found["sites"]:
        if row["mean_percent"] is not None:
            table.add_row(f"site {row['site']}", f"{row['mean_percent']:.2f}")
    for row in found["regions"]:
        table.add_row(f"region {row['label']}", f"{row['mean_error_heldout_percent']:.2f}")
    STDOUT.print(table)
    checks = [row["emulator_error_percent"] for row in found["emulator"]["checks"]]
    if checks:
        STDOUT.print(
            f"the emulator at {len(checks)} of the fits, against the solver: within {max(checks):.2f} %"
        )


def design(
    study: StudyPath,
    sites: Annotated[int, typer.Option(help="how many to choose; 0: as many as the study fits", min=0)] = 0,
    depths: Annotated[
        str | None, typer.Option(help="depths in mm to choose from, such as 3,5,7; default: the study's")
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(help="the law's parameters of each tissue; default: identified, or the study's start"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Choose the sites and depths that determine the parameters best, for records or for a plan."""
    checked = limbfit.load_study(study)
    with listening() as listener:
        found = limbfit.design_study(
            checked,
            sites=sites,
            depths_mm=parse_depths(depths),
            parameters=parse_parameters(parameters, checked),
            listener=listener,
        )
    if as_json:
        print_json(found)
        return
    show_design(found)
    STDOUT.print(f"stored in {found['folder']}; limbfit report shows it", soft_wrap=True)


def parse_depths(text: str | None) -> tuple[float, ...]:
    """``--depths``: positive numbers, in mm."""
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(0 < value < 100 for value in values):
        raise InputError(
            f"{text!r} are no depths", place="--depths", remedy="give millimetres, such as 3,5,7"
        )
    return values


def show_design(found: dict[str, Any]) -> None:
    table = Table("design", "sites (depth in mm)", "D (%)", "A (%)", box=None)
    for row in found["designs"]:
        chosen = ", ".join(f"{one['site']} ({one['depth_mm']:.1f})" for one in row["sites"])
        numbers = (f"{100 * row[key]:.0f}" for key in ("d_efficiency", "a_efficiency"))
        table.add_row(row["design"], chosen, *numbers)
    STDOUT.print(table)
    widths = Table("parameter", *(row["design"] for row in found["designs"]), box=None)
    for name in found["designs"][0]["factor_95"]:
        widths.add_row(name, *(f"x/ {min(row['factor_95'][name], 999):.3g}" for row in found["designs"]))
    STDOUT.print(widths)
    STDOUT.print(found["verdict"], soft_wrap=True)
    for text in found["left_out"]:
        STDOUT.print(f"left out: {text}", soft_wrap=True)


VERBS = (crossvalidate, design)
