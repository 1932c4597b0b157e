"""The socket: pressure and shear on four sides and by region with their causes, settling, balance, design."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from matplotlib.colors import Normalize

from ...arrays import Array
from ...results import socket as stored
from ..drawing import pictures
from ..drawing.colours import MUTED, SIMULATED, THIRD
from ..drawing.plots import add_legend, choose_tissue_style, make_figure, make_panels, styled
from ..formats import format_symbol
from ..page import Figure, Note, Row, Section, Table
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, to_numeric, write_words

# What counts as known, and how its change is headed.
KNOWN = {
    "liner.c_kPa": f"Change, liner {format_symbol('c')} 10 % larger",
    "friction": "Change, friction 10 % larger",
}
FIELDS = (("pressure_kPa", "pressure (kPa)"), ("shear_kPa", "shear (kPa)"))
OUTER = "face_set:skin"
SHEAR, MARKED = "shear_strain", "#d62728"
ALL, COMPARED = "all", "compared"
# Marker of each state of a cell.
MARKS = {COMPARED: "s", "saturated": "^", "dead": "x", "below noise": ".", "off the socket": "+"}
OFFSET, OFFSET_MAP = "offset_mm", "RdBu_r"


def make_socket_section(store: Results, content: stored.SocketResult) -> Section:
    """What the experiment ``socket`` found."""
    folder, states = store.folder / "socket", content.states
    files = {name: folder / f"held-{i}.vtu" for i, name in enumerate(states)}
    name, last = list(states.items())[-1]
    return make_section(
        "socket",
        Note(write_words("socket note")),
        make_prose("socket shape", content=content),
        (Note(f"The socket's file: {text}.") for text in content.socket.notes),
        draw_offset_figure(store, {"socket": folder / "socket-face.vtp"}, "socket-offset"),
        make_prose("socket loads", content=content),
        draw_pressure_figures(store, files, "socket"),
        draw_settling_figure(content),
        _make_load_table(states, "regions", draws=content.samples.simulated if content.samples else 0),
        make_interval_table(last, name),
        make_prose("socket worn", worn_s=content.worn_s),
        make_prose("socket measured", agreement=content.agreement, sensors=content.sensors),
        draw_measured_figure(content),
        draw_agreement_figure(content),
        make_table("socket-measured", content.agreement, marked=lambda row: row.region == ALL),
        make_published_table(content.published, last, name),
        make_prose("socket papers") if content.published else None,
        draw_inside_figure(store, name, last.inside, files[name]),
        _make_load_table(states, "inside"),
        make_prose("socket balance", content=content),
        map(Note, [*content.warnings, *content.outside_text]),
    )


def _make_load_table(states: Mapping[str, stored.SocketState], part: str, **facts: Any) -> Table | None:
    """A table in which the rows of each load, a part of its state, stand below a marked row with its name."""
    table, body = None, list[Row]()
    for load, state in states.items():
        table = make_table(f"socket-{part}", getattr(state, part), **facts)
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
    limits = found.limits_kPa if found else {}
    failed = [(i, trial.reason) for i, trial in enumerate(found.trials if found else ()) if trial.reason]
    return make_section(
        "socket_design",
        Note(write_words("socket design note")),
        make_prose("socket design", content=content),
        draw_offset_figure(
            store, {one.name: folder / f"{one.name}-face.vtp" for one in designs}, "socket-design-offset"
        ),
        make_prose("socket design loads", designs=designs),
        draw_pressure_figures(store, held, "socket-design"),
        make_table("socket-design-regions", designs[0].peaks_kPa, designs=designs, limits=limits),
        make_prose("socket design gains", found=found) if found else None,
        make_table("socket-design-trials", enumerate(found.trials), found=found) if found else None,
        (Note(f"Simulation {number} was not made: {reason}") for number, reason in failed),
        make_prose("socket design print", wall=content.wall),
        (Note(f"{one.name}: {text}") for one in designs for text in one.simulation.warnings),
    )


@pictures.silence_display_warning()
def draw_pressure_figures(store: Results, files: Mapping[str, Path], name: str) -> tuple[Figure, ...]:
    """Pressure and shear on four sides, one colour scale for all the stored fields, by their titles."""
    surfaces = {title: _read_surface(file) for title, file in files.items() if file.is_file()}
    if not surfaces:
        return ()
    figures = []
    for field, words in FIELDS:
        top = max(float(np.max(surface.point_data[field])) for surface in surfaces.values())
        rows = _render_surfaces(store, surfaces, field, ((0.0, max(top, 1e-6)), words))
        title = f"{name}-{field.removesuffix('_kPa')}"
        figures.append(pictures.make_picture_figure(title, rows, words="socket surface", field=words))
    return tuple(figures)


def _read_surface(file: Path) -> pictures.Grid:
    """The deformed outer surface with straight-edged triangles, and what is stored at its nodes."""
    grid = pv.read(file)
    faces = np.asarray(grid.field_data[OUTER])[:, :3]
    nodes, local = np.unique(faces, return_inverse=True)
    moved = np.asarray(grid.points)[nodes] + np.asarray(grid.point_data["displacement_mm"])[nodes]
    surface = pv.PolyData.from_regular_faces(moved, local.reshape(-1, 3).astype(int))
    for field, _ in FIELDS:
        values = np.asarray(grid.point_data[field])[nodes]
        surface.point_data[field] = values if values.ndim == 1 else np.linalg.norm(values, axis=1)
    return surface


def _render_surfaces(
    store: Results,
    surfaces: Mapping[str, pictures.Grid],
    field: str,
    bar: tuple[tuple[float, float], str],
    colours: str = pictures.FIELD_MAP,
) -> list[pictures.PictureRow]:
    """A row of four sides for every surface, by its title; ``bar``: limits and title of the colours."""
    views = pictures.make_four_views(store, next(iter(surfaces.values())))
    rows = []
    for title, surface in surfaces.items():
        shots = pictures.render_views(pictures.make_field_plotter(surface, field, bar[0], colours), views)
        rows.append(pictures.PictureRow(shots, [f"{title}, {side}" for side in pictures.SIDES], bar, colours))
    return rows


@pictures.silence_display_warning()
def draw_offset_figure(store: Results, files: Mapping[str, Path], name: str) -> Figure | None:
    """Faces of sockets by their titles, coloured by how far outside the unloaded limb they are."""
    faces = {title: pv.read(file) for title, file in files.items() if file.is_file()}
    if not faces:
        return None
    limit = max(float(np.percentile(np.abs(face.point_data[OFFSET]), 99)) for face in faces.values())
    limits = (-max(limit, 0.1), max(limit, 0.1))
    bar = (limits, "offset from the unloaded limb (mm)")
    rows = _render_surfaces(store, faces, OFFSET, bar, OFFSET_MAP)
    return pictures.make_picture_figure(name, rows)


@pictures.silence_display_warning()
def draw_inside_figure(
    store: Results, title: str, inside: Sequence[stored.TissueStrainInside], file: Path
) -> Figure | None:
    """Cuts along and across the limb through the place of the largest shear, coloured by it."""
    if not file.is_file():
        return None
    grid, worst = pictures.read_linear(file), max(inside, key=lambda tissue: tissue.shear)
    place = np.asarray(worst.place_mm, dtype=float)
    shear = np.asarray(grid.cell_data[SHEAR])
    limits = (0.0, max(float(np.percentile(shear, 99.5)), 1e-6))
    nearest = np.argmin(np.linalg.norm(np.asarray(grid.points) - place, axis=1))
    mark = pictures.Mark("largest", place + np.asarray(grid.point_data["displacement_mm"])[nearest], MARKED)
    shots: list[pictures.Shot] = []
    for view in _make_cut_views(store, grid, place):
        pixels = pictures.render_field(pictures.cut_behind(grid, view, smooth=True), view, SHEAR, limits)[0]
        shots.append((pixels, view, [mark]))
    row = pictures.PictureRow(shots, ("along the limb", "across the limb"), (limits, "shear strain"))
    return pictures.make_picture_figure("socket-inside", [row], title=title, worst=worst)


def _make_cut_views(store: Results, grid: pictures.Grid, place: Array) -> tuple[pictures.View, pictures.View]:
    """The whole limb, cut along it through its middle and a place, and across it there."""
    _, back, up = pictures.read_limb_frame(store)
    points = np.asarray(grid.points)
    middle = points.mean(axis=0)
    outwards = (place - middle) - (place - middle) @ up * up
    normal = pictures.normalise(np.cross(outwards if np.linalg.norm(outwards) > 1.0 else back, up))
    along = pictures.make_whole_view(points, normal, up, margin_mm=10)
    along = replace(along, focal=along.focal + ((place - middle) @ normal) * normal)
    wide = float(np.abs((points - middle) - np.outer((points - middle) @ up, up)).max()) + 8
    across_focal = middle + ((place - middle) @ up) * up
    return along, pictures.View(across_focal, -up, -back, wide, (900, 900))


@styled
def draw_measured_figure(content: stored.SocketResult) -> Figure | None:
    """Measured pressure of each recording beside the model's, on the limb unrolled, in one colour scale."""
    if not content.sensors:
        return None
    drawing, axes = make_panels(2 * len(content.sensors), 2, 2.9)
    cells = [cell for one in content.sensors for cell in one.cells]
    limits = Normalize(0.0, max(max(cell.measured_kPa or 0.0, cell.model_kPa) for cell in cells))
    for ax, (one, key) in zip(axes, product(content.sensors, ("measured_kPa", "model_kPa")), strict=True):
        angle = np.array([cell.angle_deg for cell in one.cells])
        if one.stretch_percent is not None:  # a sheet may lie where angles start
            angle = np.unwrap(angle, period=360.0)
        for state, mark in MARKS.items():
            here = [i for i, cell in enumerate(one.cells) if cell.state == state]
            level, shade = ([getattr(one.cells[i], name) or 0.0 for i in here] for name in ("level_mm", key))
            ax.scatter(angle[here], level, 40, shade, marker=mark, norm=limits, label=state if here else "")
        title = f"{one.name}, {one.load}: {key.removesuffix('_kPa')}"
        ax.set(title=title, xlabel="Around the limb (°)", ylabel="Level (mm)")
    drawing.colorbar(axes[0].collections[0], ax=axes, label="Pressure (kPa)", fraction=0.03)
    add_legend(drawing, *axes)
    return make_figure(drawing, "socket-measured-maps")


