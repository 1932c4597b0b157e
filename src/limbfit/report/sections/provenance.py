"""What someone else needs to get the same numbers: times, settings, versions and hashes of inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from ..formats import NOTHING, format_duration, format_fixed
from ..page import Prose, Section, Table, make_section
from ..store import Results
from ..tables import make_row, make_table, to_numeric


def make_timing_section(store: Results) -> Section:
    """How long it took, and on what."""
    machine = store.run.get("machine") or {}
    words = (
        f"{machine['cores']} cores" if "cores" in machine else "",
        f"{format_fixed(machine['memory_GB'])} GB of memory" if "memory_GB" in machine else "",
        f"Python {machine['python']}" if "python" in machine else "",
    )
    known = ", ".join(word for word in words if word)
    return make_section(
        "timing",
        "Computing time",
        make_timing_table(store) if store.run.get("stages") else None,
        Prose(f"Machine: {known}.") if known else None,
        otherwise="No times are stored.",
    )


def make_timing_table(store: Results) -> Table:
    """How long each stage took, with bars."""
    rows = [
        {"stage": name, "seconds": facts["seconds"], "finished": facts.get("finished") or NOTHING}
        for name, facts in store.run["stages"].items()
        if isinstance(facts.get("seconds"), int | float)
    ]
    seconds = [row["seconds"] for row in rows]
    longest = max([*seconds, 1e-9])
    columns = (
        ("Stage", "stage"),
        ("Time", lambda row: to_numeric(format_duration(row["seconds"]), share=row["seconds"] / longest)),
        ("Finished", lambda row: row["finished"][:16].replace("T", " ")),
    )
    total = make_row("Total", to_numeric(format_duration(sum(seconds))), "")
    return make_table("timing", "How long each stage took.", columns, rows, foot=(total,))


def make_settings_section(store: Results) -> Section:
    """Every setting of the study file."""
    flat = flatten_settings(store.run.get("settings") or {})
    caption = "Every setting of the study, defaults included."
    table = make_pair_table("all-settings", caption, ("Key", "Value"), flat)
    return make_section("settings", "Settings", table, otherwise="No settings are stored.")


def make_provenance_section(store: Results) -> Section:
    """Versions and hashes of inputs."""
    versions = {"limbfit": store.run.get("limbfit")} | (store.run.get("versions") or {})
    known = {name: value for name, value in versions.items() if value}
    inputs, head = store.run.get("inputs") or {}, ("Key of the study", "SHA-256")
    return make_section(
        "provenance",
        "Versions and inputs",
        make_pair_table("versions", "Software.", ("Library", "Version"), known),
        make_pair_table("inputs", "Inputs and their SHA-256.", head, inputs),
        otherwise="No versions and input hashes are stored.",
    )


def make_pair_table(name: str, caption: str, head: tuple[str, str], pairs: Mapping[str, Any]) -> Table | None:
    """A table of keys and values; a long one is folded on the screen; None where there are none."""
    rows = tuple(make_row(*pair) for pair in pairs.items())
    return Table(name, caption, head, rows, folded=len(rows) > 12) if rows else None


def flatten_settings(settings: Any, prefix: str = "") -> dict[str, str]:
    """Nested tables as ``table.key`` pairs; the entries of a list of sites go by the site's name."""
    if isinstance(settings, Mapping):
        items: Iterable[tuple[Any, Any]] = settings.items()
    elif isinstance(settings, list) and settings and all(isinstance(one, Mapping) for one in settings):
        items = ((one.get("name", i), one) for i, one in enumerate(settings))
    elif isinstance(settings, list):
        return {prefix: ", ".join(map(str, settings))}
    elif isinstance(settings, bool):
        return {prefix: "yes" if settings else "no"}
    else:
        return {prefix: NOTHING if settings is None else str(settings)}
    flat: dict[str, str] = {}
    for key, value in items:
        flat |= flatten_settings(value, f"{prefix}.{key}" if prefix else str(key))
    return flat
