"""Curves of the report: forces (the paper's figure 7) and what was seen beside them, convergence, errors."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ...results.identification import ObservedError, QuantityRange, RecordPrediction, SearchStage
from ..formats import format_fixed, format_symbol, format_unit, format_with_value
from ..page import Figure
from ..store import Curves, Results, find_compared_quantity
from . import plots
from .colours import FITTED, HELD_OUT, INK, MEASURED, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH

Rows = Iterable[RecordPrediction]
Seen = tuple[RecordPrediction, ObservedError, Curves]
MAX_POINTS, MAX_TITLE, MAX_LEGEND_ROW = 2500, 44, 7


def thin_curves(curves: Curves) -> Curves:
    """At most ``MAX_POINTS`` samples of every column: more cannot be seen."""
    stride = max(1, math.ceil(len(next(iter(curves.values()))) / MAX_POINTS))
    return {name: values[::stride] for name, values in curves.items()}


@plots.styled
def draw_force_figure(store: Results, rows: Rows, against: str, name: str, columns: int) -> Figure | None:
    """Figure 7: measured and simulated force of each site, against ``time_s`` or ``displacement_mm``."""
    pairs = [(row, curves) for row, curves in store.with_curves("predict", rows) if against in curves]
    if not pairs:
        return None
    drawing, axes = plots.make_panels(len(pairs), columns, 2.6 if columns < 3 else 2.1)
    words = "time" if against == "time_s" else "displacement"
    plots.label_outer(axes, columns, "Time (s)" if against == "time_s" else "Displacement (mm)", "Force (N)")
    for ax, (row, curves) in zip(axes, pairs, strict=True):
        draw_forces(ax, thin_curves(curves), against, "simulated", store.materials)
        ax.set_title(_make_site_title(row, columns))
    plots.add_legend(drawing, *axes)
    shown, paper = [row for row, _ in pairs], name == "forces-fitted"
    return plots.make_figure(drawing, name, words="forces", rows=shown, against=words, paper=paper)


def _make_site_title(row: RecordPrediction, columns: int) -> str:
    head = f"site {row.record}" + (f", {row.region}" if row.region and columns < 3 else "")
    most = MAX_TITLE // (columns - 1 or 1)
    head = head if len(head) <= most else head[: most - 1] + "…"
    return f"{head}: {format_fixed(row.error_percent)} %"


def draw_forces(ax: Axes, curves: Curves, against: str, kind: str, name: str) -> None:
    """A record as measured and as simulated, which columns of the ``kind`` have, with its interval."""
    x, (quantity, unit) = curves[against], find_compared_quantity(curves)
    kinds = ("low", "high", "measured", "one_material", kind)
    low, high, measured, one, simulated = (curves.get(f"{quantity}_{kind}_{unit}") for kind in kinds)
    if low is not None and high is not None and against == "time_s":
        plots.plot_band(ax, x, low, high)
    if measured is not None:
        ax.plot(x, measured, color=MEASURED, lw=2.6, alpha=0.55, label="measured")
    if one is not None:
        ax.plot(x, one, color=ONE_MATERIAL, ls=(0, (5, 2)), label="one material")
    if simulated is not None:
        ax.plot(x, simulated, color=SIMULATED, label=name)
    if quantity != "force":
        ax.set_ylabel(f"{quantity.capitalize()} ({unit})")
    ax.margins(x=0.01)


@plots.styled
def draw_domain_figure(store: Results) -> Figure | None:
    """Times and shear of each tissue: those of the records, and those of predictions and of the socket."""
    tested = _read_extents(store.predict.recorded_range.extents if store.predict else ())
    tissues = [tissue for quantity, tissue in tested if quantity == "shear strain" and tissue]
    if not tissues:
        return None
    loads = store.socket.loads if store.socket else ()
    rows = [
        *((row.loading, "fitted record", FITTED, "") for row in store.predicted if row.fitted),
        *((row.loading, "held-out record", HELD_OUT, "") for row in store.predicted if not row.fitted),
        *((one.loading or (), "socket", THIRD, one.name) for one in loads),
    ]
    drawing, axes = plots.make_panels(len(tissues), 3, 2.4)
    plots.label_outer(axes, 3, "Time (s)", "Shear strain")
    for ax, tissue in zip(axes, tissues, strict=True):
        time, shear = tested["time", None], tested["shear strain", tissue]
        ax.fill_between(time, 0.0, shear[1], color=FITTED, alpha=0.15, lw=0, label="what the records tell")
        for loading, label, color, name in rows:
            extents = _read_extents(loading)
            if ("shear strain", tissue) in extents:
                times, (_, high) = extents["time", None], extents["shear strain", tissue]
                ax.plot(times, (high, high), color=color, marker="|", label=label)
                ax.annotate(name, (times[1], high), xytext=(0, 3), textcoords="offset points", ha="right")
        plots.set_log_scale(ax, minor=not loads)
        ax.set_ylim(bottom=0.0)
        ax.set_title(tissue)
    plots.add_legend(drawing, axes[0], columns=4)
    return plots.make_figure(drawing, "domain")


def _read_extents(loading: Iterable[QuantityRange]) -> dict[tuple[str, str | None], tuple[float, float]]:
    """The stored range of each quantity, by its name and tissue."""
    return {(one.quantity, one.tissue): (one.low, one.high) for one in loading}


@plots.styled
def draw_simulated_figure(store: Results) -> Figure | None:
    """Force of each indentation that was simulated by itself, against time and displacement."""
    pairs = store.with_curves("simulate", store.simulated)
    if not pairs:
        return None
    drawing, axes = plots.make_panels(2, 2, 2.6)
    for i, (row, curves) in enumerate(pairs):
        color, ls = (SIMULATED, ONE_MATERIAL, TRUTH, INK)[i % 4], ("-", "--", ":", "-.")[i % 4]
        axes[0].plot(curves["time_s"], curves["force_N"], color=color, ls=ls, label=row.site)
        axes[1].plot(curves["displacement_mm"], curves["force_N"], color=color, ls=ls)
    for ax, label in zip(axes, ("Time (s)", "Displacement (mm)"), strict=True):
        ax.set(xlabel=label, ylabel="Force (N)")
    plots.add_legend(drawing, axes[0])
    return plots.make_figure(drawing, "simulated", rows=[row for row, _ in pairs])


@plots.styled
def draw_convergence_figure(store: Results) -> Figure | None:
    """The error and the parameters over the accepted iterates, stage after stage."""
    stages = [stage for stage in store.stages if stage.iterations]
    if not stages:
        return None
    drawing, axes = plots.make_panels(1 + len(store.law.keys), 5, 2.3)
    offset = 0
    for stage in stages:
        _draw_stage(axes, store, stage, offset)
        offset += len(stage.iterations)
    axes[0].set_title("Error (%)")
    axes[0].set_yscale("log")
    plots.format_log_axis(axes[0].yaxis, minor=True)
    for ax, name in zip(axes[1:], store.law.keys, strict=True):
        ax.set_title(f"{format_symbol(name)} ({format_unit(name)})")
        for i, (tissue, values) in enumerate(store.truth.get("parameters", {}).items()):
            if name in values:
                ax.axhline(values[name], lw=1, label=f"truth, {tissue}", **plots.choose_truth_style(i))
    for ax in axes:
        ax.set_xlabel("Iterate")
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    count = sum(len(ax.get_legend_handles_labels()[0]) for ax in axes[:2])
    plots.add_legend(drawing, *axes[:2], columns=math.ceil(count / math.ceil(count / MAX_LEGEND_ROW)))
    error = stages[-1].iterations[-1].error_percent
    return plots.make_figure(drawing, "convergence", error=error)


def _draw_stage(axes: Sequence[Axes], store: Results, stage: SearchStage, offset: int) -> None:
    """Draw one stage from iteration ``offset`` on."""
    steps = stage.iterations
    x = offset + np.arange(len(steps))
    for site in sorted(steps[0].error_percent_by_site):
        axes[0].plot(x, [step.error_percent_by_site[site] for step in steps], color=MUTED, lw=0.8)
    mean = [step.error_percent for step in steps]
    axes[0].plot(x, mean, color=INK, marker="o", ms=3, label="mean error" if offset == 0 else None)
    for ax, name in zip(axes[1:], store.law.keys, strict=True):
        for i, tissue in enumerate(stage.parameters):
            values = [step.parameters[tissue][name] for step in steps]
            ax.plot(x, values, ms=3, label=tissue if offset == 0 else None, **plots.choose_tissue_style(i))
    if offset:
        for ax in axes:
            ax.axvline(offset - 0.5, color=MUTED, lw=0.8)


@plots.styled
def draw_error_figure(store: Results) -> Figure | None:
    """The error of every site as a bar, fitted and held-out told apart by colour and hatching."""
    rows = [(row, row.error_percent) for row in store.predicted if row.error_percent is not None]
    if not rows:
        return None
    drawing, (ax,) = plots.make_panels(1, 1, 0.7 + 0.24 * len(rows))
    for at, (row, error) in enumerate(rows):
        color, hatch = (FITTED, None) if row.fitted else (HELD_OUT, "///")
        ax.barh(at, error, color=color, alpha=0.75, hatch=hatch, height=0.62)
        ax.text(error, at, f" {format_fixed(error)}", va="center", fontsize=8)
    plots.set_rows(ax, [f"{row.record} ({'fitted' if row.fitted else 'held out'})" for row, _ in rows])
    ax.set_xlabel(f"Mean absolute error over largest {store.compared_quantity} (%)")
    shown = [row for row, _ in rows]
    return plots.make_figure(drawing, "errors", rows=shown, compared=store.compared_quantity)


@plots.styled
def draw_interval_figure(store: Results) -> Figure | None:
    """Start, one-material value, interval and truth of every parameter, as a ratio to the identified one."""
    if not store.stages:
        return None
    last, names = store.stages[-1].parameters, store.parameters
    drawing, (ax,) = plots.make_panels(1, 1, 0.7 + 0.3 * len(names))
    for at, (tissue, name) in enumerate(names):
        _draw_ratios(ax, store, at, tissue, name)
    plots.set_rows(ax, [f"{t} {format_with_value(n, last[t][n])}" for t, n in names])
    plots.set_log_scale(ax, minor=True)
    ax.set_xlabel("Ratio to the identified value (–)")
    ax.axvline(1, color=MUTED, lw=0.8)
    plots.add_legend(drawing, ax)
    return plots.make_figure(drawing, "intervals")


def _draw_ratios(ax: Axes, store: Results, at: int, tissue: str, name: str) -> None:
    stages = store.stages
    value = stages[-1].parameters[tissue][name]
    if limits := store.interval(tissue, name):
        low, high = max(limits[0] / value, 1e-3), min(limits[1] / value, 1e3)
        label = "" if at else "95 % interval"
        ax.plot([low, high], [at, at], color=SIMULATED, lw=6, alpha=0.35, solid_capstyle="butt", label=label)
    one = stages[0].parameters if len(stages) > 1 else {}
    marks = (
        ("identified", stages[-1].parameters, "o", SIMULATED, SIMULATED),
        ("start", stages[0].start, "|", MUTED, MUTED),
        ("one material", one, "D", ONE_MATERIAL, "none"),
        ("truth", store.truth.get("parameters", {}), "x", TRUTH, TRUTH),
    )
    for name_of_mark, tissues, marker, color, face in marks:
        if mark := tissues.get(tissue, {}).get(name):
            label = "" if at else name_of_mark
            ax.plot(mark / value, at, marker, color=color, ms=7, mew=1.8, mfc=face, label=label)


def draw_seen_figures(store: Results, fitted: bool) -> tuple[Figure | None, ...]:
    """What was seen beside the force at the fitted or held-out sites, where it was: layers, waves, skin."""
    layers = _draw_times(store, fitted, "ultrasound", "layers", "compression", "mm")
    waves = _draw_times(store, fitted, "shear waves", "waves", "speed", "m_s")
    return layers, waves, _draw_skin(store, fitted)


@plots.styled
def _draw_times(store: Results, fitted: bool, kind: str, stem: str, what: str, unit: str) -> Figure | None:
    """What was seen of a kind against time; ``what`` it is and its unit are in the heads of the curves."""
    rows = _read_curves(store, fitted, kind)
    if not rows:
        return None
    drawing, axes = plots.make_panels(len(rows), 3, 2.1)
    plots.label_outer(axes, 3, "Time (s)", f"{what.capitalize()} ({unit.replace('_', '/')})")
    for ax, (row, layer, whole) in zip(axes, rows, strict=True):
        curves = thin_curves(whole)
        x = curves["time_s"]
        ax.plot(x, curves[f"{what}_measured_{unit}"], ".", ms=4, color=MEASURED, label="measured")
        if f"{what}_simulated_{unit}" in curves:
            ax.plot(x, curves[f"{what}_simulated_{unit}"], color=SIMULATED, label=store.materials)
        if f"{what}_low_{unit}" in curves:
            plots.plot_band(ax, x, curves[f"{what}_low_{unit}"], curves[f"{what}_high_{unit}"])
        ax.set_title(f"{row.record}, {layer.what}: {format_fixed(layer.error_percent)} %")
    plots.add_legend(drawing, axes[0])
    use = "fitted" if fitted else "held-out"
    records = ", ".join(f"{row.record} {layer.what}" for row, layer, _ in rows)
    return plots.make_figure(drawing, f"{stem}-{use}", words=stem, use=use, records=records)


@plots.styled
def _draw_skin(store: Results, fitted: bool) -> Figure | None:
    """Predicted against measured displacement of the skin."""
    rows = [one for one in _read_curves(store, fitted, "surface") if "displacement_simulated_mm" in one[2]]
    if not rows:
        return None
    drawing, axes = plots.make_panels(len(rows), 3, 2.6)
    plots.label_outer(axes, 3, "Measured (mm)", "Predicted (mm)")
    for ax, (row, seen, curves) in zip(axes, rows, strict=True):
        _draw_pairs(ax, curves, seen.components)
        ax.set_title(f"{row.record}: {format_fixed(seen.error_percent)} %")
    plots.add_legend(drawing, axes[0])
    use = "fitted" if fitted else "held-out"
    records = ", ".join(row.record for row, _, _ in rows)
    return plots.make_figure(drawing, f"surface-{use}", words="surface", use=use, records=records)


def _draw_pairs(ax: Axes, curves: Curves, components: Sequence[str]) -> None:
    x, y = curves["displacement_measured_mm"], curves["displacement_simulated_mm"]
    ends = [min(x.min(), y.min()), max(x.max(), y.max())]
    ax.plot(ends, ends, color=MEASURED, lw=0.8)
    if "displacement_low_mm" in curves:
        low, high = curves["displacement_low_mm"], curves["displacement_high_mm"]
        ax.vlines(x, low, high, color=SIMULATED, alpha=0.15, lw=0.8)
    for number, word in enumerate(components):
        chosen = curves["component"] == number
        style = plots.choose_tissue_style(number) | {"ls": "", "ms": 2.5}
        if chosen.any():
            ax.plot(x[chosen], y[chosen], **style, label=word)


def _read_curves(store: Results, fitted: bool, kind: str) -> list[Seen]:
    """Rows of records, what was seen beside each in one way, and its stored curves."""
    return [
        (row, one, curves)
        for row in store.predicted
        if row.fitted == fitted
        for one in row.observed
        if one.kind == kind and (curves := store.curves("predict", one.name)) is not None
    ]
