"""The limb in its socket from four sides, coloured by pressure; settling and force over time."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from ..page import Figure
from ..store import Json, Results
from .ink import MUTED, SIMULATED, STYLE, THIRD, legend_above, panels, svg
from .panels import FIELD_MAP, Shot, colour_bar, strip
from .pictures import SIDES, Grid, four_sides, new_plotter, shoot, without_display_warning

Array = NDArray[np.float64]
FIELDS = (("pressure_kPa", "pressure (kPa)"), ("shear_kPa", "shear (kPa)"))
OUTER = "face_set:skin"


@without_display_warning()
def pressure_figures(store: Results, names: list[str]) -> tuple[Figure, ...]:
    """Pressure and shear on four sides, donning and each load with one colour scale."""
    files = [store.folder / "socket" / f"held-{i}.vtu" for i in range(len(names))]
    surfaces = [_surface(file) for file in files if file.is_file()]
    if not surfaces:
        return ()
    return tuple(_figure(store, names, surfaces, field, title) for field, title in FIELDS)


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


def _figure(store: Results, names: list[str], surfaces: list[Grid], field: str, title: str) -> Figure:
    top = max(float(np.max(surface.point_data[field])) for surface in surfaces)
    limits = (0.0, max(top, 1e-6))
    views = four_sides(store, surfaces[0])
    markup = ""
    for name, surface in zip(names, surfaces, strict=True):
        plotter = new_plotter()
        plotter.add_mesh(
            surface, scalars=field, clim=limits, cmap=FIELD_MAP, show_scalar_bar=False, lighting=False
        )
        shots: list[Shot] = [(shoot(plotter, view), view, []) for view in views]
        plotter.close()
        titles = [f"{name}, {side}" for side in SIDES]
        markup += strip(shots, titles, f"The limb coloured by {title}, {name}, from four sides")
    kind = field.removesuffix("_kPa")
    caption = f"What the socket does to the limb when it has been held: {title}, one colour scale for all."
    return Figure(f"socket-{kind}", markup + colour_bar(limits, title), caption)


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
        labels = ("Force on the socket (N)", "Move towards the knee (mm)", "Pressure (kPa)")
        for ax, label in zip(axes, labels, strict=True):
            ax.set(xlabel="Time (s)", ylabel=label)
            for end in [content["donning"]["time_s"], *(load["time_s"] for load in content["loads"])]:
                ax.axvline(end, color=MUTED, lw=0.6)
            ax.margins(x=0.01)
        legend_above(drawing, axes[2])
    alt = "Force on the socket, its move and the pressure over time, from donning to the last load"
    caption = "The socket over time; lines: the end of donning and of each load, held."
    return Figure("socket-time", svg(drawing, "socket-time", alt), caption)
