"""The commands as a page of Markdown: what ``--help`` says, in its groups (docs/commands.md)."""

from __future__ import annotations

from typing import Any

import typer.main

from .app import app
from .groups import GROUPS

HEAD = """# Commands

Made by `python -m limbfit.cli.reference`; `limbfit COMMAND --help` says the same. Every command takes
`--json` and then prints one JSON object. The exit code is 0 when done, 1 when something failed, 2 for bad
usage or bad input, 130 when interrupted.
`limbfit --install-completion` completes commands and options in the shell.
"""


def command_page() -> str:
    """All commands with their arguments and options, as Markdown."""
    known: Any = typer.main.get_command(app)
    parts = [HEAD]
    for title, names in GROUPS.items():
        parts.append(f"\n## {title}\n")
        for name in names:
            parts += _command(f"limbfit {name}", known.commands[name])
    return "\n".join(parts)


def _command(name: str, command: Any) -> list[str]:
    if hasattr(command, "commands"):
        inner = [line for verb, one in command.commands.items() for line in _command(f"{name} {verb}", one)]
        return [f"### {name}\n", _text(command.help), *inner]
    rows = [_row(one) for one in command.params if one.name != "help"]
    table = ["| | |", "|---|---|", *rows, ""] if rows else []
    return [f"### {name}\n", _text(command.help), *table]


def _row(parameter: Any) -> str:
    names = ", ".join(f"`{one}`" for one in (*parameter.opts, *parameter.secondary_opts))
    if parameter.param_type_name == "argument":
        names = f"`{parameter.name.upper()}`"
    return f"| {names} | {_text(getattr(parameter, 'help', '')).strip().replace('|', chr(92) + '|')} |"


def _text(help_text: str | None) -> str:
    paragraphs = (help_text or "").replace("\b", "").split("\n\n")
    return "\n\n".join(" ".join(one.split()) for one in paragraphs) + "\n"


if __name__ == "__main__":
    print(command_page(), end="")
