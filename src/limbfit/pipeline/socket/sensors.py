"""Sensors in a phantom's socket: a simulation with its true tissues and surfaces, on a mesh of its own.

Of an error e, within which 95 % of readings are stated to be, a cell's gain and each of its readings have a
standard deviation of 0.3 e, and a drift of all cells grows to 0.3 e.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...anatomy.meshing.layers import build_liner_surface
from ...anatomy.surfaces.surfaces import Anatomy
from ...arrays import Array
from ...indentation import Parameters
from ...phantom.build import render_template
from ...socket.rays import compute_profile
from ...socket.sensors import FULL_SCALE, SheetLayout
from ...socket.wrapping import wrap_sheet
from ...study import load_study
from .measured import sample_pressure
from .shape import build_loadable_socket, build_regions
from .simulation import SocketLimb, SocketRun, solve_run

# Name, file, format, and where it is a sheet its layout and the region under its middle; cells have others.
SENSORS: tuple[tuple[str, str, str, SheetLayout | None, str], ...] = (
    ("sheet", "sheet.asf", "tekscan", SheetLayout((8, 6), (12.7, 12.7)), "posterior middle"),
    ("strip", "strip.asc", "pliance", SheetLayout((6, 4), (10.0, 15.0)), "anterior middle"),
    ("cells", "cells.csv", "cells", None, ""),
)
CELL_MM2, ERROR_KPA, ERROR_PERCENT = 100.0, 2.0, 10.0
FULL_SHARE, DEAD = 0.98, 20  # the sheet's saturation over its largest true pressure, and its dead cell
SHARE, FRAMES, STEP_S, NOISE = 0.3, 20, 0.1, 3  # noise in counts of Tekscan's converter


def record_pressure(true_kPa: Array, saturation_kPa: float, seed: int) -> Array:
    """Readings (frames, n) kPa of true pressures (n,); with a saturation as Tekscan's converter counts."""
    random, percent = np.random.default_rng([seed, 14]), 0.01 * ERROR_PERCENT * SHARE
    gain = 1.0 + percent * random.standard_normal(len(true_kPa))
    drift = 1.0 + percent * np.linspace(0.0, 1.0, FRAMES)
    noise = ERROR_KPA * SHARE * random.standard_normal((FRAMES, len(true_kPa)))
    frames = np.maximum(drift[:, None] * gain * true_kPa + noise, 0.0)
    if np.isinf(saturation_kPa):
        return np.asarray(frames)
    counts = np.minimum(np.round(FULL_SCALE * frames / saturation_kPa), FULL_SCALE)
    return np.where(counts < NOISE, 0.0, counts * saturation_kPa / FULL_SCALE)


def write_true_sensors(folder: Path, anatomy: Anatomy, parameters: Parameters, seed: int) -> dict[str, Any]:
    """Write files of sensors into the folder of a study, and the tables that name them into its file.

    Returns the true pressure of every cell, kPa, by name. Raises `RunError` where the simulation does not
    come to its end.
    """
    study = load_study(folder)
    thickness, outer, load = study.socket.liner.thickness_mm, anatomy, study.socket.loads[-1].name
    if thickness:
        outer, _ = build_liner_surface(anatomy, thickness)
    limb = SocketLimb(study, anatomy, outer, None, build_regions(study, anatomy), ())
    socket, frame = build_loadable_socket(study, anatomy, outer.skin), anatomy.frame
    with TemporaryDirectory() as scratch:
        mesh, _ = limb.mesh(Path(scratch), socket, lambda words: None)
    model = limb.build_model(socket, mesh)
    held = solve_run(SocketRun("phantom", model, parameters), lambda time, end, words: None).held[load]
    rays = compute_profile(outer.skin, frame).rays
    tables, truth = list[dict[str, Any]](), dict[str, list[float]]()
    (folder / "sensors").mkdir()
    for name, file, kind, layout, region in SENSORS:
        marks = list[tuple[int, int, Array]]()
        if layout is None:  # one over the middle of each region
            middles = np.array([one.position for one in limb.regions.values()])
            positions = socket.surface.find_nearest(middles[socket.find_covered(middles)])[2]
            area = CELL_MM2
        else:
            cells = np.array([[0, 0], [0, 1], [1, 0]]) + np.array(layout.shape) // 2
            off, area = (cells - cells[0]) * layout.spacing_mm, float(np.prod(layout.spacing_mm))
            angle, station, radius = rays.coordinates(frame.to_limb(limb.regions[region].position))
            near = rays.points(angle + off[:, 1] / radius, station - off[:, 0], np.full(3, radius))
            grid, _ = wrap_sheet(layout, cells, frame.to_patient(near), socket, rays, frame)
            rows, columns = layout.shape
            marks = [(i, j, grid[i - 1, j - 1]) for i, j in ((1, 1), (1, columns), (rows, 1))]
            positions = grid.reshape(-1, 3)
        true, _ = sample_pressure(model, held, positions, np.full(len(positions), area))
        full = FULL_SHARE * float(true.max()) if kind == "tekscan" else np.inf
        frames = record_pressure(true, full, seed + len(tables))
        if kind == "tekscan":
            frames[:, DEAD] = 0.0
        facts: dict[str, Any] = {"positions": positions, "area_mm2": area, "saturation_kPa": full}
        facts |= {"frames": frames, "means": frames.mean(axis=0), "layout": layout}
        text = render_template(f"{kind}{Path(file).suffix}.j2", step_s=STEP_S, noise=NOISE, **facts)
        (folder / "sensors" / file).write_text(text, encoding="utf-8")
        truth[name] = true.tolist()
        tables.append({"name": name, "file": file, "format": kind, "layout": layout, "landmarks": marks})
    errors = {"error_kPa": ERROR_KPA, "error_percent": ERROR_PERCENT}
    with study.file.open("a", encoding="utf-8") as stream:
        stream.write(render_template("measured.toml.j2", sensors=tables, load=load, **errors))
    return truth
