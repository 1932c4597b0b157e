"""The command line: one verb, one library call; the only place that prints and exits.

Exit codes: 0 done, 1 failed, 2 bad usage or bad input, 130 interrupted (the study can be resumed).
"""

import os
import sys
from collections.abc import Mapping
from io import TextIOWrapper
from typing import Annotated, Any

from typer import Exit, Option, Typer
from typer.core import TyperGroup

from .._version import __version__
from ..errors import InputError, LimbfitError
from ..execution import SAFE_PATH
from . import acquire, bench, commands, experiments, febio, init, population, runs, shapes, socket
from .console import INTERRUPTED, fail, print_line, prompt_interrupt

GROUPS: Mapping[str, tuple[str, ...]] = {
    "Patient": ("demo", "phantom", "init", "series", "check", "segment", "surfaces", "sites", "mesh"),
    "Identify": ("run", "status", "report", "simulate", "batch", "reproduce"),
    "Trust": ("uncertainty", "crossvalidate", "regions", "sensitivity", "cube", "experiment"),
    "Socket": ("socket", "population", "shapes"),
    "Experiment": ("design", "acquire", "recording", "watch", "rig", "virtual-fitsocket"),
    "Exchange": ("export", "febio", "compare", "schema"),
    "Machine": ("studio", "doctor", "bench"),
}
_MAX_HELP = 500  # characters: none of the sentences is cut


class GroupedCommands(TyperGroup):
    """A command whose help lists its commands by `GROUPS`, each with its whole first sentence."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # of click, or of typer's copy of it
        for title, names in GROUPS.items():
            with formatter.section(title):
                verbs = [(name, self.get_command(ctx, name)) for name in names]
                rows = [(name, verb.get_short_help_str(_MAX_HELP)) for name, verb in verbs if verb]
                formatter.write_dl(rows)


app = Typer(
    name="limbfit",
    help="Patient-specific viscoelastic finite-element models of residual limbs, from MRI and indentations.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    cls=GroupedCommands,
)


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, Option("--version", help="print the version and stop")] = False) -> None:
    if version:
        print_line(f"limbfit {__version__}")
        raise Exit


_WITH_JOBS = {commands.run, commands.demo, *experiments.VERBS}
for verb in (*commands.VERBS, *init.VERBS, *experiments.VERBS, *febio.VERBS, *runs.VERBS, *acquire.VERBS):
    app.command()(runs.add_execution_options(verb) if verb in _WITH_JOBS else verb)
app.add_typer(socket.app, name="socket")
app.add_typer(population.app, name="population")
app.add_typer(shapes.app, name="shapes")
app.add_typer(bench.app, name="bench")


def main() -> None:
    """The entry point: errors become one line and an exit code."""
    os.environ.update(SAFE_PATH)  # for all that a verb starts
    if isinstance(sys.stdout, TextIOWrapper):  # letters that its encoding lacks must not end a command
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with prompt_interrupt():
            app()
    except LimbfitError as error:
        fail(str(error), 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt:
        fail(INTERRUPTED, 130)
    except PermissionError as error:
        fail(f"{error.filename}: no permission to read or write it; check its owner and mode", 2)
    except (FileExistsError, NotADirectoryError) as error:
        fail(f"{error.filename}: a file stands where a folder is wanted; give another place", 2)
    except BrokenPipeError:
        sys.exit(1)
    except Exception as error:
        if os.environ.get("LIMBFIT_TRACEBACK"):
            raise
        text = f"internal error: {type(error).__name__}: {error}"
        fail(f"{text}; set LIMBFIT_TRACEBACK=1 to see where, and please report it", 1)
