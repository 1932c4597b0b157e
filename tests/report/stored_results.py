"""A small results folder with every file that a finished study stores, made from formulas."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from matplotlib.backends.backend_svg import FigureCanvasSVG

from completing import write_result
from editing import rewritten
from limbfit.laws import LAWS, OGDEN
from limbfit.mesh import Mesh, write_vtu
from limbfit.results.identification import CalibrationResult, PredictResult
from limbfit.results.limb import MeshResult, SegmentResult, SitesResult, SurfacesResult, TracesResult
from limbfit.results.runs import RunResult

SITES = (
    ("PT-1", "patellar tendon", True, -1.45, 10.0),
    ("TI-2", "tibia", True, -1.2, -40.0),
    ("LA-3", "lateral", True, 0.1, -20.0),
    ("PO-4", "posterior wall", True, 1.6, -30.0),
    ("TI-5", "tibia", False, -1.9, -10.0),
    ("PO-6", "posterior wall", False, 1.2, 15.0),
    ("ME-7", "medial", False, 3.0, -45.0),
)
TRUTH = {
    "skin": {"c_kPa": 5.6, "m": 4.4, "gamma": 3.1, "tau_s": 0.38},
    "muscle": {"c_kPa": 4.4, "m": 5.0, "gamma": 2.2, "tau_s": 0.52},
}
FAT = {"c_kPa": 1.8, "m": 3.1, "gamma": 1.4, "tau_s": 0.9}
START = {tissue: {"c_kPa": 4.7, "m": 3.0, "gamma": 1.2, "tau_s": 2.0} for tissue in TRUTH}
ONE = {tissue: {"c_kPa": 4.71, "m": 4.82, "gamma": 2.5, "tau_s": 0.47} for tissue in TRUTH}
TWO = {
    "skin": {"c_kPa": 5.43, "m": 4.52, "gamma": 3.02, "tau_s": 0.391},
    "muscle": {"c_kPa": 4.43, "m": 4.97, "gamma": 2.24, "tau_s": 0.512},
}
NAMES = [f"{tissue}.{name}" for tissue in TRUTH for name in ("c_kPa", "m", "gamma", "tau_s")]


def leave_unarranged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw without arranging labels and panels: it takes half of a report's time and changes no text."""
    drawn = FigureCanvasSVG.print_svg

    def print_svg(canvas: FigureCanvasSVG, *args: Any, **options: Any) -> None:
        canvas.figure.set_layout_engine("none")
        drawn(canvas, *args, **options)

    monkeypatch.setattr(FigureCanvasSVG, "print_svg", print_svg)


def radius(z: np.ndarray) -> np.ndarray:
    """Radius of the limb at a height: tapered, rounded at the distal end (mm)."""
    s = np.clip((z + 130.0) / 190.0, 0.0, 1.0)
    return 58.0 * s**0.35 * (0.8 + 0.2 * s)


def skin_point(angle: float, z: float) -> np.ndarray:
    r = float(radius(np.array(z)))
    return np.array([r * np.cos(angle), r * np.sin(angle), z])


