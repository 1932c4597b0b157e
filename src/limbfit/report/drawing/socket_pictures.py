"""The limb in its socket from four sides, coloured by pressure; settling and force over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from ..page import Figure
from ..store import Json, Results
from .ink import MUTED, SIMULATED, STYLE, THIRD, legend_above, panels, svg
from .panels import FIELD_MAP, Mark, Shot, View, colour_bar, strip
from .pictures import (
    SIDES,
    Grid,
    far_side,
    four_sides,
    limb_frame,
    linear,
    new_plotter,
    shoot,
    shoot_field,
    unit,
    without_display_warning,
)

Array = NDArray[np.float64]
FIELDS = (("pressure_kPa", "pressure (kPa)"), ("shear_kPa", "shear (kPa)"))
OUTER = "face_set:skin"
SHEAR, MARKED = "shear_strain", "#d62728"
OFFSET, OFFSET_MAP = "offset_mm", "RdBu_r"


@without_display_warning()
def pressure_figures(store: Results, files: Mapping[str, Path], name: str = "socket") -> tuple[Figure, ...]:
    """Pressure and shear on four sides, one colour scale for all the stored fields, by their titles."""
    surfaces = {title: _surface(file) for title, file in files.items() if file.is_file()}
    if not surfaces:
        return ()
    return tuple(_figure(store, surfaces, field, words, name) for field, words in FIELDS)


def _surface(file: Path) -> Grid:
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


def _figure(store: Results, surfaces: Mapping[str, Grid], field: str, words: str, name: str) -> Figure:
    top = max(float(np.max(surface.point_data[field])) for surface in surfaces.values())
    limits = (0.0, max(top, 1e-6))
    kind = field.removesuffix("_kPa")
    markup = _strips(store, surfaces, field, limits, FIELD_MAP, f"The limb coloured by {words}")
    caption = f"What the socket does to the limb when it has been held: {words}, one colour scale for all."
    return Figure(f"{name}-{kind}", markup + colour_bar(limits, words), caption)


def _strips(
    store: Results,
    surfaces: Mapping[str, Grid],
    field: str,
    limits: tuple[float, float],
    colours: str,
    alt: str,
) -> str:
    """A row of four sides for every surface, by its title."""
    views = four_sides(store, next(iter(surfaces.values())))
    markup = ""
    for title, surface in surfaces.items():
        plotter = new_plotter()
        plotter.add_mesh(
            surface, scalars=field, clim=limits, cmap=colours, show_scalar_bar=False, lighting=False
        )
        shots: list[Shot] = [(shoot(plotter, view), view, []) for view in views]
        plotter.close()
        markup += strip(shots, [f"{title}, {side}" for side in SIDES], f"{alt}, {title}, from four sides")
    return markup


@without_display_warning()
def offset_figure(store: Results, files: Mapping[str, Path]) -> Figure | None:
    """Faces of sockets by their titles, coloured by how far outside the unloaded limb they are."""
    faces = {title: pv.read(file) for title, file in files.items() if file.is_file()}
    if not faces:
        return None
    most = max(float(np.percentile(np.abs(face.point_data[OFFSET]), 99)) for face in faces.values())
    limits = (-max(most, 0.1), max(most, 0.1))
    words = "offset from the unloaded limb (mm)"
    markup = _strips(store, faces, OFFSET, limits, OFFSET_MAP, f"Face of the socket coloured by {words}")
    caption = (
        "Faces of the sockets: offset from the unloaded limb under its liner, negative where pressed in."
    )
    return Figure("socket-design-offset", markup + colour_bar(limits, words, OFFSET_MAP), caption)


@without_display_warning()
def inside_figure(store: Results, title: str, inside: Sequence[Json], file: Path) -> tuple[Figure, ...]:
    """Cuts along and across the limb through the place of the largest shear, coloured by it."""
    if not file.is_file():
        return ()
    grid, worst = linear(file), max(inside, key=lambda found: found["shear"])
    place = np.asarray(worst["place_mm"], dtype=float)
    shear, words = np.asarray(grid.cell_data[SHEAR]), "shear strain"
    limits = (0.0, max(float(np.percentile(shear, 99.5)), 1e-6))
    shots: list[Shot] = []
    for view in _cuts(store, grid, place):
        pixels = shoot_field(far_side(grid, view, smooth=True), view, SHEAR, limits)
        moved = place + _moved(grid, place)
        shots.append((pixels, view, [Mark("largest", moved, MARKED)]))
    near = f", near {worst['near']}" if worst["near"] else ""
    caption = (
        f"Inside the limb, {title}: cuts along and across it through the largest shear "
        f"({worst['tissue']}{near}), deformed; colour: largest shear strain of each element."
    )
    markup = strip(shots, ("along the limb", "across the limb"), f"Cuts coloured by {words}, {title}")
    return (Figure("socket-inside", markup + colour_bar(limits, words), caption),)


def _cuts(store: Results, grid: Grid, place: Array) -> tuple[View, View]:
    """The whole limb, cut along it through its middle and a place, and across it there."""
    _, back, up = limb_frame(store)
    points = np.asarray(grid.points)
    middle = points.mean(axis=0)
    outwards = (place - middle) - (place - middle) @ up * up
    normal = unit(np.cross(outwards if np.linalg.norm(outwards) > 1.0 else back, up))
    half = float(np.ptp(points @ up)) / 2 * 1.05
    across = np.cross(normal, up)
    reach = float(np.abs((points - middle) @ across).max()) + 10
    height = (points @ up).max() / 2 + (points @ up).min() / 2
    along_focal = middle + (height - middle @ up) * up + ((place - middle) @ normal) * normal
    wide = float(np.abs((points - middle) - np.outer((points - middle) @ up, up)).max()) + 8
    across_focal = middle + ((place - middle) @ up) * up
    return (
        View(along_focal, normal, up, half, (round(900 * reach / half), 900)),
        View(across_focal, -up, -back, wide, (900, 900)),
    )


def _moved(grid: Grid, place: Array) -> Array:
    """Displacement (3,) mm of the node nearest to a place at rest."""
    nearest = np.argmin(np.linalg.norm(np.asarray(grid.points) - place, axis=1))
    return np.asarray(grid.point_data["displacement_mm"])[nearest]


def settling_figure(content: Json) -> Figure:
    """Force on the socket and its move along the limb, largest and mean pressure, over time."""
    drawing, axes = panels(3, 3, 2.5)
    steps = content["steps"]
    time = np.array([row["time_s"] for row in steps])
    force = np.linalg.norm([row["force_N"] for row in steps], axis=1)
    with matplotlib.rc_context(STYLE):
        axes[0].plot(time, force, color=SIMULATED)
        axes[1].plot(time, [row["move_mm"][2] for row in steps], color=SIMULATED)
        axes[2].plot(time, [row["peak_kPa"] for row in steps], color=SIMULATED, label="largest")
        axes[2].plot(time, [row["mean_kPa"] for row in steps], "--", color=THIRD, label="mean")
        labels = ("Force on the socket (N)", "Move towards the body (mm)", "Pressure (kPa)")
        for ax, label in zip(axes, labels, strict=True):
            ax.set(xlabel="Time (s)", ylabel=label)
            for end in [content["donning"]["time_s"], *(load["time_s"] for load in content["loads"])]:
                ax.axvline(end, color=MUTED, lw=0.6)
            ax.margins(x=0.01)
        legend_above(drawing, axes[2])
    alt = "Force on the socket, its move and the pressure over time, from donning to the last load"
    caption = "The socket over time; lines: the end of donning and of each load, held."
    return Figure("socket-time", svg(drawing, "socket-time", alt), caption)
