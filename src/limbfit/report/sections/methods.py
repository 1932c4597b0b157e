"""What someone else needs to get the same numbers: the method in words, times, settings, versions, hashes.

The words are in ``templates/methods.j2``. Nothing here comes from an image's header, and inputs are named by
their keys in the study file.
"""

import re
from collections.abc import Iterable, Mapping
from typing import Any

from jinja2 import ChainableUndefined

from ...laws import ACTIVE, OGDEN
from ...shapes import SHAPES
from ..formats import NOTHING, format_duration
from ..page import Prose, Section, Table
from ..store import Results
from ..words import make_environment, make_prose, make_row, make_section, make_table, to_numeric, write_words

Part = tuple[str, str]  # a heading and its paragraph


def make_method_section(store: Results) -> Section:
    """The parts as paragraphs, each after its heading."""
    parts = write_method_parts(store)
    return Section("method", "Methods", tuple(Prose(f"{head}. {text}") for head, text in parts))


def write_method_markdown(store: Results) -> str:
    """The same as Markdown, with every setting as a table at its end."""
    name = store.run.study.name if store.run else "Unnamed study"
    settings = flatten_settings(store.run.settings if store.run else {})
    template = make_environment().get_template("methods.md.j2")
    return template.render(name=name, parts=write_method_parts(store), settings=settings)


def write_method_parts(store: Results) -> tuple[Part, ...]:
    """Heading and paragraph of every part of which something is stored."""
    # Prose, not HTML: the page escapes it.
    environment = make_environment(
        ChainableUndefined, finalize=lambda value: NOTHING if isinstance(value, ChainableUndefined) else value
    )
    text = environment.get_template("methods.j2").render(
        store=store,
        describe_indenter=lambda one: SHAPES[one["shape"]].describe(one),
        **{"NOTHING": NOTHING, "OGDEN": OGDEN, "ACTIVE": ACTIVE},
    )
    parts = re.findall(r"^## (.*)\n((?:(?!## ).*\n?)*)", text, flags=re.MULTILINE)
    return tuple((head, " ".join(body.split())) for head, body in parts if body.strip())


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
    return make_section("settings", make_pair_table("all-settings", ("Key", "Value"), flat))


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