def add_fat(folder: Path) -> Path:
    """The stored calibration and truth with a third tissue between skin and muscle."""
    file, truth = folder / "calibrate" / "calibration.json", folder / "truth.json"
    content = json.loads(file.read_text())

    def with_fat(tissues: dict, fat: dict) -> dict:
        return {"skin": tissues["skin"], "fat": fat, "muscle": tissues["muscle"]}

    one, three = content["stages"]
    three["name"] = "three materials"
    for stage, fat in ((one, ONE["skin"]), (three, FAT)):
        stage["start"] = with_fat(stage["start"], stage["start"]["skin"])
        stage["parameters"] = with_fat(stage["parameters"], fat)
        for step in stage["iterations"]:
            step["parameters"] = with_fat(step["parameters"], fat)
    told = content["uncertainty"]
    limits = {name: [0.5 * value, 2 * value] for name, value in FAT.items()}
    told["intervals_95"] = with_fat(told["intervals_95"], limits)
    names = [f"{tissue}.{name}" for tissue in ("skin", "fat", "muscle") for name in FAT]
    told["correlation"] = {"names": names, "matrix": np.eye(12).tolist()}
    told["verdict"] = {name: told["verdict"].get(name, "not determined") for name in names}
    told["at_bound"] = dict.fromkeys(names, False)
    content["bounds"] = {"lower": three["start"], "upper": three["start"]}
    file.write_text(json.dumps(content))
    truth.write_text(json.dumps({"parameters": with_fat(TRUTH, FAT)}))
    with rewritten(folder / "mesh" / "mesh.json") as meshes:
        for facts in meshes["sites"].values():
            facts["layer_thickness_mm"] = {
                "skin": {"mean": 1.5, "std": 0.01, "min": 1.4, "max": 1.6},
                "fat": {"mean": 4.72, "std": 1.31, "min": 1.0, "max": 8.0},
            }
    layers = [
        {"name": "skin", "thickness_mm": 1.5},
        {"name": "fat", "thickness": "map", "min_thickness_mm": 1.0},
    ]
    with rewritten(folder / "run.json") as run:
        run["settings"]["geometry"] |= {"layers": layers, "core": "muscle"}
    return folder


def write_results(
    folder: Path, *, sites: tuple = SITES, name: str = "Phantom 7 (coarse)", geometry: bool = True
) -> Path:
    """Every artefact of a finished study below ``folder``; without the geometry, which only pictures need."""
    write_result(folder, RunResult, _run(sites, name))
    (folder / "truth.json").write_text(json.dumps({"parameters": TRUTH}))
    _surfaces(folder, geometry)
    volumes = {"muscle": 902.4, "tibia": 118.0, "fibula": 17.3, "skin": 151.2}
    write_result(folder, SegmentResult, {"volumes_cm3": volumes, "method": "bias-corrected threshold"})
    write_result(folder, SitesResult, {"sites": [_site(i, row) for i, row in enumerate(sites)]})
    _traces(folder, sites)
    _meshes(folder, sites)
    write_result(folder, CalibrationResult, _calibration(sites))
    _predict(folder, sites)
    if geometry:
        _write_meshes(folder, sites)
    return folder


def _csv(file: Path, **columns: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, delimiter=",", header=",".join(columns), comments="", fmt="%.6g")


def _run(sites: tuple, name: str) -> dict:
    stages = {"segment": 21.4, "surfaces": 9.2, "sites": 6.1, "traces": 0.7, "mesh": 96.3}
    stages |= {"calibrate": 151.0, "predict": 22.5}
    settings = {
        "geometry": {"skin_layer_mm": 3.0, "bone_policy": "trim-bone", "bone_clearance_mm": 1.5},
        "mesh": {"element": "tet10", "edge_near_mm": 3.5, "edge_far_mm": 12.0},
        "indenter": {"shape": "square", "width_mm": 20.0, "edge_radius_mm": 0.0},
        "material": {"kappa_ratio": 100.0, "start": START["skin"]},
        "sites": [{"name": row[0], "fitted": row[2], "axis": None} for row in sites],
    }
    return {
        "study": {"name": name, "description": "A synthetic patient with known truth, noise 0.03 N."},
        "limbfit": "0.1.0",
        "versions": {"numpy": "2.1.0", "scipy": "1.14.1", "vtk": "9.4.0"},
        "settings": settings,
        "inputs": {"study.toml": "9f" * 32}
        | {f"traces/{row[0]}.csv": f"{i:02x}" * 32 for i, row in enumerate(sites)},
        "stages": {
            stage: {"seconds": seconds, "finished": "2026-03-01T10:00:00+00:00"}
            for stage, seconds in stages.items()
        },
        "machine": {"cores": 2, "memory_GB": 6.0, "python": "3.11.9"},
    }


