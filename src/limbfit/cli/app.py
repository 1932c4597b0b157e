"""The ``limbfit`` command: its verbs, and the one place where errors become exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from .._version import __version__
from ..errors import InputError, LimbfitError
from ..execution import SAFE_PATH
from . import acquire, bench, commands, experiments, febio, geometry, runs, socket, studio, trust
from .console import INTERRUPTED, STDOUT, fail, prompt_interrupt
from .groups import Grouped

app = typer.Typer(
    name="limbfit",
    help="Patient-specific viscoelastic finite-element models of residual limbs, from MRI and indentations.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    cls=Grouped,
)


@app.callback(invoke_without_command=True)
def top(
    version: Annotated[bool, typer.Option("--version", help="print the version and stop")] = False,
) -> None:
    if version:
        STDOUT.print(f"limbfit {__version__}")
        raise typer.Exit


_PLACED = {commands.run, commands.demo, *experiments.VERBS, *trust.VERBS}
_VERBS: tuple[Callable[..., None], ...] = (
    *(*commands.VERBS, *geometry.VERBS, *experiments.VERBS, *trust.VERBS, *febio.VERBS),
    *runs.VERBS,
    *acquire.VERBS,
    *studio.VERBS,
)
for verb in _VERBS:
    app.command()(runs.add_execution_options(verb) if verb in _PLACED else verb)
app.add_typer(socket.app, name="socket")
app.add_typer(bench.app, name="bench")


def main() -> None:
    """The entry point: errors become one line and an exit code."""
    os.environ.update(SAFE_PATH)  # for all that a verb starts
    try:
        with prompt_interrupt():
            app()
    except LimbfitError as error:
        fail(str(error), 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        fail(INTERRUPTED, 130)
    except BrokenPipeError:
        sys.exit(1)
    except Exception as error:
        if os.environ.get("LIMBFIT_TRACEBACK"):
            raise
        fail(
            f"internal error: {type(error).__name__}: {error}; set LIMBFIT_TRACEBACK=1 to see where, "
            "and please report it",
            1,
        )
