"""The verbs that ask how far a model can be trusted: other choices of sites, and the best ones to test."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from .commands import StudyPath, parse_parameters
from .console import STDOUT, AsJson, listen_on_console, tell_stored
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
        str | None,
        typer.Option(help="depths in mm to choose from, such as 3,5,7; default: the study's"),
    ] = None,
    parameters: Annotated[
        str | None,
        typer.Option(help="the law's parameters of each tissue; default: identified, or the study's start"),
    ] = None,
    protocol: Annotated[
        bool, typer.Option("--protocol", help="choose the records of a whole session instead")
    ] = False,
    minutes: Annotated[float, typer.Option(help="with --protocol: length of the session, min", min=1)] = 25.0,
    speeds: Annotated[
        str | None,
        typer.Option(help="with --protocol: speeds in mm/s; default: the study's and five times it"),
    ] = None,
    holds: Annotated[
        str | None,
        typer.Option(
            help="with --protocol: holds in s, 0 for none; default: 0,30, for a socket as long as its loads"
        ),
    ] = None,
    determine: Annotated[
        str | None,
        typer.Option(
            help="with --protocol: parameters such as muscle.c_kPa, or socket (pressures); default: all"
        ),
    ] = None,
    criterion: Annotated[
        Literal["D", "A"] | None, typer.Option(help="with --protocol: D or A; default: D, for a socket A")
    ] = None,
    draws: Annotated[int, typer.Option(help="with --protocol: how many tissues", min=1, max=64)] = 3,
    ultrasound: Annotated[
        float | None,
        typer.Option(help="with --protocol: ultrasound reads thicknesses with this deviation, mm", min=1e-3),
    ] = None,
    surface: Annotated[
        float | None,
        typer.Option(help="with --protocol: cameras read the skin with this deviation, mm", min=1e-3),
    ] = None,
    shear_waves: Annotated[
        float | None,
        typer.Option(
            help="with --protocol: elastography reads shear-wave speeds with this deviation, m/s",
            min=1e-3,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Choose the sites and depths that determine the parameters best, for records or for a plan.

    With --protocol: the records (site, indenter, depth, speed, hold) of a session of stated length, judged at
    several tissues; records.toml has them as a study's [[records]].
    """
    checked = limbfit.load_study(study)
    used = parse_parameters(parameters, checked)
    chosen = parse_list(depths, "--depths", "give millimetres, such as 3,5,7")
    with listen_on_console() as listener:
        if protocol:
            found = limbfit.plan_protocol(
                checked,
                minutes=minutes,
                speeds_mm_s=parse_list(speeds, "--speeds", "give mm/s, such as 0.96,4.8"),
                holds_s=parse_list(holds, "--holds", "give seconds, such as 0,30", least=0.0),
                depths_mm=chosen,
                determine=determine.split(",") if determine else (),
                criterion=criterion,
                draws=draws,
                ultrasound_sd_mm=ultrasound,
                surface_sd_mm=surface,
                shear_waves_sd_m_s=shear_waves,
                parameters=used,
                listener=listener,
            )
        else:
            found = limbfit.design_study(
                checked,
                sites=sites,
                depths_mm=chosen,
                parameters=used,
                listener=listener,
            )
    tell_stored(found, show_protocol if protocol else show_design, as_json)


def parse_list(text: str | None, place: str, remedy: str, least: float = 1e-3) -> tuple[float, ...]:
    """Numbers with commas between them, from ``least`` to 600; none where nothing is given."""
    if text is None:
        return ()
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or not all(least <= value <= 600 for value in values):
        raise InputError(f"{text!r} will not do", place=place, remedy=remedy)
    return values


def show_design(found: dict[str, Any]) -> None:
    table = Table("design", "sites (depth in mm)", "D (%)", "A (%)", box=None)
    for row in found["designs"]:
        chosen = ", ".join(f"{one['site']} ({one['depth_mm']:.1f})" for one in row["sites"])
        numbers = (f"{100 * row[key]:.0f}" for key in ("d_efficiency", "a_efficiency"))
        table.add_row(row["design"], chosen, *numbers)
    STDOUT.print(table)
    _show_expected(found, found["designs"])


def show_protocol(found: dict[str, Any]) -> None:
    """The records, then what each protocol would determine."""
    table = Table("site", "indenter", "depth (mm)", "speed (mm/s)", "hold (s)", "force (N)", box=None)
    for row in found["records"]:
        numbers = (f"{row[key]:.3g}" for key in ("depth_mm", "speed_mm_s", "hold_s", "peak_force_N"))
        table.add_row(row["site"], row["indenter"], *numbers)
    STDOUT.print(table)
    _show_expected(found, found["protocols"])


def _show_expected(found: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """The factors of the 95 % intervals that each choice promises, and the verdict."""
    widths = Table("parameter", *(row["design"] for row in rows), box=None)
    for kind in ("factor_95", "pressures_95"):
        for name in rows[0].get(kind, {}):
            widths.add_row(name, *(f"x/ {min(row[kind][name], 999):.3g}" for row in rows))
    STDOUT.print(widths)
    STDOUT.print(found["verdict"], soft_wrap=True)
    for text in found["left_out"]:
        STDOUT.print(f"told: {text}" if "protocols" in found else f"left out: {text}", soft_wrap=True)


VERBS = (crossvalidate, design)
