"""What was seen beside the force, and its prediction: layers and shear waves under the indenter, the skin."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ..formats import fixed
from ..page import Figure
from ..store import Json, Results
from .figures import thin
from .ink import MEASURED, SIMULATED, STYLE, legend_above, panels, svg, tissue_style

Curves = dict[str, NDArray[np.float64]]


def layer_figure(store: Results, fitted: bool) -> Figure | None:
    """Compression of each layer against time at the fitted or held-out sites; None where none was seen."""
    drawn = _against_time(store, fitted, "ultrasound", ("compression", "mm"), "layers")
    if drawn is None:
        return None
    name, drawing, told = drawn
    caption = (
        f"Compression of the tissues on the indenter's axis at the {_word(fitted)} "
        "sites, as ultrasound saw it and as predicted; errors are means over the record, in percent of the "
        "largest compression."
    )
    return Figure(name, svg(drawing, name, f"Measured and predicted compression: {told}"), caption)


def wave_figure(store: Results, fitted: bool) -> Figure | None:
    """Speed of shear waves against time at the fitted or held-out sites; None where none was read."""
    drawn = _against_time(store, fitted, "shear waves", ("speed", "m_s"), "waves")
    if drawn is None:
        return None
    name, drawing, told = drawn
    caption = (
        f"Speed of shear waves under the indenter at the {_word(fitted)} sites, read and predicted: that "
        "of small, sudden shear on the strain that the indenter makes; errors are means in percent of the "
        "largest speed."
    )
    return Figure(name, svg(drawing, name, f"Measured and predicted speed of shear waves: {told}"), caption)


def _against_time(
    store: Results, fitted: bool, kind: str, quantity: tuple[str, str], stem: str
) -> tuple[str, Any, str] | None:
    """Name, drawing and words of what was seen of a kind; ``quantity`` and unit are in the curves' heads."""
    rows, (what, unit) = list(_seen(store, fitted, kind)), quantity
    if not rows:
        return None
    drawing, axes = panels(len(rows), 3, 2.1)
    with matplotlib.rc_context(STYLE):
        for i, (ax, (row, layer, whole)) in enumerate(zip(axes, rows, strict=True)):
            curves = thin(whole)
            x = curves["time_s"]
            ax.plot(x, curves[f"{what}_measured_{unit}"], ".", ms=4, color=MEASURED, label="measured")
            if f"{what}_simulated_{unit}" in curves:
                ax.plot(x, curves[f"{what}_simulated_{unit}"], color=SIMULATED, label=store.materials)
            if f"{what}_low_{unit}" in curves:
                low, high = curves[f"{what}_low_{unit}"], curves[f"{what}_high_{unit}"]
                ax.fill_between(x, low, high, color=SIMULATED, alpha=0.22, lw=0, label="95 % interval")
            ax.set_title(f"{row['record']}, {layer['what']}: {fixed(layer['error_percent'])} %")
            if i + 3 >= len(rows):
                ax.set_xlabel("Time (s)")
            if i % 3 == 0:
                ax.set_ylabel(f"{what.capitalize()} ({unit.replace('_', '/')})")
        legend_above(drawing, axes[0])
    told = ", ".join(f"{row['record']} {layer['what']}" for row, layer, _ in rows)
    return f"{stem}-{_word(fitted)}", drawing, told


def surface_figure(store: Results, fitted: bool) -> Figure | None:
    """Predicted against measured displacement of the skin at the fitted or held-out sites; None where the
    skin was not seen."""
    rows = [one for one in _seen(store, fitted, "surface") if "displacement_simulated_mm" in one[2]]
    if not rows:
        return None
    drawing, axes = panels(len(rows), 3, 2.6)
    with matplotlib.rc_context(STYLE):
        for i, (ax, (row, seen, curves)) in enumerate(zip(axes, rows, strict=True)):
            _draw_pairs(ax, curves, seen["components"])
            ax.set_title(f"{row['record']}: {fixed(seen['error_percent'])} %")
            if i + 3 >= len(rows):
                ax.set_xlabel("Measured (mm)")
            if i % 3 == 0:
                ax.set_ylabel("Predicted (mm)")
        legend_above(drawing, axes[0])
    name = "surface-fitted" if fitted else "surface-held-out"
    told = ", ".join(str(row["record"]) for row, _, _ in rows)
    caption = (
        f"Displacement of the skin around the indenter at the {_word(fitted)} sites: predicted against "
        "measured, for every point, component and span of time that is compared, with its 95 % interval. On "
        "the line both agree; errors are means in percent of the largest displacement."
    )
    return Figure(name, svg(drawing, name, f"Measured and predicted displacement of skin: {told}"), caption)


def _draw_pairs(ax: matplotlib.axes.Axes, curves: Curves, components: list[str]) -> None:
    x, y = curves["displacement_measured_mm"], curves["displacement_simulated_mm"]
    ends = [min(x.min(), y.min()), max(x.max(), y.max())]
    ax.plot(ends, ends, color=MEASURED, lw=0.8)
    if "displacement_low_mm" in curves:
        low, high = curves["displacement_low_mm"], curves["displacement_high_mm"]
        ax.vlines(x, low, high, color=SIMULATED, alpha=0.15, lw=0.8)
    for number, word in enumerate(components):
        chosen = curves["component"] == number
        style = tissue_style(number) | {"ls": "", "ms": 2.5}
        if chosen.any():
            ax.plot(x[chosen], y[chosen], **style, label=word)


def _seen(store: Results, fitted: bool, kind: str) -> Iterator[tuple[Json, Json, Curves]]:
    """Rows of records, what was seen beside each in one way, and its stored curves."""
    for row in store.predicted:
        if bool(row.get("fitted")) == fitted:
            for one in row.get("observed") or ():
                curves = store.curves("predict", one["name"])
                if one["kind"] == kind and curves is not None:
                    yield row, one, curves


def _word(fitted: bool) -> str:
    return "fitted" if fitted else "held-out"
