"""The verbs of the socket: what it does to the limb, and the design of one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from ..laws import split_key
from .commands import StudyPath, parse_parameters, show_outside
from .console import STDOUT, AsJson, listen_on_console, tell_stored
from .groups import WithDefault
from .runs import add_execution_options

app = typer.Typer(
    help="Put a socket on the limb and load it (fit, the default), or design one.",
    cls=WithDefault,
    rich_markup_mode=None,
)
OfTissues = Annotated[
    str | None,
    typer.Option(help="the law's parameters of each tissue; default: identified, or those of people"),
]
OfPeople = Annotated[
    bool, typer.Option("--literature", help="tissues of people, even where some were identified")
]


def fit(
    study: StudyPath,
    parameters: OfTissues = None,
    literature: OfPeople = False,
    samples: Annotated[
        int | None,
        typer.Option(
            help="draws of the identified parameters to simulate too, for intervals beyond first order", min=2
        ),
    ] = None,
    models: Annotated[
        bool,
        typer.Option("--models", help="also with every model that limbfit uncertainty --models found likely"),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put a socket on the limb and load it: pressure and shear by region, settling, the report."""
    _check(parameters, literature)
    checked = limbfit.load_study(study)
    if models:
        if parameters is not None or literature or samples:
            raise InputError(
                "models have parameters of their own",
                place="--models",
                remedy="leave out --parameters, --literature and --samples",
            )
        with listen_on_console() as listener:
            mixed = limbfit.fit_socket_of_models(checked, listener=listener)
        tell_stored(mixed, show_socket_models, as_json)
        return
    with listen_on_console() as listener:
        found = limbfit.fit_socket(
            checked,
            parameters=parse_parameters(parameters, checked),
            literature=literature,
            samples=samples or 0,
            listener=listener,
        )
        found["report"] = limbfit.report_study(checked, listener=listener)["report"]
    tell_stored(found, show_socket, as_json)


def show_socket_models(found: dict[str, Any]) -> None:
    """The mean pressure of each region by every model, and the interval of all, for donning and each load."""
    for held in found["loads"]:
        STDOUT.print(f"{held['name']}:")
        heads = (f"{row['words']}, {100 * row['weight']:.0f} %" for row in found["models"])
        table = Table("region, mean (kPa)", *heads, "95 % by all models", box=None)
        for row in held["regions"]:
            low, high = row["interval_kPa"]
            table.add_row(
                row["region"], *(f"{value:.1f}" for value in row["mean_kPa"]), f"{low:.1f} to {high:.1f}"
            )
        STDOUT.print(table)


def show_socket(found: dict[str, Any]) -> None:
    """A table for donning and each load."""
    for note in found["socket"]["notes"]:
        STDOUT.print(f"socket: {note}", soft_wrap=True)
    for name, held in (("donning", found["donning"]), *((one["name"], one) for one in found["loads"])):
        settled = (
            f", settled by {held['settling_mm']:.1f} mm{_format_interval(held)}"
            if "settling_mm" in held
            else ""
        )
        STDOUT.print(
            f"{name}: {held['peak_kPa']:.0f} kPa at most, in touch over "
            f"{held['contact_area_mm2'] / 100:.0f} cm2{settled}",
            soft_wrap=True,
        )
        heads = ("region", "mean (kPa)", "95 % (kPa)", "mostly from", "peak (kPa)", "shear (kPa)")
        table = Table(*heads, box=None)
        for row in held["regions"]:
            known = row["interval_kPa"]
            interval = "" if known is None else f"{known[0]:.1f} to {known[1]:.1f}"
            numbers = [f"{row[key]:.1f}" for key in ("mean_kPa", "peak_kPa", "shear_kPa")]
            table.add_row(
                row["region"], numbers[0], interval, _format_main_cause(row["interval_from"]), *numbers[1:]
            )
        STDOUT.print(table)
    if found["samples"]:
        drawn, failed = found["samples"]["simulated"], found["samples"]["failed"]
        words = "".join(f"; another failed: {reason}" for reason in failed)
        STDOUT.print(f"95 %: by derivatives and {drawn} simulated draws{words}", soft_wrap=True)
    if found["worn_s"]:
        STDOUT.print(
            f"95 %: with what relaxation may do until the socket has been worn for {found['worn_s']:g} s",
            soft_wrap=True,
        )
    STDOUT.print(
        f"tissues: {found['parameters_from']}; contact balances the loads within "
        f"{found['balance_percent']:.2g} %; not a medical device",
        soft_wrap=True,
    )
    show_outside(found["outside_text"])


