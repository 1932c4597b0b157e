"""What moves in the report: the limb in three dimensions with fields of its sites, and curves to read from.

All of it is data for scripts of the room ``web``; the pictures stay, for print and where there is no WebGL.
"""

import base64
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...mesh import read_vtu
from ...results.limb import PlacedSite
from ...web import extract_interface, pack, read_shell, to_shell, to_volume_shape
from ..formats import format_symbol, format_unit
from ..page import InteractiveFigure
from ..store import Curves, Json, Results, name_compared
from ..words import write_words
from . import pictures

MAX_FACES, MAX_SAMPLES = 12_000, 300
FIELD_RADIUS_MM = 50.0
LAYER = "#c8a13a"
STRESS = "von_mises_kPa"


def make_explorer(store: Results) -> InteractiveFigure | None:
    """Surfaces, layers, bones and sites, the field at the deepest point of each site, and its curves."""
    if "skin" not in store.surface_files:
        return None
    arrays: dict[str, NDArray[Any]] = {}
    surfaces = _read_surfaces(store, arrays)
    fields = _cut_fields(store, arrays)
    facts = {
        "frame": pictures.read_limb_frame(store).tolist(),
        "surfaces": surfaces,
        "sites": [_describe_site(store, row) for row in store.placed_sites.values()],
        "fields": fields,
    }
    content = {
        "arrays": base64.b64encode(pack(arrays, facts)).decode("ascii"),
        "curves": {site: curves for site in store.site_names if (curves := _read_site_curves(store, site))},
    }
    caption = write_words("figure explorer", radius_mm=FIELD_RADIUS_MM)
    return InteractiveFigure("explorer", "model", "The limb in three dimensions.", caption, content)


def _read_surfaces(store: Results, arrays: dict[str, NDArray[Any]]) -> list[Json]:
    rows = []
    for name, file in store.surface_files.items():
        shell = read_shell(file, MAX_FACES)
        kind, _, title = name.partition("-")
        row = {
            "name": name,
            "title": title or name,
            "kind": "skin" if name == "skin" else "bone",
            "colour": pictures.SKIN_SURFACE if name == "skin" else pictures.choose_inner_colour(name),
            "opacity": 0.38 if kind == "skin" else 1.0,
        }
        rows.append(row)
        arrays[f"{name}.points"], arrays[f"{name}.faces"] = shell.points, shell.faces
    for name, shell in _read_layers(store):
        rows.append({"name": name, "title": name, "kind": "layer", "colour": LAYER, "opacity": 0.5})
        arrays[f"{name}.points"], arrays[f"{name}.faces"] = shell.points, shell.faces
    return rows


def _read_layers(store: Results) -> Iterable[tuple[str, Any]]:
    """The inner face of each layer, as in the first stored mesh."""
    file = next((file for site in store.site_names if (file := store.vtu("mesh", site))), None)
    if file is None:
        return
    mesh = read_vtu(file)
    volume = to_volume_shape(mesh)
    inner = {file.removeprefix("region-") for file in store.surface_files if file.startswith("region-")}
    for index, name in enumerate(name for name in mesh.region_names[:-1] if name not in inner):
        yield f"inner face of {name}", extract_interface(volume, index)


def _describe_site(store: Results, row: PlacedSite) -> Json:
    axis = np.asarray(row.axis, dtype=float)
    rows = [one for one in store.predicted if one.site == row.site]
    errors = [one.error_percent for one in rows if one.error_percent is not None]
    return {
        "name": row.site,
        "region": row.region or "",
        "fitted": row.fitted,
        "at": list(row.position_mm),
        "axis": (axis / np.linalg.norm(axis)).tolist(),
        "colour": pictures.FITTED if row.fitted else pictures.HELD_OUT,
        "error_percent": statistics.fmean(errors) if errors else None,
        "compared": name_compared(rows),
    }


def _cut_fields(store: Results, arrays: dict[str, NDArray[Any]]) -> list[Json]:
    """The cut through each site at its deepest point, as triangles with displacements and stress."""
    stage = "predict" if store.predict else "simulate"
    fields = []
    for row, file in pictures.find_placed_meshes(store, store.site_names, stage):
        cut = _cut_field(store, row, file)
        if cut is None:
            continue
        name = f"field.{row.site}"
        arrays |= {f"{name}.{part}": values for part, values in cut.items() if part != "direction"}
        fields.append({"site": row.site, "name": name, "direction": cut["direction"].tolist()})
    return fields