def _surfaces(folder: Path, geometry: bool) -> None:
    facts = {
        "cut_point": [0, 0, 60],
        "cut_normal": [0, 0, 1],
        "skin": {"volume_mm3": 1153100.0},
        "bones": {"tibia": {"volume_mm3": 117200.0}},
    }
    write_result(folder, SurfacesResult, facts)
    if geometry:
        _bodies(folder / "surfaces")


def _bodies(folder: Path) -> None:
    z, angle = np.meshgrid(np.linspace(-129.5, 60, 80), np.linspace(0, 2 * np.pi, 90), indexing="ij")
    r = radius(z)
    wall = pv.StructuredGrid(r * np.cos(angle), r * np.sin(angle), z).extract_surface(
        algorithm="dataset_surface"
    )
    wall.triangulate().clean().fill_holes(500.0).save(folder / "skin.stl")
    for name, centre, size, low in (("tibia", (6, -20), 12.0, -85.0), ("fibula", (24, 6), 5.0, -75.0)):
        middle = (*centre, (low + 60) / 2)
        bone = pv.Cylinder(center=middle, direction=(0, 0, 1), radius=size, height=60 - low, resolution=40)
        bone.triangulate().save(folder / f"bone-{name}.stl")


def _site(index: int, row: tuple) -> dict:
    name, region, fitted, angle, z = row
    axis = [-np.cos(angle), -np.sin(angle), 0.0]
    marker = {"height_mm": 4.1, "distance_to_hint_mm": 2.3} if index % 2 else None
    return {
        "site": name,
        "region": region,
        "fitted": fitted,
        "position_mm": skin_point(angle, z).tolist(),
        "axis": axis,
        "off_skin_mm": 0.12,
        "marker": marker,
    }


