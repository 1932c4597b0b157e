"""The list of verbs in ``limbfit --help``: in groups, each with its whole first sentence."""

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
    "Exchange": ("export", "febio", "compare"),
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
