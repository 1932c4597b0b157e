"""``limbfit febio``: inputs of FEBio on limbfit's own solver."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import limbfit

from .console import STDERR, STDOUT, AsJson, listening, print_json


def febio(
    file: Annotated[Path, typer.Argument(help="input of FEBio 3 or 4 (.feb)", show_default=False)],
    output: Annotated[
        Path | None, typer.Option(help="folder for what the input asks to be written; default: beside it")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="of assembly and linear algebra")] = 1,
    as_json: AsJson = False,
) -> None:
    """Solve a FEBio input with limbfit's solver, and write the log-file tables that it asks for."""
    with listening() as listener:
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


VERBS = (febio,)
