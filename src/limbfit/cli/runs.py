"""The commands around studies: many of them, one again, the studio, the machine; and where jobs run."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Exit, Option

import limbfit

from ..execution import QUEUES, Placement, place_jobs
from . import console
from .commands import StudyPath, stage_option
from .console import AsJson, Column

_OPTIONS = {
    "workers": Annotated[
        int | None, Option(help="jobs side by side; 0: one per core; default: the study's", min=0, max=1024)
    ],
    "scheduler": Annotated[str | None, Option(help="a Dask scheduler, such as tcp://host:8786")],
    "dask": Annotated[str | None, Option(help=f"start Dask workers: {', '.join(QUEUES)}, or local")],
}


def add_execution_options(verb: Callable[..., None]) -> Callable[..., None]:
    """The verb with ``--workers``, ``--scheduler`` and ``--dask``, which say where its jobs run."""

    @wraps(verb)
    def run(**arguments: Any) -> None:
        chosen = {name: arguments.pop(name) for name in _OPTIONS}
        with place_jobs(Placement(**chosen)):
            verb(**arguments)

    parameters = list(inspect.signature(verb, eval_str=True).parameters.values())
    parameters += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        for name, kind in _OPTIONS.items()
    ]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def batch(
    studies: Annotated[list[Path], Argument(help="study files or their folders", show_default=False)],
    until: Annotated[str | None, stage_option(help="stop each study after this stage")] = None,
    as_json: AsJson = False,
) -> None:
    """Run many studies on the same workers; one that fails does not stop the others."""
    rows = []
    with console.listen_on_console() as listener:
        for row in limbfit.run_batch(studies, until=until, listener=listener):
            rows.append(row)
            if row["error"] and not as_json:
                console.print_aside(f"failed: {row['study']}: {row['error']}")
    failed = [row for row in rows if row["state"] == "failed"]
    if as_json:
        console.print_json({"studies": rows, "failed": len(failed)})
    else:
        columns: dict[str, Column] = {
            "study": "study",
            "state": "state",
            "seconds": ("seconds", ".1f"),
            "fitted (%)": ("mean_error_fitted_percent", ".2f"),
            "held out (%)": ("mean_error_heldout_percent", ".2f"),
        }
        console.print_table(rows, columns)
        console.print_line(f"{len(rows) - len(failed)} of {len(rows)} studies done")
    if failed:
        raise Exit(1)


def reproduce(
    record: Annotated[Path, Argument(help="results/run.json, or the study", show_default=False)],
    folder: Annotated[Path, Argument(help="a new folder to run it in", show_default=False)],
    tolerance: Annotated[float, Option(help="relative; of forces over a site's largest", min=0.0)] = 1e-6,
    as_json: AsJson = False,
) -> None:
    """Run a study again from its record in a new folder, and compare parameters and forces."""
    result = console.call_with_progress(limbfit.reproduce_study, record, folder, tolerance=tolerance)
    if as_json:
        console.print_json(result)
    else:
        for quantity in ("parameters", "forces"):
            name, difference = max(result[quantity].items(), key=lambda item: item[1])
            console.print_line(f"{quantity}: at most {difference:.1e} apart, relative ({name})")
        for name, (then, now) in result["versions"].items():
            console.print_line(f"{name}: then {then or 'not installed'}, now {now or 'not installed'}")
        verdict = "the same" if result["same"] else "not the same"
        console.print_line(f"{verdict} within {tolerance:g}; run again in {folder}")
    if not result["same"]:
        raise Exit(1)


def doctor(
    folder: Annotated[Path, Argument(help="where studies would lie")] = Path("."), as_json: AsJson = False
) -> None:
    """Check this machine: versions, cores, memory, solvers, meshers, write access, and a small problem."""
    result = limbfit.diagnose(folder)
    if as_json:
        console.print_json(result)
    else:
        for row in result["checks"]:
            console.print_line(f"{row['state']:<8} {row['check']}: {row['found']}")
            if row["remedy"]:
                console.print_line(f"         {row['remedy']}")
    if not result["healthy"]:
        raise Exit(1)


def studio(
    study: StudyPath,
    port: Annotated[int, Option(help="port to listen on; 0: a free one", min=0, max=65535)] = 0,
    no_browser: Annotated[bool, Option("--no-browser", help="open no browser")] = False,
    host: Annotated[str, Option(help="the address to listen on")] = "127.0.0.1",
    expose: Annotated[bool, Option("--expose", help="let other machines reach and change the study")] = False,
) -> None:
    """Make a study, view and correct the limb, and watch its identification, in a browser on this machine."""

    def tell(address: str) -> None:
        console.print_line(f"studio of {study}; Ctrl-C ends it, runs go on")
        console.print_line(address)

    limbfit.serve_studio(study, port=port, host=host, expose=expose, browser=not no_browser, tell=tell)


VERBS = (add_execution_options(batch), reproduce, doctor, studio)
