"""Figures of the uncertainty: the posterior in pairs, and records beside their prediction intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from ..formats import fixed, label
from ..page import Figure
from ..store import Curves, Json, Results, find_compared_quantity, get_record_name
from .colours import INK, MEASURED, MUTED, SIMULATED, choose_truth_style
from .plots import (
    PANEL_WIDTH_IN,
    add_legend_above,
    label_outer_axes,
    make_figure,
    make_panels,
    plot_band,
    styled,
)

TrueValues = dict[str, tuple[float, dict[str, Any]]]  # by name: a true parameter and its line
MAX_DRAWS, MAX_SITES = 300, 18


def read_true_values(store: Results) -> TrueValues:
    """The phantom's true parameters by name, with their line; none for a patient."""
    found = store.truth.get("parameters") or {}
    return {
        f"{tissue}.{name}": (float(value), choose_truth_style(i))
        for i, (tissue, values) in enumerate(found.items())
        for name, value in values.items()
    }


@styled
def draw_pairs_figure(store: Results, content: Json) -> Figure | None:
    """Draws of the posterior, every parameter against every other, in logarithms."""
    draws = store.curves("uncertainty", "draws")
    if draws is None:
        return None
    names = [row["name"] for row in content["parameters"] if np.ptp(draws[row["name"]]) > 0]
    n = len(names)
    drawing = Drawing(figsize=(PANEL_WIDTH_IN, PANEL_WIDTH_IN * 0.8), layout="constrained")
    drawing.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0.02, hspace=0.02)  # type: ignore[union-attr, call-arg]
    drawing.patch.set_alpha(0)
    identified = {row["name"]: row["calibrated"] for row in content["parameters"]}
    for i in range(n):
        for j in range(i + 1):
            ax = drawing.add_subplot(n, n, i * n + j + 1)
            _draw_pair(ax, draws, names[i], names[j], read_true_values(store), identified)
            ax.tick_params(labelsize=5, length=2)
            _name_axis(ax.xaxis, names[j] if i == n - 1 else "", i == n - 1)
            _name_axis(ax.yaxis, names[i] if j == 0 else "", j == 0 and i > 0)
    caption = (
        "The posterior in pairs, logarithmic axes: on the diagonal each parameter by itself. A narrow "
        "oblique cloud is a combination that is known where its parameters are not."
    )
    alt = f"Draws of the posterior for {', '.join(names)}, each against each"
    return make_figure(drawing, "posterior", alt, caption)


def _draw_pair(
    ax: Axes, draws: Curves, down: str, across: str, truth: TrueValues, identified: dict[str, float]
) -> None:
    ax.patch.set_alpha(0)
    ax.grid(visible=False)
    x, y = np.log10(draws[across]), np.log10(draws[down])
    step = max(len(x) // MAX_DRAWS, 1)
    if down == across:
        ax.hist(x, bins=24, color=SIMULATED, alpha=0.6, lw=0)
        return
    ax.plot(x[::step], y[::step], ls="", marker=".", ms=1.6, color=SIMULATED, alpha=0.6)
    ax.plot(np.log10(identified[across]), np.log10(identified[down]), marker="o", ms=3, color=INK)
    if down in truth and across in truth:
        at = np.log10([truth[across][0], truth[down][0]])
        ax.plot(*at, marker="x", ms=5, mew=1.4, color=truth[down][1]["color"])


def _name_axis(axis: Axis, name: str, numbered: bool) -> None:
    """The name of a parameter at an axis of logarithms, and its numbers where ``numbered``."""
    axis.set_major_formatter(lambda value, _: f"{10**value:.3g}" if numbered else "")
    axis.set_major_locator(MaxNLocator(2))
    if not numbered:
        axis.set_tick_params(labelbottom=False, labelleft=False)
    if name:
        axis.set_label_text(label(name), fontsize=7)


@styled
def draw_prediction_figure(store: Results, content: Json) -> Figure | None:
    """Records beside their prediction intervals, held-out sites first."""
    rows = sorted(content["predictions"]["sites"], key=lambda row: row["fitted"])[:MAX_SITES]
    pairs = store.with_curves("uncertainty/predictions", rows)
    if not pairs:
        return None
    drawing, axes = make_panels(len(pairs), 3, 2.0)
    label_outer_axes(axes, 3, "Time (s)", "Force (N)")
    for ax, (row, curves) in zip(axes, pairs, strict=True):
        time = curves["time_s"]
        quantity, unit = find_compared_quantity(curves)
        kinds = ("low", "high", "measured", "predicted")
        low, high, measured, predicted = (curves[f"{quantity}_{kind}_{unit}"] for kind in kinds)
        plot_band(ax, time, low, high)
        ax.plot(time, measured, color=MEASURED, lw=2.2, alpha=0.55, label="measured")
        ax.plot(time, predicted, color=SIMULATED, lw=1.1, label="predicted")
        kind = "fitted" if row["fitted"] else "held out"
        ax.set_title(f"site {get_record_name(row)}, {kind}: {fixed(row['inside_percent'], 0)} % inside")
        ax.margins(x=0.01)
        if quantity != "force":
            ax.set_ylabel(f"{quantity.capitalize()} ({unit})")
    add_legend_above(drawing, axes[0])
    for ax in axes:
        ax.axhline(0, color=MUTED, lw=0.6)
    caption = (
        "Records beside their 95 % prediction intervals: uncertainty of the parameters, all counted sources, "
        "noise of the record and misfit of the model."
    )
    records = ", ".join(get_record_name(row) for row, _ in pairs)
    alt = f"Measured and predicted force with intervals: {records}"
    return make_figure(drawing, "predictions", alt, caption)
