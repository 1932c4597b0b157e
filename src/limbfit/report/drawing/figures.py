"""Curves of the report: forces (the paper's figure 7), convergence, errors, intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..formats import fixed, number, symbol, unit_of
from ..page import Figure
from ..store import Curves, Json, Results, compared_of
from ..tables import interval
from .ink import (
    FITTED,
    HELD_OUT,
    INK,
    MEASURED,
    MUTED,
    ONE_MATERIAL,
    SIMULATED,
    STYLE,
    TRUTH,
    legend_above,
    panels,
    svg,
    tissue_style,
    truth_style,
)

MOST_POINTS, LONGEST_TITLE, MOST_IN_A_ROW = 2500, 44, 7


def thin(curves: Curves) -> Curves:
    """At most ``MOST_POINTS`` samples of every column: more cannot be seen."""
    stride = max(1, math.ceil(len(next(iter(curves.values()))) / MOST_POINTS))
    return {name: values[::stride] for name, values in curves.items()}


def force_figure(
    store: Results, rows: Iterable[Json], against: str, name: str, columns: int
) -> Figure | None:
    """Figure 7: measured and simulated force of each site, against ``time_s`` or ``displacement_mm``."""
    found = [(row, store.curves("predict", row["record"])) for row in rows]
    pairs = [(row, curves) for row, curves in found if curves is not None and against in curves]
    if not pairs:
        return None
    drawing, axes = panels(len(pairs), columns, 2.6 if columns < 3 else 2.1)
    words = {"time_s": ("Time (s)", "time"), "displacement_mm": ("Displacement (mm)", "displacement")}
    with matplotlib.rc_context(STYLE):
        for i, (ax, (row, curves)) in enumerate(zip(axes, pairs, strict=True)):
            _draw_forces(ax, thin(curves), against, store.materials)
            ax.set_title(_site_title(store, row, columns))
            if i + columns >= len(pairs):
                ax.set_xlabel(words[against][0])
            quantity, unit = compared_of(curves)
            if i % columns == 0 or quantity != "force":
                ax.set_ylabel(f"{quantity.capitalize()} ({unit})")
        legend_above(drawing, max(axes, key=lambda ax: len(ax.get_legend_handles_labels()[1])))
    sites = ", ".join(f"{row['record']} ({fixed(row.get('error_percent'))} %)" for row, _ in pairs)
    alt = f"Measured and simulated force against {words[against][1]}; site and error: {sites}"
    kind = "fitted" if all(row.get("fitted") for row, _ in pairs) else "held-out"
    paper = "Figure 7 of the paper for this study: m" if name == "forces-fitted" else "M"
    caption = (
        f"{paper}easured and simulated force against {words[against][1]} at the {kind} sites, with the error."
    )
    return Figure(name, svg(drawing, name, alt), caption)


def _site_title(store: Results, row: Json, columns: int) -> str:
    region = str(row.get("region") or "")
    head = f"site {row['record']}" + (f", {region}" if region and columns < 3 else "")
    return f"{_short(head, LONGEST_TITLE // (columns - 1 or 1))}: {fixed(row.get('error_percent'))} %"


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _draw_forces(ax: Axes, curves: Curves, against: str, materials: str) -> None:
    x, (quantity, unit) = curves[against], compared_of(curves)
    kinds = ("low", "high", "measured", "one_material", "simulated")
    low, high, measured, one, simulated = (curves.get(f"{quantity}_{kind}_{unit}") for kind in kinds)
    if low is not None and high is not None and against == "time_s":
        ax.fill_between(x, low, high, color=SIMULATED, alpha=0.22, lw=0, label="95 % interval")
    if measured is not None:
        ax.plot(x, measured, color=MEASURED, lw=2.6, alpha=0.55, label="measured")
    if one is not None:
        ax.plot(x, one, color=ONE_MATERIAL, ls=(0, (5, 2)), label="one material")
    if simulated is not None:
        ax.plot(x, simulated, color=SIMULATED, label=materials)
    ax.margins(x=0.01)


def simulated_figure(store: Results) -> Figure | None:
    """Force of each indentation that was simulated by itself, against time and displacement."""
    found = [(row, store.curves("simulate", row["site"])) for row in store.simulated]
    pairs = [(row, curves) for row, curves in found if curves is not None]
    if not pairs:
        return None
    drawing, axes = panels(2, 2, 2.6)
    with matplotlib.rc_context(STYLE):
        for i, (row, curves) in enumerate(pairs):
            color, ls = (SIMULATED, ONE_MATERIAL, TRUTH, INK)[i % 4], ("-", "--", ":", "-.")[i % 4]
            axes[0].plot(curves["time_s"], curves["force_N"], color=color, ls=ls, label=row["site"])
            axes[1].plot(curves["displacement_mm"], curves["force_N"], color=color, ls=ls)
        for ax, label in zip(axes, ("Time (s)", "Displacement (mm)"), strict=True):
            ax.set_xlabel(label)
            ax.set_ylabel("Force (N)")
        legend_above(drawing, axes[0])
    names = ", ".join(row["site"] for row, _ in pairs)
    svg_text = svg(drawing, "simulated", f"Simulated force against time and displacement, sites {names}")
    return Figure("simulated", svg_text, "Force of the simulated indentations.")


def compared_figure(store: Results) -> Figure | None:
    """Force by FEBio and by limbfit, a panel for each site where both were run."""
    pairs = [(row["site"], store.curves("compare", row["site"])) for row in store.compared]
    found = [(site, curves) for site, curves in pairs if curves is not None]
    if not found:
        return None
    drawing, axes = panels(len(found), 3, 2.5)
    with matplotlib.rc_context(STYLE):
        for ax, (site, curves) in zip(axes, found, strict=True):
            at = curves["time_s"]
            ax.plot(at, curves["febio_N"], "o", ms=3, mfc="none", color=MEASURED, label="FEBio")
            ax.plot(at, curves["limbfit_N"], color=SIMULATED, label="limbfit")
            ax.plot(at, curves["limbfit_matched_N"], "--", color=TRUTH, label="with FEBio's contact penalty")
            ax.set(title=f"Site {site}", xlabel="Time (s)", ylabel="Force (N)")
        legend_above(drawing, axes[0])
    names = ", ".join(site for site, _ in found)
    text = svg(drawing, "compared", f"Force by FEBio and by limbfit against time, sites {names}")
    return Figure("compared", text, "Force of the same indentation by FEBio and by limbfit.")


def convergence_figure(store: Results) -> Figure | None:
    """The error and the parameters over the accepted iterates, stage after stage."""
    stages = [stage for stage in store.stages if stage.get("iterations")]
    if not stages:
        return None
    count = 1 + len(store.law.keys)
    drawing, axes = panels(count, 5, 2.3)
    with matplotlib.rc_context(STYLE):
        offset = 0
        for stage in stages:
            offset += _draw_stage(axes, store, stage, offset)
        _finish_convergence(axes, store, stages)
        handles = [*axes[0].get_legend_handles_labels()[0], *axes[1].get_legend_handles_labels()[0]]
        rows = math.ceil(len(handles) / MOST_IN_A_ROW)
        columns = math.ceil(len(handles) / rows)
        labels = [str(handle.get_label()) for handle in handles]
        drawing.legend(handles, labels, loc="outside upper left", ncols=columns)
    last = fixed(stages[-1]["iterations"][-1].get("error_percent"), 2)
    alt = f"Error and parameters against iteration; the error ends at {last} %"
    caption = (
        "The paper's two steps (figure 5) as they went: the mean error at the fitted sites (thin lines: "
        "each site) and the parameters, "
        "over the accepted iterates. The vertical line is where the second stage begins."
    )
    return Figure("convergence", svg(drawing, "convergence", alt), caption)


def _draw_stage(axes: list[Axes], store: Results, stage: Json, offset: int) -> int:
    """Draw one stage from iteration ``offset`` on; the number of its iterates."""
    steps = stage["iterations"]
    x = offset + np.arange(len(steps))
    sites = sorted({site for step in steps for site in step.get("error_percent_by_site", {})})
    for site in sites:
        errors = [step.get("error_percent_by_site", {}).get(site, math.nan) for step in steps]
        axes[0].plot(x, errors, color=MUTED, lw=0.8)
    mean = [step.get("error_percent", math.nan) for step in steps]
    axes[0].plot(x, mean, color=INK, marker="o", ms=3, label="mean error" if offset == 0 else None)
    for ax, name in zip(axes[1:], store.law.keys, strict=True):
        for i, tissue in enumerate(stage["parameters"]):
            values = [step["parameters"].get(tissue, {}).get(name, math.nan) for step in steps]
            ax.plot(x, values, ms=3, label=tissue if offset == 0 else None, **tissue_style(i))
    if offset:
        for ax in axes:
            ax.axvline(offset - 0.5, color=MUTED, lw=0.8)
    return len(steps)


def _finish_convergence(axes: list[Axes], store: Results, stages: list[Json]) -> None:
    axes[0].set_title("Error (%)")
    axes[0].set_yscale("log")
    axes[0].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes[0].yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
    for ax, name in zip(axes[1:], store.law.keys, strict=True):
        unit = unit_of(name)
        ax.set_title(f"{symbol(name)} ({unit})" if len(unit) > 1 or unit == "s" else f"{symbol(name)} (–)")
        truth = store.truth.get("parameters", {})
        for i, (tissue, values) in enumerate(truth.items()):
            if name in values:
                ax.axhline(values[name], lw=1, label=f"truth, {tissue}", **truth_style(i))
    for ax in axes:
        ax.set_xlabel("Iterate")
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))


def error_figure(store: Results) -> Figure | None:
    """The error of every site as a bar, fitted and held-out told apart by colour and hatching."""
    rows = [row for row in store.predicted if isinstance(row.get("error_percent"), int | float)]
    if not rows:
        return None
    drawing, (ax,) = panels(1, 1, 0.7 + 0.24 * len(rows))
    with matplotlib.rc_context(STYLE):
        for at, row in enumerate(rows):
            fitted = bool(row.get("fitted"))
            color, hatch = (FITTED, None) if fitted else (HELD_OUT, "///")
            ax.barh(at, row["error_percent"], color=color, alpha=0.75, hatch=hatch, height=0.62)
            ax.text(row["error_percent"], at, f" {fixed(row['error_percent'])}", va="center", fontsize=8)
        ax.set_yticks(range(len(rows)), [_bar_label(row) for row in rows])
        ax.invert_yaxis()
        ax.grid(visible=False, axis="y")
        ax.set_xlabel("Mean absolute error over largest force (%)")
    sites = ", ".join(f"{row['record']} {fixed(row['error_percent'])} %" for row in rows)
    caption = "Force error of each site. Plain bars: sites that were fitted; hatched: held out."
    return Figure("errors", svg(drawing, "errors", f"Error of each site: {sites}"), caption)


def _bar_label(row: Json) -> str:
    use = "fitted" if row.get("fitted") else "held out"
    return f"{row['record']} ({use})"


def interval_figure(store: Results) -> Figure | None:
    """Start, one-material value, interval and truth of every parameter, as a ratio to the identified one."""
    if not store.stages:
        return None
    last = store.stages[-1].get("parameters", {})
    names = [(t, n) for t in store.tissues for n in store.law.keys if last.get(t, {}).get(n)]
    if not names:
        return None
    drawing, (ax,) = panels(1, 1, 0.7 + 0.3 * len(names))
    with matplotlib.rc_context(STYLE):
        for at, (tissue, name) in enumerate(names):
            _draw_ratio(ax, store, at, tissue, name)
        labels = [f"{t} {symbol(n)} = {number(last[t][n])} {_unit(n)}".strip() for t, n in names]
        ax.set_yticks(range(len(names)), labels)
        ax.invert_yaxis()
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
        ax.set_xlabel("Ratio to the identified value (–)")
        ax.axvline(1, color=MUTED, lw=0.8)
        ax.grid(visible=False, axis="y")
        legend_above(drawing, ax)
    caption = (
        "The identified parameters with their 95 % intervals, on a logarithmic scale so that all can be "
        "compared. A long bar is a parameter that the data leave open."
    )
    alt = "Intervals of the parameters as ratios to the identified values; the numbers are in table 1"
    return Figure("intervals", svg(drawing, "intervals", alt), caption)


def _unit(name: str) -> str:
    return unit_of(name) if unit_of(name) != "–" else ""


def _draw_ratio(ax: Axes, store: Results, at: int, tissue: str, name: str) -> None:
    stages = store.stages
    value = stages[-1]["parameters"][tissue][name]
    first = at == 0
    limits = interval(store, tissue, name)
    if limits:
        low, high = max(limits[0] / value, 1e-3), min(limits[1] / value, 1e3)
        label = "95 % interval" if first else None
        ax.plot([low, high], [at, at], color=SIMULATED, lw=6, alpha=0.35, solid_capstyle="butt", label=label)
    marks = [
        ("identified", value, "o", SIMULATED),
        ("start", stages[0].get("start", {}).get(tissue, {}).get(name), "|", MUTED),
    ]
    if len(stages) > 1:
        marks.append(("one material", stages[0]["parameters"].get(tissue, {}).get(name), "D", ONE_MATERIAL))
    marks.append(("truth", store.truth.get("parameters", {}).get(tissue, {}).get(name), "x", TRUTH))
    for label, mark, marker, color in marks:
        if mark:
            ax.plot(
                mark / value,
                at,
                ls="",
                marker=marker,
                color=color,
                ms=7,
                mew=1.8,
                markerfacecolor="none" if marker == "D" else color,
                label=label if first else None,
            )
