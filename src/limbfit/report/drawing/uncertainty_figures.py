"""Figures of the uncertainty: the posterior in pairs, and records beside their prediction intervals."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from ..formats import fixed, label
from ..page import Figure
from ..store import Json, Results, compared_of
from .ink import (
    INK,
    MEASURED,
    MUTED,
    PANEL_WIDTH_IN,
    SIMULATED,
    STYLE,
    legend_above,
    panels,
    svg,
    truth_style,
)

_MOST_DRAWS, _MOST_SITES = 300, 18


def true_values(store: Results) -> dict[str, tuple[float, dict[str, Any]]]:
    """The phantom's true parameters by name, with their line; none for a patient."""
    found = store.truth.get("parameters") or {}
    return {
        f"{tissue}.{name}": (float(value), truth_style(i))
        for i, (tissue, values) in enumerate(found.items())
        for name, value in values.items()
    }


def pairs_figure(store: Results, content: Json) -> Figure | None:
    """Draws of the posterior, every parameter against every other, in logarithms."""
    draws = store.curves("uncertainty", "draws")
    if draws is None:
        return None
    names = [row["name"] for row in content["parameters"] if np.ptp(draws[row["name"]]) > 0]
    n = len(names)
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(PANEL_WIDTH_IN, PANEL_WIDTH_IN * 0.8), layout="constrained")
        drawing.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0.02, hspace=0.02)  # type: ignore[union-attr, call-arg]
        drawing.patch.set_alpha(0)
        truth = true_values(store)
        for i in range(n):
            for j in range(i + 1):
                ax = drawing.add_subplot(n, n, i * n + j + 1)
                _draw_pair(ax, draws, names[i], names[j], truth, content)
                _name_axes(ax, names, i, j)
    caption = (
        "The posterior in pairs, logarithmic axes: on the diagonal each parameter by itself. A narrow "
        "oblique "
        "cloud is a combination that is known where its parameters are not."
    )
    alt = f"Draws of the posterior for {', '.join(names)}, each against each"
    return Figure("posterior", svg(drawing, "posterior", alt), caption)


def _draw_pair(
    ax: Axes,
    draws: dict[str, np.ndarray],
    down: str,
    across: str,
    truth: dict[str, tuple[float, dict[str, Any]]],
    content: Json,
) -> None:
    ax.patch.set_alpha(0)
    ax.grid(visible=False)
    x = np.log10(draws[across])
    step = max(len(x) // _MOST_DRAWS, 1)
    if down == across:
        ax.hist(x, bins=24, color=SIMULATED, alpha=0.6, lw=0)
    else:
        ax.plot(
            x[::step], np.log10(draws[down])[::step], ls="", marker=".", ms=1.6, color=SIMULATED, alpha=0.6
        )
        identified = {row["name"]: row["calibrated"] for row in content["parameters"]}
        ax.plot(np.log10(identified[across]), np.log10(identified[down]), marker="o", ms=3, color=INK)
        if down in truth and across in truth:
            at = np.log10([truth[across][0], truth[down][0]])
            ax.plot(*at, marker="x", ms=5, mew=1.4, color=truth[down][1]["color"])


def _name_axes(ax: Axes, names: list[str], i: int, j: int) -> None:
    ax.tick_params(labelsize=5, length=2)
    for axis, wanted in ((ax.xaxis, i == len(names) - 1), (ax.yaxis, j == 0 and i > 0)):
        axis.set_major_formatter(lambda value, _: f"{10**value:.3g}" if wanted else "")  # noqa: B023
        axis.set_major_locator(matplotlib.ticker.MaxNLocator(2))
        if not wanted:
            axis.set_tick_params(labelbottom=False, labelleft=False)
    if i == len(names) - 1:
        ax.set_xlabel(label(names[j]), fontsize=7)
    if j == 0:
        ax.set_ylabel(label(names[i]), fontsize=7)


def _record(row: Json) -> str:
    return str(row.get("record", row["site"]))


def prediction_figure(store: Results, content: Json) -> Figure | None:
    """Records beside their prediction intervals, held-out sites first."""
    rows = sorted(content["predictions"]["sites"], key=lambda row: row["fitted"])[:_MOST_SITES]
    found = [(row, store.curves("uncertainty", f"predictions/{_record(row)}")) for row in rows]
    pairs = [(row, curves) for row, curves in found if curves is not None]
    if not pairs:
        return None
    columns = 3
    drawing, axes = panels(len(pairs), columns, 2.0)
    with matplotlib.rc_context(STYLE):
        for i, (ax, (row, curves)) in enumerate(zip(axes, pairs, strict=True)):
            time = curves["time_s"]
            quantity, unit = compared_of(curves)
            kinds = ("low", "high", "measured", "predicted")
            low, high, measured, predicted = (curves[f"{quantity}_{kind}_{unit}"] for kind in kinds)
            ax.fill_between(time, low, high, color=SIMULATED, alpha=0.22, lw=0, label="95 % interval")
            ax.plot(time, measured, color=MEASURED, lw=2.2, alpha=0.55, label="measured")
            ax.plot(time, predicted, color=SIMULATED, lw=1.1, label="predicted")
            kind = "fitted" if row["fitted"] else "held out"
            ax.set_title(f"site {_record(row)}, {kind}: {fixed(row['inside_percent'], 0)} % inside")
            ax.margins(x=0.01)
            if i % columns == 0 or quantity != "force":
                ax.set_ylabel(f"{quantity.capitalize()} ({unit})")
            if i + columns >= len(pairs):
                ax.set_xlabel("Time (s)")
        legend_above(drawing, axes[0])
        for ax in axes:
            ax.axhline(0, color=MUTED, lw=0.6)
    caption = (
        "Records beside their 95 % prediction intervals: uncertainty of the parameters, all counted "
        "sources, noise "
        "of the record and misfit of the model."
    )
    alt = "Measured and predicted force with intervals: " + ", ".join(_record(row) for row, _ in pairs)
    return Figure("predictions", svg(drawing, "predictions", alt), caption)
