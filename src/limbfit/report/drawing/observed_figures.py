"""What was seen beside the force, and its prediction: layers and shear waves under the indenter, the skin."""

from __future__ import annotations

from matplotlib.axes import Axes

from ..formats import fixed
from ..page import Figure
from ..store import Curves, Json, Results
from .colours import MEASURED, SIMULATED, choose_tissue_style
from .figures import thin_curves
from .plots import add_legend_above, label_outer_axes, make_figure, make_panels, plot_band, styled


def draw_layer_figure(store: Results, fitted: bool) -> Figure | None:
    """Compression of each layer against time at the fitted or held-out sites; None where none was seen."""
    caption = (
        "Compression of the tissues on the indenter's axis at the {} sites, as ultrasound saw it and as "
        "predicted; errors are means over the record, in percent of the largest compression."
    )
    words, quantity = "compression", ("compression", "mm")
    return _draw_time_figure(store, fitted, "ultrasound", "layers", quantity, words, caption)


def draw_wave_figure(store: Results, fitted: bool) -> Figure | None:
    """Speed of shear waves against time at the fitted or held-out sites; None where none was read."""
    caption = (
        "Speed of shear waves under the indenter at the {} sites, read and predicted: that of small, sudden "
        "shear on the strain that the indenter makes; errors are means in percent of the largest speed."
    )
    words, quantity = "speed of shear waves", ("speed", "m_s")
    return _draw_time_figure(store, fitted, "shear waves", "waves", quantity, words, caption)


@styled
def _draw_time_figure(
    store: Results, fitted: bool, kind: str, stem: str, quantity: tuple[str, str], words: str, caption: str
) -> Figure | None:
    """What was seen of a kind against time; ``quantity`` and its unit are in the heads of the curves."""
    rows, (what, unit) = _read_curves(store, fitted, kind), quantity
    if not rows:
        return None
    drawing, axes = make_panels(len(rows), 3, 2.1)
    label_outer_axes(axes, 3, "Time (s)", f"{what.capitalize()} ({unit.replace('_', '/')})")
    for ax, (row, layer, whole) in zip(axes, rows, strict=True):
        curves = thin_curves(whole)
        x = curves["time_s"]
        ax.plot(x, curves[f"{what}_measured_{unit}"], ".", ms=4, color=MEASURED, label="measured")
        if f"{what}_simulated_{unit}" in curves:
            ax.plot(x, curves[f"{what}_simulated_{unit}"], color=SIMULATED, label=store.materials)
        if f"{what}_low_{unit}" in curves:
            plot_band(ax, x, curves[f"{what}_low_{unit}"], curves[f"{what}_high_{unit}"])
        ax.set_title(f"{row['record']}, {layer['what']}: {fixed(layer['error_percent'])} %")
    add_legend_above(drawing, axes[0])
    use = "fitted" if fitted else "held-out"
    records = ", ".join(f"{row['record']} {layer['what']}" for row, layer, _ in rows)
    alt = f"Measured and predicted {words}: {records}"
    return make_figure(drawing, f"{stem}-{use}", alt, caption.format(use))


@styled
def draw_skin_figure(store: Results, fitted: bool) -> Figure | None:
    """Predicted against measured displacement of the skin at the fitted or held-out sites; None where the
    skin was not seen."""
    rows = [one for one in _read_curves(store, fitted, "surface") if "displacement_simulated_mm" in one[2]]
    if not rows:
        return None
    drawing, axes = make_panels(len(rows), 3, 2.6)
    label_outer_axes(axes, 3, "Measured (mm)", "Predicted (mm)")
    for ax, (row, seen, curves) in zip(axes, rows, strict=True):
        _draw_pairs(ax, curves, seen["components"])
        ax.set_title(f"{row['record']}: {fixed(seen['error_percent'])} %")
    add_legend_above(drawing, axes[0])
    use = "fitted" if fitted else "held-out"
    records = ", ".join(str(row["record"]) for row, _, _ in rows)
    caption = (
        f"Displacement of the skin around the indenter at the {use} sites: predicted against "
        "measured, for every point, component and span of time that is compared, with its 95 % interval. On "
        "the line both agree; errors are means in percent of the largest displacement."
    )
    alt = f"Measured and predicted displacement of skin: {records}"
    return make_figure(drawing, f"surface-{use}", alt, caption)


def _draw_pairs(ax: Axes, curves: Curves, components: list[str]) -> None:
    x, y = curves["displacement_measured_mm"], curves["displacement_simulated_mm"]
    ends = [min(x.min(), y.min()), max(x.max(), y.max())]
    ax.plot(ends, ends, color=MEASURED, lw=0.8)
    if "displacement_low_mm" in curves:
        low, high = curves["displacement_low_mm"], curves["displacement_high_mm"]
        ax.vlines(x, low, high, color=SIMULATED, alpha=0.15, lw=0.8)
    for number, word in enumerate(components):
        chosen = curves["component"] == number
        style = choose_tissue_style(number) | {"ls": "", "ms": 2.5}
        if chosen.any():
            ax.plot(x[chosen], y[chosen], **style, label=word)


def _read_curves(store: Results, fitted: bool, kind: str) -> list[tuple[Json, Json, Curves]]:
    """Rows of records, what was seen beside each in one way, and its stored curves."""
    return [
        (row, one, curves)
        for row in store.predicted
        if bool(row.get("fitted")) == fitted
        for one in row.get("observed") or ()
        if one["kind"] == kind and (curves := store.curves("predict", one["name"])) is not None
    ]
