"""Many studies, studies once more, whether the machine is fit for it, and where jobs run."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

import limbfit

from ..execution import QUEUES, Placement, place_jobs
from .commands import list_stage_names
from .console import STDERR, STDOUT, AsJson, listen_on_console, print_json

_OPTIONS = {
    "workers": Annotated[
        int | None,
        typer.Option(help="jobs side by side; 0: one per core; default: the study's", min=0, max=1024),
    ],
    "scheduler": Annotated[
        str | None, typer.Option(help="run on the workers of a Dask scheduler, such as tcp://host:8786")
    ],
    "dask": Annotated[
        str | None, typer.Option(help=f"start Dask workers: {', '.join(QUEUES)}, or local processes (local)")
    ],
}


def add_execution_options(verb: Callable[..., None]) -> Callable[..., None]:
    """The verb with ``--workers``, ``--scheduler`` and ``--dask``, which say where its jobs run."""

    @wraps(verb)
    def told(**given: Any) -> None:
        chosen = {name: given.pop(name) for name in _OPTIONS}
        with place_jobs(Placement(**chosen)):
            verb(**given)

    own = list(inspect.signature(verb, eval_str=True).parameters.values())
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        for name, kind in _OPTIONS.items()
    ]
    told.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
    told.__annotations__ = {one.name: one.annotation for one in (*own, *added)}
    return told


def batch(
    studies: Annotated[list[Path], typer.Argument(help="study files or their folders", show_default=False)],
    until: Annotated[
        str | None, typer.Option(help="stop each study after this stage", autocompletion=list_stage_names)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Run many studies on the same workers; one that fails does not stop the others."""
    rows = []
    with listen_on_console() as listener:
        for row in limbfit.run_batch(studies, until=until, listener=listener):
            rows.append(row)
            if row["error"] and not as_json:
                STDERR.print(f"failed: {row['study']}: {row['error']}", soft_wrap=True)
    failed = [row for row in rows if row["state"] == "failed"]
    if as_json:
        print_json({"studies": rows, "failed": len(failed)})
    else:
        table = Table("study", "state", "seconds", "fitted (%)", "held out (%)", box=None)
        for row in rows:
            keys = ("mean_error_fitted_percent", "mean_error_heldout_percent")
            errors = ["-" if row.get(key) is None else f"{row[key]:.2f}" for key in keys]
            table.add_row(row["study"], row["state"], f"{row['seconds']:.1f}", *errors)
        STDOUT.print(table)
        STDOUT.print(f"{len(rows) - len(failed)} of {len(rows)} studies done")
    if failed:
        raise typer.Exit(1)


def reproduce(
    record: Annotated[
        Path, typer.Argument(help="results/run.json of a study, or the study", show_default=False)
    ],
    folder: Annotated[Path, typer.Argument(help="a new folder to run it in", show_default=False)],
    tolerance: Annotated[
        float,
        typer.Option(help="relative tolerance of parameters, and of forces over a site's largest", min=0.0),
    ] = 1e-6,
    as_json: AsJson = False,
) -> None:
    """Run a study again from its record in a new folder, and compare parameters and forces."""
    with listen_on_console() as listener:
        found = limbfit.reproduce_study(record, folder, tolerance=tolerance, listener=listener)
    if as_json:
        print_json(found)
    else:
        for what in ("parameters", "forces"):
            name, most = max(found[what].items(), key=lambda item: item[1])
            STDOUT.print(f"{what}: at most {most:.1e} apart, relative ({name})")
        for name, (then, now) in found["versions"].items():
            STDOUT.print(f"{name}: then {then or 'not installed'}, now {now or 'not installed'}")
        verdict = "the same" if found["same"] else "not the same"
        STDOUT.print(f"{verdict} within {tolerance:g}; run again in {folder}", soft_wrap=True)
    if not found["same"]:
        raise typer.Exit(1)


def doctor(
    folder: Annotated[Path, typer.Argument(help="where studies would lie")] = Path("."),
    as_json: AsJson = False,
) -> None:
    """Check this machine: versions, cores, memory, solvers, meshers, write access, and a small problem."""
    found = limbfit.diagnose(folder)
    if as_json:
        print_json(found)
    else:
        for row in found["checks"]:
            STDOUT.print(f"{row['state']:<8} {row['check']}: {row['found']}", soft_wrap=True)
            if row["remedy"]:
                STDOUT.print(f"         {row['remedy']}", soft_wrap=True)
    if not found["healthy"]:
        raise typer.Exit(1)


VERBS = (add_execution_options(batch), reproduce, doctor)
