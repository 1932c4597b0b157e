"""``limbfit bench``: the solver against FEBio's results, its time and memory, identification."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table
from typer import Argument, Option, Typer

import limbfit

from ..bench import LARGE_UNKNOWNS, UNKNOWNS
from ..execution import count_usable_cores
from . import console
from .console import AsJson, Column

app = Typer(help="Benchmarks of solver and identification.", no_args_is_help=True, rich_markup_mode=None)

Reference = Annotated[Path | None, Option(help="FEBio's results; default: shared/reference, here or above")]
Threads = Annotated[int, Option(min=1, help="threads of the linear algebra; default: all cores")]
BesideFebio = Annotated[bool, Option("--beside-febio", help="run FEBio itself afterwards")]
CORES = count_usable_cores()


def _bench(
    name: str, run: Callable[..., Any], arguments: tuple[Any, ...], show: console.Show, as_json: bool
) -> None:
    """Run a benchmark, show how far it is, and print what it found."""
    with console.listen_on_console() as listener:

        def tell(done: int, total: int, text: str) -> None:
            listener(limbfit.Progress(name, done, total, text))

        result = run(*arguments, tell=tell)
    console.print_result(result, show, as_json)


@app.command()
def febio_parity(reference: Reference = None, as_json: AsJson = False) -> None:
    """Compare forces and stresses with FEBio 4.11 on the same mesh, with the same element and steps."""
    _bench("febio-parity", limbfit.bench_febio_parity, (reference,), show_parity, as_json)


def show_parity(rows: list[dict[str, Any]]) -> None:
    columns: dict[str, Column] = {
        "case": "case",
        "element": "element",
        "difference (%)": ("max_difference_percent", ".2g"),
        "goal (%)": ("goal_percent", "g"),
        "peak": lambda row: format_peak(row, "peak_"),
        "FEBio's peak": lambda row: format_peak(row, "febio_peak_"),
        "what explains it": "note",
    }
    console.print_table(rows, columns)


def format_peak(row: Mapping[str, Any], start: str) -> str:
    """The first value whose key begins with ``start``, with the unit at the end of the key."""
    key = next((key for key in row if key.startswith(start)), None)
    return "-" if key is None else f"{row[key]:.4g} {key.rpartition('_')[2]}"


@app.command()
def forward(
    reference: Reference = None,
    case: Annotated[str, Option(help="case of the reference folder")] = "residuum/posterior_tet10",
    element: Annotated[str, Option(help="name in the element table; default: that of the mesh")] = "",
    threads: Threads = CORES,
    as_febio: Annotated[bool, Option("--as-febio", help="with FEBio's quadrature and penalty")] = False,
    beside_febio: BesideFebio = False,
    as_json: AsJson = False,
) -> None:
    """Time one simulation of a reference case, plain and with sensitivities."""
    arguments = (reference, case, element, threads, as_febio, beside_febio)
    _bench("forward", limbfit.bench_forward, arguments, show_facts, as_json)


@app.command()
def socket(
    reference: Reference = None,
    case: Annotated[str, Option(help="case of its folder socket: slide, cone, cone-load or tube")] = "cone",
    threads: Threads = CORES,
    beside_febio: BesideFebio = False,
    as_json: AsJson = False,
) -> None:
    """Time FEBio's input of a socket that is donned or loaded, with FEBio's steps and contact."""
    _bench("socket", limbfit.bench_socket, (reference, case, threads, beside_febio), show_facts, as_json)


@app.command()
def scaling(
    element: Annotated[str, Option(help="name in the element table")] = "tet10",
    large: Annotated[bool, Option("--large", help="also 125,000 to 300,000 unknowns")] = False,
    threads: Threads = CORES,
    as_json: AsJson = False,
) -> None:
    """Time and memory over the number of unknowns, and of a model of the paper's size."""
    sizes = (*UNKNOWNS, *(LARGE_UNKNOWNS if large else ()))
    _bench("scaling", limbfit.bench_scaling, (element, sizes, threads), show_scaling, as_json)


def show_scaling(result: dict[str, Any]) -> None:
    columns: dict[str, Column] = {key: key for key in ("element", "cells", "unknowns", "steps")}
    columns |= {"seconds": ("seconds", ".1f"), "memory (MB)": ("max_rss_MB", ".0f")}
    console.print_table((*result["sizes"], result["paper_sized"]), columns)
    console.print_line(f"seconds grow as unknowns^{result['seconds_exponent']:.2f}")


@app.command()
def calibrate(
    study: Annotated[Path | None, Argument(help="a study; default: the coarse phantom of seed 0")] = None,
    beside_febio: BesideFebio = False,
    as_json: AsJson = False,
) -> None:
    """Identify a copy of a study from scratch, and time it.

    With --beside-febio: beside FEBio's loop of finite differences, extrapolated from one run of FEBio.
    """
    result = console.call_with_progress(limbfit.bench_calibrate, study, beside_febio=beside_febio)
    console.print_result(result, show_facts, as_json)


def show_facts(facts: dict[str, Any]) -> None:
    table = Table(box=None, show_header=False)
    for key, value in facts.items():
        rows = {f"{key}: {part}": v for part, v in value.items()} if isinstance(value, dict) else {key: value}
        for name, entry in rows.items():
            table.add_row(name, f"{entry:.4g}" if isinstance(entry, float) else str(entry))
    console.STDOUT.print(table)