@styled
def draw_agreement_figure(content: stored.SocketResult) -> Figure | None:
    """Bland and Altman's plot of each load: model minus measured over their mean, with bias and limits."""
    rows = [row for row in content.agreement if row.region == ALL]
    if not rows:
        return None
    drawing, axes = make_panels(len(rows), 2, 2.9)
    for ax, row in zip(axes, rows, strict=True):
        for i, one in enumerate(sensor for sensor in content.sensors if sensor.load == row.load):
            pairs = [(c.measured_kPa or 0.0, c.model_kPa) for c in one.cells if c.state == COMPARED]
            measured, model = np.array(pairs).reshape(-1, 2).T
            style = choose_tissue_style(i) | {"ls": "", "ms": 4, "label": one.name}
            ax.plot((measured + model) / 2, model - measured, **style)
        for value in (row.bias_kPa, *(row.limits_kPa or ())):
            ax.axhline(value, color=MUTED, lw=1.0, ls="-" if value == row.bias_kPa else "--")
        ax.set(title=row.load, xlabel="Mean of both (kPa)", ylabel="Model minus measured (kPa)")
    add_legend(drawing, axes[0])
    return make_figure(drawing, "socket-agreement")


@styled
def draw_settling_figure(content: stored.SocketResult) -> Figure:
    """Force on the socket and its move along the limb, largest and mean pressure, over time."""
    drawing, axes = make_panels(3, 3, 2.5)
    steps = content.steps
    time = np.array([row.time_s for row in steps])
    force = np.linalg.norm([row.force_N for row in steps], axis=1)
    axes[0].plot(time, force, color=SIMULATED)
    axes[1].plot(time, [row.move_mm[2] for row in steps], color=SIMULATED)
    axes[2].plot(time, [row.peak_kPa for row in steps], color=SIMULATED, label="largest")
    axes[2].plot(time, [row.mean_kPa for row in steps], "--", color=THIRD, label="mean")
    labels = ("Force on the socket (N)", "Move towards the body (mm)", "Pressure (kPa)")
    for ax, label in zip(axes, labels, strict=True):
        ax.set(xlabel="Time (s)", ylabel=label)
        for end in [content.donning.time_s, *(load.time_s for load in content.loads)]:
            ax.axvline(end, color=MUTED, lw=0.6)
        ax.margins(x=0.01)
    add_legend(drawing, axes[2])
    return make_figure(drawing, "socket-time")
