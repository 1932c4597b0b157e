"""The limb in its socket from four sides, coloured by pressure; settling and force over time."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyvista as pv

from ...arrays import Array
from ...results.socket import SocketResult, TissueStrainInside
from ..page import Figure
from ..store import Results
from . import pictures
from .colours import MUTED, SIMULATED, THIRD
from .plots import add_legend, make_figure, make_panels, styled

FIELDS = (("pressure_kPa", "pressure (kPa)"), ("shear_kPa", "shear (kPa)"))
OUTER = "face_set:skin"
SHEAR, MARKED = "shear_strain", "#d62728"
OFFSET, OFFSET_MAP = "offset_mm", "RdBu_r"


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
def draw_offset_figure(store: Results, files: Mapping[str, Path]) -> Figure | None:
    """Faces of sockets by their titles, coloured by how far outside the unloaded limb they are."""
    faces = {title: pv.read(file) for title, file in files.items() if file.is_file()}
    if not faces:
        return None
    limit = max(float(np.percentile(np.abs(face.point_data[OFFSET]), 99)) for face in faces.values())
    limits = (-max(limit, 0.1), max(limit, 0.1))
    bar = (limits, "offset from the unloaded limb (mm)")
    rows = _render_surfaces(store, faces, OFFSET, bar, OFFSET_MAP)
    return pictures.make_picture_figure("socket-design-offset", rows)


@pictures.silence_display_warning()
def draw_inside_figure(
    store: Results, title: str, inside: Sequence[TissueStrainInside], file: Path
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
def draw_settling_figure(content: SocketResult) -> Figure:
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