def _format_main_cause(shares: Mapping[str, float] | None) -> str:
    """The parameter that most of an interval comes from: ``muscle c 84 %``."""
    if not shares:
        return ""
    name, percent = next(iter(shares.items()))
    tissue, _, key = name.partition(".")
    return f"{tissue} {split_key(key)[0]} {percent:.0f} %"


def _format_interval(load: Mapping[str, Any]) -> str:
    known = load["settling_interval_mm"]
    if known is None:
        return ""
    cause = _format_main_cause(load["settling_interval_from"])
    return f" (95 %: {known[0]:.1f} to {known[1]:.1f}, mostly from {cause})"


def design(
    study: StudyPath,
    optimise: Annotated[
        str,
        typer.Option(help="regions whose peaks are to be lowered further, separated by commas"),
    ] = "",
    simulations: Annotated[
        int, typer.Option(help="with --optimise: how many at most, beside those of the two designs", min=1)
    ] = 6,
    parameters: OfTissues = None,
    literature: OfPeople = False,
    as_json: AsJson = False,
) -> None:
    """Design a socket from a target pressure, for printing; load it beside a uniformly reduced one."""
    _check(parameters, literature)
    checked = limbfit.load_study(study)
    with listen_on_console() as listener:
        found = limbfit.design_socket(
            checked,
            optimise=[name.strip() for name in optimise.split(",") if name.strip()],
            simulations=simulations,
            parameters=parse_parameters(parameters, checked),
            literature=literature,
            listener=listener,
        )
    tell_stored(found, show_design, as_json)


def show_design(found: dict[str, Any]) -> None:
    """Peaks of all regions in each design."""
    designs, named = found["designs"], (found["optimisation"] or {}).get("regions", ())
    for one in designs:
        low, high = one["offset_mm"]
        reduced = f", {one['reduction_percent']:.2f} % less around" if "reduction_percent" in one else ""
        STDOUT.print(
            f"{one['name']}: {one['volume_cm3']:.0f} cm3, {low:.1f} to {high:.1f} mm from the unloaded "
            f"limb{reduced}",
            soft_wrap=True,
        )
    table = Table("region, peak (kPa)", *(one["name"] for one in designs), box=None)
    for name in designs[0]["peaks_kPa"]:
        numbers = (one["peaks_kPa"].get(name) for one in designs)
        table.add_row(
            f"{name} *" if name in named else name,
            *("" if number is None else f"{number:.0f}" for number in numbers),
        )
    STDOUT.print(table)
    if named:
        optimisation = found["optimisation"]
        used = len(optimisation["trials"]) - 1
        beyond = ", ".join(optimisation["beyond_limits"])
        STDOUT.print(
            f"* optimised in {used} simulations; "
            + (f"beyond its limit: {beyond}" if beyond else "all others within their limits"),
            soft_wrap=True,
        )
    measured = found["wall"]
    STDOUT.print(
        f"socket.stl: the {measured['of']} with a wall of {measured['stated_mm']:g} mm, measured "
        f"{measured['least_mm']:.2f} mm at least; not a medical device",
        soft_wrap=True,
    )


def _check(parameters: str | None, literature: bool) -> None:
    if parameters is not None and literature:
        raise InputError("give either --parameters or --literature", place="--literature")


for verb in (fit, design):
    app.command()(add_execution_options(verb))
