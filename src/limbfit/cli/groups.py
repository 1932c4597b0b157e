"""Verbs in groups: the list of ``limbfit --help``, each with its whole first sentence; one that is meant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from typer.core import TyperGroup

GROUPS: Mapping[str, tuple[str, ...]] = {
    "Patient": ("demo", "phantom", "series", "check", "segment", "surfaces", "sites", "mesh"),
    "Identify": ("run", "status", "report", "simulate", "batch", "reproduce"),
    "Trust": ("uncertainty", "crossvalidate", "regions", "sensitivity", "cube", "experiment"),
    "Socket": ("socket",),
    "Experiment": ("design", "acquire", "recording", "virtual-fitsocket"),
    "Exchange": ("export", "febio", "compare", "schema"),
    "Machine": ("studio", "doctor", "bench"),
}
_LONGEST = 500  # characters: none of the sentences is cut


class Grouped(TyperGroup):
    """A command whose help lists its verbs by `GROUPS`."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # of click, or of typer's copy of it
        for title, names in GROUPS.items():
            with formatter.section(title):
                verbs = [(name, self.get_command(ctx, name)) for name in names]
                formatter.write_dl([(name, one.get_short_help_str(_LONGEST)) for name, one in verbs if one])


class WithDefault(TyperGroup):
    """A command whose first verb is meant where none is named."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        verbs = self.list_commands(ctx)
        if not ctx.resilient_parsing and not (args and args[0] in (*verbs, "--help")):
            args = [verbs[0], *args]
        return super().parse_args(ctx, args)
