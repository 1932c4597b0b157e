"""The commands as a page of Markdown: what ``--help`` says, in its groups (docs/commands.md)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import typer.main

from limbfit.cli import GROUPS, app

HEAD = """# Commands

Made by `python docs/build_commands.py`; `limbfit COMMAND --help` says the same. The exit code is 0 when
done, 1 when something failed, 2 for bad usage or bad input, 130 when interrupted.
`limbfit --install-completion` completes commands and options in the shell. The same in many commands:
"""
_MANY = 5  # commands that share an option or argument: it is explained once


def build_command_page() -> str:
    """All commands with their arguments and options, as Markdown."""
    root: Any = typer.main.get_command(app)
    counted = Counter(
        _format_item(parameter) for _, command in _list_verbs("", root) for parameter in command.params
    )
    shared = {item for item, count in counted.items() if count >= _MANY}
    parts = [HEAD, *(item for item in counted if item in shared)]
    for title, names in GROUPS.items():
        parts.append(f"\n## {title}\n")
        for name in names:
            parts += _format_section(f"limbfit {name}", root.commands[name], shared)
    return "\n".join(parts)


def _list_verbs(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """The command, or those inside it."""
    subcommands = getattr(command, "commands", None)
    if subcommands is None:
        yield name, command
    else:
        for verb, subcommand in subcommands.items():
            yield from _list_verbs(f"{name} {verb}", subcommand)


def _format_section(name: str, command: Any, shared: set[str]) -> list[str]:
    lines = [f"### {name}\n", _format_text(command.help)] if hasattr(command, "commands") else []
    for verb, subcommand in _list_verbs(name, command):
        parameters = subcommand.params
        arguments = [p for p in parameters if p.param_type_name == "argument"]
        words = (p.name.upper() if p.required else f"[{p.name.upper()}]" for p in arguments)
        unshared = [item for item in map(_format_item, parameters) if item not in shared]
        also = [p for p in parameters if _format_item(p) in shared and p not in arguments]
        lines += [
            f"### {' '.join([verb, *words])}\n",
            _format_text(subcommand.help),
            *unshared,
            *([""] if unshared else []),
        ]
        lines += [f"Also {', '.join(map(_format_names, also))}.\n"] if also else []
    return lines


def _format_names(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return f"`{parameter.name.upper()}`"
    return ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))


def _format_item(parameter: Any) -> str:
    return f"* {_format_names(parameter)}: {_format_text(getattr(parameter, 'help', '')).strip()}"


def _format_text(help_text: str | None) -> str:
    paragraphs = (help_text or "").replace("\b", "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs) + "\n"


if __name__ == "__main__":
    print(build_command_page(), end="")
