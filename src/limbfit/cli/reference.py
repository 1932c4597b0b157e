"""The commands as a page of Markdown: what ``--help`` says, in its groups (docs/commands.md)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import typer.main

from .app import app
from .groups import GROUPS

HEAD = """# Commands

Made by `python -m limbfit.cli.reference`; `limbfit COMMAND --help` says the same. The exit code is 0 when
done, 1 when something failed, 2 for bad usage or bad input, 130 when interrupted.
`limbfit --install-completion` completes commands and options in the shell. The same in many commands:
"""
_MANY = 5  # commands that share an option or argument: it is explained once


def command_page() -> str:
    """All commands with their arguments and options, as Markdown."""
    known: Any = typer.main.get_command(app)
    counted = Counter(_item(one) for _, command in _verbs("", known) for one in _parameters(command))
    shared = {item for item, count in counted.items() if count >= _MANY}
    parts = [HEAD, *(item for item in counted if item in shared)]
    for title, names in GROUPS.items():
        parts.append(f"\n## {title}\n")
        for name in names:
            parts += _section(f"limbfit {name}", known.commands[name], shared)
    return "\n".join(parts)


def _verbs(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """The command, or those inside it."""
    inside = getattr(command, "commands", None)
    if inside is None:
        yield name, command
    else:
        for verb, one in inside.items():
            yield from _verbs(f"{name} {verb}", one)


def _section(name: str, command: Any, shared: set[str]) -> list[str]:
    lines = [f"### {name}\n", _text(command.help)] if hasattr(command, "commands") else []
    for verb, one in _verbs(name, command):
        parameters = _parameters(one)
        arguments = [p for p in parameters if p.param_type_name == "argument"]
        words = (p.name.upper() if p.required else f"[{p.name.upper()}]" for p in arguments)
        own = [item for item in map(_item, parameters) if item not in shared]
        also = [p for p in parameters if _item(p) in shared and p not in arguments]
        lines += [f"### {' '.join([verb, *words])}\n", _text(one.help), *own, *([""] if own else [])]
        lines += [f"Also {', '.join(map(_names, also))}.\n"] if also else []
    return lines


def _parameters(command: Any) -> list[Any]:
    return [one for one in command.params if one.name != "help"]


def _names(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.name.upper()}`"
    return ", ".join(f"`{one}`" for one in (*parameter.opts, *parameter.secondary_opts))


def _item(parameter: Any) -> str:
    return f"* {_names(parameter)}: {_text(getattr(parameter, 'help', '')).strip()}"


def _text(help_text: str | None) -> str:
    paragraphs = (help_text or "").replace("\b", "").split("\n\n")
    return "\n\n".join(" ".join(one.split()) for one in paragraphs) + "\n"


if __name__ == "__main__":
    print(command_page(), end="")
