"""Regions with models of their own: the paper's table 3."""

from __future__ import annotations

import matplotlib
from matplotlib.axes import Axes

from ..drawing.ink import HELD_OUT, INK, SIMULATED, STYLE, panels, svg, tissue_style
from ..formats import fixed, heading, number, numeric, symbol, unit_of
from ..page import Bullets, Cell, Figure, Prose, Row, Section, Table
from ..store import Json, Results
from ..tables import parameter_words, tissue_name

WIDEST = 1e3  # of an interval over its value, in the figure


def regions_section(store: Results, content: Json) -> Section:
    """What the experiment ``regions`` found."""
    every = content["sites_used"] == "all"
    used = (
        "Every recorded site of a region was fitted, as the paper's table 3 lists them; the whole limb's "
        "model "
        f"was identified at {', '.join(content['whole']['fitted_sites'])} only, so that the comparison "
        "favours "
        "the regions: their errors are those of a fit, the other ones mostly of a prediction."
        if every
        else "Each region was fitted on those of its sites that the study fits; its others are predicted."
    )
    words = Prose(
        f"Parameters of each region, started from those of the whole limb. {used} Mean error over the sites: "
        f"{fixed(content['mean_own_error_percent'])} % with each region's own parameters, "
        f"{fixed(content['mean_whole_error_percent'])} % with those of the whole limb. {_open(content)}"
    )
    omitted = tuple(f"Left out: {text}." for text in content["left_out"])
    notes = (Bullets(omitted),) if omitted else ()
    blocks = (words, *notes, _parameter_table(store, content), _error_table(content), _figure(store, content))
    return Section("regions", "Regions", blocks)


def _open(content: Json) -> str:
    """How much the records of single regions leave open."""
    verdicts = [word for row in content["regions"] for word in row["verdict"].values()]
    known = sum(str(word) == "determined" for word in verdicts)
    return (
        f"Of the {len(verdicts)} parameters of all regions the records determine {known}; two regions "
        "differ in "
        "a parameter only where their intervals do not overlap."
    )


def _parameter_table(store: Results, content: Json) -> Table:
    regions = content["regions"]
    head = ("Tissue", "Parameter", "Unit", "Start", "Whole limb", *(_head(row) for row in regions))
    rows = tuple(
        Row(
            (
                heading(tissue_name(store, tissue)),
                Cell(parameter_words(store, name)),
                Cell(unit_of(name)),
                numeric(number(content["whole"]["start"][tissue][name])),
                numeric(number(content["whole"]["parameters"][tissue][name])),
                *(numeric(_with_limits(row, tissue, name)) for row in regions),
            )
        )
        for tissue in content["whole"]["parameters"]
        for name in store.law.keys
    )
    caption = (
        "Table 3. Parameters of each region beside those of the whole limb, with 95 % intervals in brackets. "
        "In the heads: the region's sites, those that it was fitted on marked by *. Intervals surround what "
        "was found."
    )
    return Table("regions", caption, head, rows)


def _head(row: Json) -> str:
    sites = ", ".join(f"{site}*" if site in row["fitted_sites"] else site for site in row["sites"])
    return f"{row['region']} ({sites})"


def _with_limits(row: Json, tissue: str, name: str) -> str:
    value, limits = row["parameters"][tissue][name], row["intervals_95"][tissue][name]
    if None in limits:
        return f"{number(value)} (open)"
    return f"{number(value)} ({number(limits[0])} to {number(limits[1])})"


def _error_table(content: Json) -> Table:
    head = ("Region", "Site", "Use", "Error, region's own model (%)", "Error, whole limb's model (%)")
    rows = tuple(
        Row(
            (
                heading(row["region"]),
                Cell(site),
                Cell("fitted" if site in row["fitted_sites"] else "held out"),
                numeric(fixed(own, 2)),
                numeric(fixed(row["whole_error_percent_by_site"][site], 2)),
            ),
            marked=site in row["fitted_sites"],
        )
        for row in content["regions"]
        for site, own in row["own_error_percent_by_site"].items()
    )
    foot = tuple(
        Row(
            (
                heading(f"Mean, {row['region']}"),
                Cell(f"{len(row['sites'])} site{'s' if len(row['sites']) > 1 else ''}"),
                Cell("" if row["converged"] else "not converged"),
                numeric(fixed(row["own_error_percent"], 2)),
                numeric(fixed(row["whole_error_percent"], 2)),
            )
        )
        for row in content["regions"]
    )
    return Table(
        "region-errors", "Errors of the models of the regions and of the whole limb.", head, rows, foot
    )


def _figure(store: Results, content: Json) -> Figure:
    """Errors by region as bars; each parameter by region with its interval, against the whole limb's."""
    regions, count = content["regions"], 1 + len(store.law.keys)
    names = [row["region"] for row in regions]
    drawing, axes = panels(count, count, 0.9 + 0.34 * len(regions))
    with matplotlib.rc_context(STYLE):
        for at, row in enumerate(regions):
            for shift, key, color, label in (
                (-0.18, "own_error_percent", SIMULATED, "region's own model"),
                (0.18, "whole_error_percent", HELD_OUT, "whole limb's model"),
            ):
                named = None if at else label
                axes[0].barh(at + shift, row[key] or 0.0, 0.34, color=color, alpha=0.75, label=named)
        axes[0].set_title("Error (%)")
        axes[0].set_yticks(range(len(names)), names)
        for ax, name in zip(axes[1:], store.law.keys, strict=True):
            _draw_parameter(ax, content, name)
        for ax in axes:
            ax.set_ylim(len(regions) - 0.5, -0.5)
            ax.grid(visible=False, axis="y")
        handles = [*axes[0].get_legend_handles_labels()[0], *axes[1].get_legend_handles_labels()[0]]
        labels = [str(handle.get_label()) for handle in handles]
        drawing.legend(handles, labels, loc="outside upper left", ncols=len(labels), labelcolor=INK)
    caption = (
        "Regions: mean error with each region's own model and with the whole limb's, and each parameter "
        "with its "
        "95 % interval. Vertical lines: the whole limb's parameters."
    )
    alt = "Error and parameters of each region; the numbers are in table 3"
    return Figure("regions", svg(drawing, "regions", alt), caption)


def _draw_parameter(ax: Axes, content: Json, name: str) -> None:
    tissues = list(content["whole"]["parameters"])
    for i, tissue in enumerate(tissues):
        style = tissue_style(i)
        ax.axvline(content["whole"]["parameters"][tissue][name], color=style["color"], ls=style["ls"], lw=0.9)
        for at, row in enumerate(content["regions"]):
            value, limits = row["parameters"][tissue][name], row["intervals_95"][tissue][name]
            y = at + 0.3 * (i - (len(tissues) - 1) / 2)
            if None not in limits:
                low, high = max(limits[0], value / WIDEST), min(limits[1], value * WIDEST)
                ax.plot([low, high], [y, y], color=style["color"], lw=4, alpha=0.3, solid_capstyle="butt")
            label = tissue if at == 0 else None
            ax.plot(value, y, ls="", marker=style["marker"], color=style["color"], ms=5, label=label)
    ax.set_xscale("log")
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.xaxis.set_minor_formatter(lambda value, _: "")
    unit = unit_of(name)
    ax.set_title(f"{symbol(name)} ({unit})" if unit != "–" else symbol(name))
    ax.set_yticks([])
