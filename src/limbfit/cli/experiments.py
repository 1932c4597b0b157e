"""The verbs of the experiments: each runs one, then prints its JSON, or tells of it in its own words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..errors import InputError
from .console import STDOUT, AsJson, listening, print_json


def run_verb(
    study: Path, name: str, tell: Callable[[dict[str, Any]], None], *, as_json: bool, **options: Any
) -> None:
    """Do the experiment ``name`` with ``options``, tell of it, and say where it is stored."""
    with listening() as listener:
        found = limbfit.run_experiment(limbfit.load_study(study), name, listener=listener, **options)
    if as_json:
        print_json(found)
        return
    tell(found)
    STDOUT.print(f"stored in {found['folder']}; limbfit report shows it", soft_wrap=True)


def cube(
    study: Annotated[
        Path | None,
        typer.Argument(help="study.toml or its folder; without: published tissues only", show_default=False),
    ] = None,
    compression: Annotated[float, typer.Option(help="percent of the side of the cube")] = 20.0,
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


VERBS = (cube,)