def _cut_field(store: Results, row: PlacedSite, file: Path) -> dict[str, NDArray[Any]] | None:
    grid = pictures.read_linear(file)
    if STRESS not in grid.cell_data or "displacement_mm" not in grid.point_data:
        return None
    view = pictures.make_cut_views(store, row, file)[1]
    cut = pictures.cut_behind(grid, view, smooth=True)
    surface = cut.extract_surface(algorithm="dataset_surface").triangulate()
    near = np.linalg.norm(np.asarray(surface.cell_centers().points) - view.focal, axis=1) < FIELD_RADIUS_MM
    if not near.any():
        return None
    part = surface.extract_cells(np.flatnonzero(near)).extract_surface(algorithm="dataset_surface")
    shell = to_shell(part)
    return {
        "points": shell.points,
        "faces": shell.faces,
        "moved": np.asarray(part.point_data["displacement_mm"], dtype=np.float32),
        "stress": np.asarray(part.cell_data[STRESS], dtype=np.float32),
        "direction": np.asarray(view.direction, dtype=float),
    }


def _to_lists(curves: Curves) -> dict[str, list[float | None]]:
    """Every so many values of each curve with five digits, and the last one."""
    count = len(next(iter(curves.values())))
    chosen = np.unique(np.r_[0 : count : max(1, math.ceil(count / MAX_SAMPLES)), count - 1])
    columns = {name: curves[name][chosen] for name in _COLUMNS if name in curves}
    return {name: [float(f"{v:.5g}") if math.isfinite(v) else None for v in x] for name, x in columns.items()}


_KINDS = ("measured", "simulated", "one_material", "low", "high")
_COLUMNS = (
    *("time_s", "displacement_mm", *(f"force_{kind}_N" for kind in _KINDS), "force_N"),
    *(f"displacement_{kind}_mm" for kind in _KINDS),
)


def _read_site_curves(store: Results, site: str) -> Json | None:
    """A site's force by its first record: predicted, else simulated by itself, else as recorded."""
    for stage in ("predict", "simulate", "traces"):
        for record in dict.fromkeys((site, *store.records_of(site))):
            curves = store.curves(stage, record)
            if curves is not None and len(next(iter(curves.values()))):
                facts = {"stage": stage, "record": record, "materials": store.materials}
                return facts | _to_lists(curves)
    return None


def draw_record_curves(store: Results, sites: Sequence[str]) -> InteractiveFigure | None:
    """Each record as the robot wrote it and regularised, to choose from."""
    choices = {}
    for site in sites:
        raw, smooth, start = store.record_curves(site)
        if raw is None or smooth is None:
            continue
        phases = store.traces[site].phases
        choices[site] = {
            "raw": _to_lists(raw),
            "smooth": _to_lists(smooth),
            "touch": {"time_s": start[0], "displacement_mm": start[1]},
            "ends": {
                "time_s": [phase.end_s for phase in phases],
                "displacement_mm": [phase.end_mm + start[1] for phase in phases],
            },
        }
    if not choices:
        return None
    caption = write_words("figure records")
    return InteractiveFigure("records", "records", "Records of all sites.", caption, {"sites": choices})


def draw_convergence_curves(store: Results) -> InteractiveFigure | None:
    """The error and each parameter over the accepted iterates of all stages."""
    steps = [step for stage in store.stages for step in stage.iterations]
    if not steps:
        return None
    errors = [{"label": "mean error", "y": [step.error_percent for step in steps]}]
    for site in sorted(steps[0].error_percent_by_site):
        errors.append({"label": f"site {site}", "y": [step.error_percent_by_site[site] for step in steps]})
    panels: list[Json] = [{"title": "Error", "unit": "%", "log": True, "series": errors}]
    for name in store.law.keys:
        series = [
            {"label": tissue, "y": [step.parameters[tissue][name] for step in steps]}
            for tissue in store.tissues
        ]
        panel = {"title": format_symbol(name), "unit": format_unit(name), "log": False}
        panels.append(panel | {"series": series})
    caption = write_words("figure iterates")
    label = "Error and parameters over the iterates."
    return InteractiveFigure("iterates", "iterates", label, caption, {"panels": panels})
