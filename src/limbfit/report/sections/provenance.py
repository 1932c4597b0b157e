"""What someone else needs to get the same numbers: times, settings, versions and hashes of inputs."""

from collections.abc import Iterable, Mapping
from typing import Any

from ..formats import NOTHING, format_duration
from ..page import Section, Table
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, to_numeric, write_words


def make_timing_section(store: Results) -> Section:
    """How long it took, and on what."""
    if store.run is None:
        return make_section("timing")
    stages = store.run.stages
    seconds = [stage.seconds for stage in stages.values()]
    total = make_row("Total", to_numeric(format_duration(sum(seconds))), "")
    return make_section(
        "timing",
        make_table("timing", stages.items(), foot=(total,), longest=max([*seconds, 1e-9])),
        make_prose("machine", machine=store.run.machine),
    )


def make_settings_section(store: Results) -> Section:
    """Every setting of the study file."""
    flat = flatten_settings(store.run.settings if store.run else {})
    table = make_pair_table("all-settings", ("Key", "Value"), flat)
    return make_section("settings", table)


def make_provenance_section(store: Results) -> Section:
    """Versions and hashes of inputs."""
    run, head = store.run, ("Key of the study", "SHA-256")
    versions = {"limbfit": run.limbfit, **run.versions} if run else {}
    return make_section(
        "provenance",
        make_pair_table("versions", ("Library", "Version"), versions),
        make_pair_table("inputs", head, run.inputs if run else {}),
    )


def make_pair_table(name: str, head: tuple[str, str], pairs: Mapping[str, Any]) -> Table | None:
    """A table of keys and values; a long one is folded on the screen; None where there are none."""
    rows = tuple(make_row(*pair) for pair in pairs.items())
    caption = write_words(f"table {name}")
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
