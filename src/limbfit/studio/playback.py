"""Stored fields of simulations as arrays to play: which there are, their mesh, and one moment of one."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import vtk_to_numpy

from ..errors import InputError
from ..mesh import read_grid, read_vtu
from ..phases import find_loading_end, find_phases
from ..results.curves import read_curves
from ..results.runs import SimulateResult
from ..web.shapes import to_volume_shape
from .folder import StudyFolder, compute_fingerprint

Block = tuple[dict[str, NDArray[Any]], dict[str, Any]]  # arrays and facts, see `limbfit.web.arrays`
_FRAME = re.compile(r'<DataSet timestep="([^"]+)" part="0" file="[^"/]+/(step-\d{4,}\.vtu)"/>')


@dataclass(frozen=True)
class Field:
    """A quantity that is stored: its array on cells or points, and which component; None is the length."""

    title: str
    unit: str
    array: str
    on_cells: bool = True
    component: int | None = 0


FIELDS = {
    "displacement": Field("displacement", "mm", "displacement_mm", False, None),
    "von_mises": Field("von Mises stress", "kPa", "von_mises_kPa"),
    **{
        f"cauchy_{name}": Field(f"Cauchy stress {name}", "kPa", "cauchy_kPa", True, i)
        for i, name in enumerate(("xx", "yy", "zz", "xy", "yz", "zx"))
    },
    "largest_stretch": Field("largest principal stretch", "–", "largest_stretch"),
    "middle_stretch": Field("middle principal stretch", "–", "middle_stretch"),
    "smallest_stretch": Field("smallest principal stretch", "–", "smallest_stretch"),
    "J": Field("volume ratio J", "–", "J"),
    "contact_pressure": Field("contact pressure", "kPa", "contact_pressure_kPa", False),
    "energy_density": Field("strain energy density", "kPa", "energy_density_kPa"),
}


def list_sources(folder: StudyFolder, site: str) -> list[dict[str, Any]]:
    """The stored fields of a site: every step of a simulation, or the deepest point of the prediction.

    Each has ``source``, ``title``, ``times_s``, ``deepest`` (which of them), ``parameters_from``, and
    ``mark``, which other fields change.
    """
    sources = []
    moments = _list_moments(folder, site)
    if moments:
        times_s = [time for time, _ in moments]
        simulated = SimulateResult.find(folder.results, site)
        sources.append(
            {
                "source": "simulate",
                "title": "every step, simulated",
                "times_s": times_s,
                "deepest": _find_deepest(folder, site, times_s),
                "parameters_from": simulated and simulated.parameters_from,
                "mark": compute_fingerprint(file for _, file in moments),
            }
        )
    predicted = folder.results / "predict" / f"{site}.vtu"
    if predicted.is_file():
        sources.append(
            {
                "source": "predict",
                "title": "the deepest point, predicted",
                "times_s": [_find_peak_time(folder.artefact("predict", f"{site}.csv"))],
                "deepest": 0,
                "parameters_from": "identified",
                "mark": compute_fingerprint([predicted]),
            }
        )
    return sources


def _list_moments(folder: StudyFolder, site: str) -> list[tuple[float, Path]]:
    """The time (s) and file of every stored step of an animation."""
    collection = folder.results / "simulate" / f"{site}.pvd"
    if not collection.is_file():
        return []
    named = _FRAME.findall(collection.read_text(encoding="utf-8"))
    files = [(float(time), collection.with_suffix("") / name) for time, name in named]
    return [(time, file) for time, file in files if file.is_file()]


def _find_deepest(folder: StudyFolder, site: str, times_s: list[float]) -> int:
    """The moment nearest to the deepest point; the last one while the simulation goes on."""
    curve = folder.results / "simulate" / f"{site}.csv"
    if not curve.is_file():
        return len(times_s) - 1
    return int(np.argmin(np.abs(np.array(times_s) - _find_peak_time(curve))))


def _find_peak_time(curve: Path) -> float:
    columns = read_curves(curve)
    motion = columns["displacement_mm"] if "displacement_mm" in columns else columns["force_N"]
    loading = find_loading_end(find_phases(columns["time_s"], motion))
    return 0.0 if loading is None else loading.end_s


def _find_file(folder: StudyFolder, source: str, site: str, moment: int) -> Path:
    if source == "predict":
        return folder.artefact("predict", f"{site}.vtu")
    if source != "simulate":
        raise InputError("fields are those of simulate or predict")
    folder.artefact("simulate", f"{site}.pvd")  # a plain name, inside the study
    moments = _list_moments(folder, site)
    if not 0 <= moment < len(moments):
        raise FileNotFoundError(f"moment {moment} of site {site}")
    return folder.artefact("simulate", site, moments[moment][1].name)


def read_mesh(folder: StudyFolder, source: str, site: str) -> Block:
    """The mesh of a site's fields: the arrays of `VolumeShape`; facts: names of regions, stored fields."""
    file = _find_file(folder, source, site, 0)
    mesh = read_vtu(file)
    arrays = read_arrays(file)
    fields = [
        {"name": name, "title": field.title, "unit": field.unit}
        for name, field in FIELDS.items()
        if field.array in arrays
    ]
    facts = {"regions": list(mesh.region_names), "fields": fields, "cells": len(mesh.cells)}
    return to_volume_shape(mesh).arrays(), facts


def read_moment(folder: StudyFolder, source: str, site: str, moment: int, name: str) -> Block:
    """``moved`` (n, 3) of the drawn nodes in mm, and ``values`` of a field on cells or drawn nodes. Raises
    `InputError` for an unknown field, or one that is not stored, and `FileNotFoundError` for a moment that is
    not there.
    """
    field = FIELDS.get(name)
    file = _find_file(folder, source, site, moment)
    arrays = read_arrays(file)
    if field is None or field.array not in arrays:
        raise InputError("no such field is stored", remedy="fields are " + ", ".join(FIELDS))
    nodes = np.unique(arrays["cells"][:, :4])
    values = arrays[field.array]
    if values.ndim == 2:
        values = np.linalg.norm(values, axis=1) if field.component is None else values[:, field.component]
    drawn = {
        "moved": arrays["displacement_mm"][nodes].astype(np.float32),
        "values": (values if field.on_cells else values[nodes]).astype(np.float32),
    }
    return drawn, {"on": "cells" if field.on_cells else "nodes"}


def read_arrays(file: Path) -> dict[str, NDArray[Any]]:
    """The point and cell arrays of a VTU file, and its ``cells`` (m, k)."""
    grid = read_grid(file)
    arrays = {}
    for data in (grid.GetPointData(), grid.GetCellData()):
        for i in range(data.GetNumberOfArrays()):
            arrays[data.GetArrayName(i)] = vtk_to_numpy(data.GetArray(i))
    connectivity = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
    arrays["cells"] = connectivity.reshape(grid.GetNumberOfCells(), -1)
    return arrays