def _loop(depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (s), displacement (mm) and force (N) of one loading and unloading at 0.96 mm/s."""
    half = depth / 0.96
    time = np.linspace(0, 2 * half, 400)
    d = depth * (1 - np.abs(time / half - 1))
    force = 0.28 * d + 0.035 * d**2.4 - np.where(time > half, 0.22 * (2 * half - time) * d / depth, 0.0)
    return time, d, np.clip(force, 0, None)


def _depth(index: int) -> float:
    return 4.0 + 0.9 * index


def _traces(folder: Path, sites: tuple) -> None:
    rng = np.random.default_rng(1)
    facts = {}
    for i, row in enumerate(sites):
        time, d, force = _loop(_depth(i))
        before = np.linspace(-1.3, 0, 120, endpoint=False)
        raw_time = np.concatenate([before, time]) + 1.3
        raw_d = np.concatenate([before * 0.96, d]) + 1.25
        raw_force = np.concatenate([0 * before, force]) + 0.05 * rng.standard_normal(520)
        raw = {"time_s": raw_time, "displacement_mm": raw_d, "force_N": raw_force}
        _csv(folder / "traces" / f"{row[0]}-raw.csv", **raw)
        _csv(folder / "traces" / f"{row[0]}.csv", time_s=time, displacement_mm=d, force_N=force)
        facts[row[0]] = {
            "site": row[0],
            "touch_down_s": 1.3,
            "touch_down_mm": 1.25,
            "touch_down_uncertainty_mm": 0.04,
            "peak_force_N": float(force.max()),
            "depth_mm": _depth(i),
            "noise_N": 0.05,
            "speed_load_mm_s": 0.96,
            "speed_unload_mm_s": 0.96,
            "phases": _phases(float(before[0]) + 1.3, 1.3, float(time[-1])),
            "phases_in_words": "load at 0.96 mm/s, hold for 2 s, unload at 0.96 mm/s",
        }
    write_result(folder, TracesResult, {"sites": facts})


def _phases(first_s: float, touch_s: float, seconds: float) -> list[dict]:
    ends = [first_s, touch_s, touch_s + 0.4 * seconds, touch_s + 0.6 * seconds, touch_s + seconds]
    kinds = ("approach", "load", "hold", "unload")
    depths = [0.0, 5.0, 5.0, 0.0]
    rows = zip(kinds, ends, ends[1:], depths, strict=False)
    return [{"kind": kind, "start_s": a, "end_s": b, "end_mm": depth} for kind, a, b, depth in rows]


def _limb_mesh() -> Mesh:
    """Tetrahedra of the limb in rings: region 0 in the outermost 3 mm, bones left out."""
    z = np.linspace(-126, 60, 24)
    angle = np.linspace(0, 2 * np.pi, 33)
    ring, zz, a = np.meshgrid(np.arange(12), z, angle, indexing="ij")
    inner = radius(zz) - 3.0
    r = np.where(ring < 10, inner * (0.02 + 0.98 * ring / 9), inner + 1.5 * (ring - 9))
    grid = pv.StructuredGrid(r * np.cos(a), r * np.sin(a), zz).cast_to_unstructured_grid()
    centre = np.asarray(grid.cell_centers().points)
    tibia = np.hypot(centre[:, 0] - 6, centre[:, 1] + 20) < 12
    fibula = np.hypot(centre[:, 0] - 24, centre[:, 1] - 6) < 5
    grid = grid.extract_cells(
        np.flatnonzero(~((tibia & (centre[:, 2] > -85)) | (fibula & (centre[:, 2] > -75))))
    )
    centre = np.asarray(grid.cell_centers().points)
    muscle = np.hypot(centre[:, 0], centre[:, 1]) < radius(centre[:, 2]) - 2.9
    plain = pv.UnstructuredGrid(grid.cells, grid.celltypes, np.asarray(grid.points))
    plain.cell_data["region"] = muscle.astype(np.int64)
    tets = plain.triangulate()
    cells = np.asarray(tets.cells).reshape(-1, 5)[:, 1:].astype(np.int64)
    points = np.asarray(tets.points, dtype=float)
    return Mesh(points, cells, "tet4", np.asarray(tets.cell_data["region"]), ("skin", "muscle"))


def _meshes(folder: Path, sites: tuple) -> None:
    facts = {}
    for i, row in enumerate(sites):
        facts[row[0]] = {
            "nodes": 61234 + i,
            "cells": 41987,
            "element": "tet10",
            "min_dihedral_deg": 9.8,
            "layer_mean_mm": 3.0,
            "layer_std_mm": 0.02,
            "trimmed_bone": {"tibia": {"volume_mm3": 412.0, "depth_mm": 1.1}},
            "warnings": ["the layer is thin at the tibial crest"] if i == 1 else [],
            "seconds": 15.2,
        }
    write_result(folder, MeshResult, {"sites": facts})


def _write_meshes(folder: Path, sites: tuple) -> None:
    mesh = _limb_mesh()
    write_vtu(mesh, folder / "mesh" / f"{sites[0][0]}.vtu")
    for i, row in enumerate(sites):
        if i:
            shutil.copy(folder / "mesh" / f"{sites[0][0]}.vtu", folder / "mesh" / f"{row[0]}.vtu")
        if row[2]:
            _peak_fields(mesh, skin_point(row[3], row[4]), _depth(i), folder / "predict" / f"{row[0]}.vtu")


def _peak_fields(mesh: Mesh, site: np.ndarray, depth: float, file: Path) -> None:
    inward = -np.array([site[0], site[1], 0]) / np.hypot(site[0], site[1])
    near = np.exp(-(np.linalg.norm(mesh.points - site, axis=1) ** 2) / 300)
    centres = mesh.points[mesh.cells].mean(axis=1)
    stress = 14 * np.exp(-(np.linalg.norm(centres - site, axis=1) ** 2) / 250)
    moved = depth * near[:, None] * inward
    write_vtu(
        mesh, file, {"displacement_mm": moved}, {"von_mises_kPa": stress, "J": np.full(len(centres), 0.998)}
    )


def _iterations(first: dict, last: dict, start_error: float, end_error: float, sites: tuple) -> list[dict]:
    steps = []
    for i, share in enumerate((0.0, 0.45, 0.8, 0.96, 1.0)):
        values = {t: {n: first[t][n] ** (1 - share) * last[t][n] ** share for n in first[t]} for t in first}
        error = start_error ** (1 - share) * end_error**share
        by_site = {row[0]: error * (0.8 + 0.1 * k) for k, row in enumerate(sites) if row[2]}
        steps.append(
            {
                "iteration": i,
                "parameters": values,
                "cost": error**2,
                "error_percent": error,
                "error_percent_by_site": by_site,
            }
        )
    return steps


def _calibration(sites: tuple) -> dict:
    def stage(name: str, start: dict, end: dict, errors: tuple[float, float]) -> dict:
        return {
            "name": name,
            "start": start,
            "parameters": end,
            "cost": errors[1] ** 2,
            "evaluations": 6,
            "iterations": _iterations(start, end, *errors, sites),
            "converged": True,
            "reason": "the objective changes by less than 0.001",
        }

    matrix = np.array([[(-0.9) ** abs(i - j) for j in range(8)] for i in range(8)])
    verdict = dict.fromkeys(NAMES, "determined") | {
        "skin.m": "weakly determined",
        "skin.gamma": "not determined",
    }
    uncertainty = {
        "intervals_95": {
            t: {
                n: [TWO[t][n] * (0.6 if t == "skin" else 0.93), TWO[t][n] * (1.7 if t == "skin" else 1.07)]
                for n in TWO[t]
            }
            for t in TWO
        },
        "correlation": {"names": NAMES, "matrix": matrix.tolist()},
        "verdict": verdict,
        "at_bound": dict.fromkeys(NAMES, False),
        "combinations": [
            "muscle.c_kPa^0.82 · muscle.gamma^0.57: determined",
            "skin.m^0.71 · muscle.m^-0.70: not determined by these data",
        ],
        "residuals": {
            "sites": {row[0]: {"noise_sd_N": 0.05, "misfit_sd_N": 0.1} for row in sites if row[2]},
            "correlation": 0.2,
        },
    }
    return {
        "stages": [
            stage("one material", START, ONE, (31.0, 2.9)),
            stage("two materials", ONE, TWO, (2.9, 0.9)),
        ],
        "objective": "pointwise",
        "law": LAWS[OGDEN].record(),
        "bounds": {"lower": START, "upper": START},
        "uncertainty": uncertainty,
        "forward_runs": 48,
        "linear_solver": "pardiso",
        "element": "tet10",
    }


def _predict(folder: Path, sites: tuple) -> None:
    rows = []
    for i, row in enumerate(sites):
        time, d, force = _loop(_depth(i))
        two, one = force * (1.01 + 0.004 * i), force * (0.96 - 0.005 * i)
        band = 0.03 * force
        _csv(
            folder / "predict" / f"{row[0]}.csv",
            time_s=time,
            displacement_mm=d,
            force_measured_N=force,
            force_simulated_N=two,
            force_one_material_N=one,
            force_low_N=two - band,
            force_high_N=two + band,
        )
        rows.append(
            {
                "site": row[0],
                "record": row[0],
                "region": row[1],
                "fitted": row[2],
                "peak_force_N": float(force.max()),
                "error_percent": 0.6 + 0.2 * i,
                "error_one_material_percent": 1.9 + 0.2 * i,
                "penetration_mm": 0.012,
                "completed": True,
                "reason": "",
                "steps": 18,
                "element": "tet10",
            }
        )
    means = {
        "mean_error_fitted_percent": 0.9,
        "sd_error_fitted_percent": 0.26,
        "mean_error_heldout_percent": 1.6,
        "sd_error_heldout_percent": 0.2,
    }
    write_result(folder, PredictResult, {"sites": rows} | means)
