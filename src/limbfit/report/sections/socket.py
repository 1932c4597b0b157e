"""The socket in the report: pressure and shear by region and their causes, settling, balance, design."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ...results import socket as stored
from ..drawing.socket_pictures import (
    draw_inside_figure,
    draw_offset_figure,
    draw_pressure_figures,
    draw_settling_figure,
)
from ..formats import format_symbol
from ..page import Note, Row, Section, Table
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, to_numeric, write_words

# What counts as known, and how its change is headed.
KNOWN = {
    "liner.c_kPa": f"Change, liner {format_symbol('c')} 10 % larger",
    "friction": "Change, friction 10 % larger",
}


def make_socket_section(store: Results, content: stored.SocketResult) -> Section:
    """What the experiment ``socket`` found."""
    folder, states = store.folder / "socket", content.states
    files = {name: folder / f"held-{i}.vtu" for i, name in enumerate(states)}
    name, last = list(states.items())[-1]
    origin = write_words("origin", of=content.parameters_from)
    return make_section(
        "socket",
        Note(write_words("socket note")),
        make_prose("socket shape", content=content, origin=origin),
        (Note(f"The socket's file: {text}.") for text in content.socket.notes),
        make_prose("socket loads", content=content),
        draw_pressure_figures(store, files, "socket"),
        draw_settling_figure(content),
        _make_load_table(
            "socket-regions",
            {name: state.regions for name, state in states.items()},
            draws=content.samples.simulated if content.samples else 0,
        ),
        make_interval_table(last, name),
        make_prose("socket worn", worn_s=content.worn_s),
        make_published_table(content.published, last, name),
        make_prose("socket papers") if content.published else None,
        draw_inside_figure(store, name, last.inside, files[name]),
        _make_load_table("socket-inside", {name: state.inside for name, state in states.items()}),
        make_prose("socket balance", content=content),
        map(Note, [*content.warnings, *content.outside_text]),
    )


def _make_load_table(name: str, rows: Mapping[str, Sequence[Any]], **facts: Any) -> Table | None:
    """A table in which the rows of each load stand below a marked row with its name."""
    table, body = None, list[Row]()
    for load, own in rows.items():
        table = make_table(name, own, **facts)
        if table is not None:
            body += [make_row(load, *(to_numeric("") for _ in table.head[1:]), marked=True), *table.rows]
    return table and replace(table, rows=tuple(body))


def make_interval_table(state: stored.SocketState, title: str) -> Table | None:
    """How much of each interval goes with every identified parameter; what liner and friction change."""
    first = state.regions[0]
    if first.interval_from is None:
        return None
    rows = [
        (one.region, "kPa", one.mean_kPa, one.interval_kPa, one.interval_from, one.change_kPa)
        for one in state.regions
    ]
    if isinstance(state, stored.SocketLoad):
        interval, causes = state.settling_interval_mm, state.settling_interval_from
        rows.append(("settling", "mm", state.settling_mm, interval, causes, state.settling_change_mm))
    known = {name: head for name, head in KNOWN.items() if name in (first.change_kPa or {})}
    return make_table("socket-intervals", rows, names=sorted(first.interval_from), known=known, title=title)


def make_published_table(
    published: Sequence[stored.PublishedFindings], state: stored.SocketState, title: str
) -> Table | None:
    """What others found over the regions of this result, beside its pressures when a part has been held."""
    here: dict[str, stored.LoadedRegion] = {row.region: row for row in state.regions}
    rows = [
        (name, here.get(name, state), one)
        for name in dict.fromkeys(name for one in published for name in one.regions)
        for one in published
        if name in one.regions
    ]
    return make_table("socket-published", rows, title=title)


def make_socket_design_section(store: Results, content: stored.SocketDesignResult) -> Section:
    """What the experiment ``socket_design`` found."""
    folder, designs, found = store.folder / "socket_design", content.designs, content.optimisation
    last = len(designs[0].simulation.loads)  # donning is the first
    held = {one.name: folder / f"{one.name}-{last}.vtu" for one in designs}
    origin = write_words("origin", of=content.parameters_from)
    limits = found.limits_kPa if found else {}
    failed = [(i, trial.reason) for i, trial in enumerate(found.trials if found else ()) if trial.reason]
    return make_section(
        "socket_design",
        Note(write_words("socket design note")),
        make_prose("socket design", content=content, origin=origin),
        draw_offset_figure(store, {one.name: folder / f"{one.name}-face.vtp" for one in designs}),
        make_prose("socket design loads", designs=designs),
        draw_pressure_figures(store, held, "socket-design"),
        make_table("socket-design-regions", designs[0].peaks_kPa, designs=designs, limits=limits),
        make_prose("socket design gains", found=found) if found else None,
        make_table("socket-design-trials", enumerate(found.trials), found=found) if found else None,
        (Note(f"Simulation {number} was not made: {reason}") for number, reason in failed),
        make_prose("socket design print", wall=content.wall),
        (Note(f"{one.name}: {text}") for one in designs for text in one.simulation.warnings),
    )
