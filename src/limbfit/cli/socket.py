"""The verb of the socket: what it does to the limb."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from .commands import StudyPath, parse_parameters
from .console import STDOUT, AsJson, listening, print_json


def socket(
    study: StudyPath,
    parameters: Annotated[
        str | None,
        typer.Option(help="the law's parameters of each tissue; default: identified, or those of people"),
    ] = None,
    literature: Annotated[
        bool, typer.Option("--literature", help="tissues of people, although some were identified")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Put a socket on the limb and load it: pressure and shear by region, settling, balance."""
    if parameters is not None and literature:
        raise InputError("give either --parameters or --literature", place="--literature")
    checked = limbfit.load_study(study)
    with listening() as listener:
        found = limbfit.fit_socket(
            checked,
            parameters=parse_parameters(parameters, checked),
            literature=literature,
            listener=listener,
        )
    if as_json:
        print_json(found)
        return
    show_socket(found)
    STDOUT.print(f"stored in {found['folder']}; limbfit report shows it", soft_wrap=True)


def show_socket(found: dict[str, Any]) -> None:
    """A table for donning and each load."""
    for name, held in (("donning", found["donning"]), *((one["name"], one) for one in found["loads"])):
        settled = f", settled by {held['settling_mm']:.1f} mm" if "settling_mm" in held else ""
        STDOUT.print(
            f"{name}: {held['peak_kPa']:.0f} kPa at most, in touch over "
            f"{held['contact_area_mm2'] / 100:.0f} cm2{settled}",
            soft_wrap=True,
        )
        table = Table("region", "mean (kPa)", "95 % (kPa)", "peak (kPa)", "shear (kPa)", box=None)
        for row in held["regions"]:
            known = row["interval_kPa"]
            interval = "" if known is None else f"{known[0]:.1f} to {known[1]:.1f}"
            numbers = [f"{row[key]:.1f}" for key in ("mean_kPa", "peak_kPa", "shear_kPa")]
            table.add_row(row["region"], numbers[0], interval, *numbers[1:])
        STDOUT.print(table)
    STDOUT.print(
        f"tissues: {found['parameters_from']}; contact balances the loads within "
        f"{found['balance_percent']:.2g} %; not a medical device",
        soft_wrap=True,
    )


VERBS = (socket,)
