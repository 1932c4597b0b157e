"""Regions with models of their own: the paper's table 3."""

from __future__ import annotations

from matplotlib.axes import Axes

from ...results.uncertainty import RegionFitted, RegionsResult
from ..drawing.colours import HELD_OUT, SIMULATED, choose_tissue_style
from ..drawing.plots import add_legend, make_figure, make_panels, set_log_scale, styled
from ..formats import format_fixed, format_limits, format_with_unit, number
from ..page import Cell, Figure, Prose, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import make_row, make_table, to_numeric
from .parameters import make_parameter_columns, make_value_column

MAX_FACTOR = 1e3  # of an interval over its value, in the figure


def make_regions_section(store: Results, content: RegionsResult) -> Section:
    """What the experiment ``regions`` found."""
    every = content.sites_used == "all"
    used = (
        "Every recorded site of a region was fitted, as the paper's table 3 lists them; the whole limb's "
        f"model was identified at {', '.join(content.whole.fitted_sites)} only, so that the comparison "
        "favours the regions: their errors are those of a fit, the other ones mostly of a prediction."
        if every
        else "Each region was fitted on those of its sites that the study fits; its others are predicted."
    )
    words = Prose(
        f"Parameters of each region, started from those of the whole limb. {used} Mean error over the sites: "
        f"{format_fixed(content.mean_own_error_percent)} % with each region's own parameters, "
        f"{format_fixed(content.mean_whole_error_percent)} % with those of the whole limb. "
        f"{_count_determined(content)}"
    )
    return make_section(
        "regions",
        "Regions",
        words,
        make_bullets(f"Left out: {text}." for text in content.left_out),
        _make_parameter_table(store, content),
        _make_error_table(content),
        _draw_figure(store, content),
    )


def _count_determined(content: RegionsResult) -> str:
    """How much the records of single regions leave open."""
    verdicts = [word for row in content.regions for word in row.verdict.values()]
    known = sum(word == "determined" for word in verdicts)
    return (
        f"Of the {len(verdicts)} parameters of all regions the records determine {known}; two regions differ "
        "in a parameter only where their intervals do not overlap."
    )


def _make_parameter_table(store: Results, content: RegionsResult) -> Table:
    whole = content.whole
    columns = (
        *make_parameter_columns(store),
        make_value_column("Start", whole.start),
        make_value_column("Whole limb", whole.parameters),
        *((_name_region(row), lambda key, row=row: _format_value(row, *key)) for row in content.regions),
    )
    caption = (
        "Table 3. Parameters of each region beside those of the whole limb, with 95 % intervals in brackets. "
        "In the heads: the region's sites, those that it was fitted on marked by *. Intervals surround what "
        "was found."
    )
    rows = [(tissue, name) for tissue in whole.parameters for name in store.law.keys]
    return make_table("regions", caption, columns, rows)


def _name_region(row: RegionFitted) -> str:
    sites = ", ".join(f"{site}*" if site in row.fitted_sites else site for site in row.sites)
    return f"{row.region} ({sites})"


def _format_value(row: RegionFitted, tissue: str, name: str) -> Cell:
    value, interval = row.parameters[tissue][name], row.intervals_95[tissue][name]
    return to_numeric(f"{number(value)} ({format_limits(interval)})")


def _make_error_table(content: RegionsResult) -> Table:
    columns = (
        ("Region", "region"),
        ("Site", "site"),
        ("Use", lambda row: "fitted" if row["fitted"] else "held out"),
        ("Error, region's own model (%)", "own", 2),
        ("Error, whole limb's model (%)", "whole", 2),
    )
    rows, foot = [], []
    for region in content.regions:
        whole, sites = region.whole_error_percent_by_site, region.sites
        for site, own in region.own_error_percent_by_site.items():
            row = {"region": region.region, "site": site, "own": own, "whole": whole[site]}
            rows.append(row | {"fitted": site in region.fitted_sites})
        errors = region.own_error_percent, region.whole_error_percent
        means = (to_numeric(format_fixed(error, 2)) for error in errors)
        number_of_sites = f"{len(sites)} site{'s' if len(sites) > 1 else ''}"
        end = "" if region.converged else "not converged"
        foot.append(make_row(f"Mean, {region.region}", number_of_sites, end, *means))
    caption = "Errors of the models of the regions and of the whole limb."
    return make_table("region-errors", caption, columns, rows, marked="fitted", foot=foot)


@styled
def _draw_figure(store: Results, content: RegionsResult) -> Figure:
    """Errors by region as bars; each parameter by region with its interval, against the whole limb's."""
    regions, count = content.regions, 1 + len(store.law.keys)
    names = [row.region for row in regions]
    drawing, axes = make_panels(count, count, 0.9 + 0.34 * len(regions))
    for at, row in enumerate(regions):
        for shift, error, color, label in (
            (-0.18, row.own_error_percent, SIMULATED, "region's own model"),
            (0.18, row.whole_error_percent, HELD_OUT, "whole limb's model"),
        ):
            named = None if at else label
            axes[0].barh(at + shift, error or 0.0, 0.34, color=color, alpha=0.75, label=named)
    axes[0].set_title("Error (%)")
    axes[0].set_yticks(range(len(names)), names)
    for ax, name in zip(axes[1:], store.law.keys, strict=True):
        _draw_parameter(ax, content, name)
    for ax in axes:
        ax.set_ylim(len(regions) - 0.5, -0.5)
        ax.grid(visible=False, axis="y")
    add_legend(drawing, *axes[:2])
    caption = (
        "Regions: mean error with each region's own model and with the whole limb's, and each parameter with "
        "its 95 % interval. Vertical lines: the whole limb's parameters."
    )
    alt = "Error and parameters of each region; the numbers are in table 3"
    return make_figure(drawing, "regions", alt, caption)


def _draw_parameter(ax: Axes, content: RegionsResult, name: str) -> None:
    tissues = list(content.whole.parameters)
    for i, tissue in enumerate(tissues):
        style = choose_tissue_style(i)
        ax.axvline(content.whole.parameters[tissue][name], color=style["color"], ls=style["ls"], lw=0.9)
        for at, row in enumerate(content.regions):
            value, limits = row.parameters[tissue][name], row.intervals_95[tissue][name]
            y = at + 0.3 * (i - (len(tissues) - 1) / 2)
            low, high = max(limits[0], value / MAX_FACTOR), min(limits[1], value * MAX_FACTOR)
            ax.plot([low, high], [y, y], color=style["color"], lw=4, alpha=0.3, solid_capstyle="butt")
            label = tissue if at == 0 else None
            ax.plot(value, y, ls="", marker=style["marker"], color=style["color"], ms=5, label=label)
    set_log_scale(ax)
    ax.set_title(format_with_unit(name))
    ax.set_yticks([])
