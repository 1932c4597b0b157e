"""Fits to other choices of sites: cross-validation, and regions with models of their own (table 3)."""

import numpy as np
from matplotlib.axes import Axes

from ...results.uncertainty import CrossvalidateResult, RegionFitted, RegionsResult
from ..drawing.colours import HELD_OUT, INK, MUTED, ONE_MATERIAL, SIMULATED, choose_tissue_style
from ..drawing.plots import add_legend, make_figure, make_panels, set_log_scale, styled
from ..formats import format_fixed, format_with_unit
from ..page import Figure, Section, Table, make_bullets
from ..store import Results
from ..words import make_prose, make_row, make_section, make_table, to_numeric

MAX_FACTOR = 1e3  # of an interval over its value, in the figure


def make_crossvalidation_section(store: Results, content: CrossvalidateResult) -> Section:
    """What the experiment ``crossvalidate`` found."""
    return make_section(
        "crossvalidate",
        make_prose("crossvalidate", content=content),
        _draw_errors(content),
        make_table("crossvalidate-sites", content.sites, marked="fitted"),
        make_table("crossvalidate-regions", content.regions),
        make_table("crossvalidate-checks", content.emulator.checks),
    )


@styled
def _draw_errors(content: CrossvalidateResult) -> Figure:
    own = content.own
    means = np.array([fold.mean_error_heldout_percent for fold in content.folds])
    sites = [row.site for row in content.sites]
    drawing, axes = make_panels(2, 2, 2.8)
    ax = axes[0]
    ax.hist(means, bins=min(24, max(5, len(means) // 3)), color=SIMULATED, alpha=0.6, label="choices")
    if own.mean_error_heldout_percent is not None:
        ax.axvline(own.mean_error_heldout_percent, color=ONE_MATERIAL, lw=2, label="the study's choice")
    ax.axvline(own.median_percent, color=INK, lw=1, ls="--", label="middle")
    ax.set_xlabel("Mean held-out error (%)")
    ax.set_ylabel("Choices of sites")
    ax = axes[1]
    for at, site in enumerate(sites):
        errors = [f.errors_percent[site] for f in content.folds if site not in f.fitted]
        if errors:
            low, middle, high = np.percentile(errors, [5, 50, 95])
            ax.plot([at, at], [low, high], color=HELD_OUT, lw=5, alpha=0.35, solid_capstyle="butt")
            ax.plot(at, middle, "o", color=HELD_OUT, ms=4)
        ax.plot(at, own.errors_percent[site], "x", color=MUTED, ms=6, mew=1.6)
    ax.set_xticks(range(len(sites)), sites, rotation=90 if len(sites) > 8 else 0)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("Site")
    ax.set_ylabel("Error when not fitted (%)")
    ax.grid(visible=False, axis="x")
    add_legend(drawing, axes[0])
    return make_figure(drawing, "crossvalidate", content=content)


def make_regions_section(store: Results, content: RegionsResult) -> Section:
    """What the experiment ``regions`` found."""
    verdicts = [word for row in content.regions for word in row.verdict.values()]
    parameters = [(tissue, key) for tissue in content.whole.parameters for key in store.law.keys]
    return make_section(
        "regions",
        make_prose("regions", content=content, verdicts=verdicts),
        make_bullets(f"Left out: {text}." for text in content.left_out),
        make_table("regions", parameters, store=store, content=content),
        make_error_table(store, content),
        _draw_regions(store, content),
    )


def make_error_table(store: Results, content: RegionsResult) -> Table | None:
    """The errors of each region's records with its own model and with the whole limb's."""

    def is_fitted(row: tuple[RegionFitted, str]) -> bool:
        region, record = row
        facts = store.traces.get(record)
        return (facts.site if facts else record) in region.fitted_sites

    rows = [(region, record) for region in content.regions for record in region.own_error_percent_by_site]
    foot = []
    for region in content.regions:
        errors = region.own_error_percent, region.whole_error_percent
        means = (to_numeric(format_fixed(error, 2)) for error in errors)
        number_of_sites = f"{len(region.sites)} site{'s' if len(region.sites) > 1 else ''}"
        end = "" if region.converged else "not converged"
        foot.append(make_row(f"Mean, {region.region}", number_of_sites, end, *means))
    return make_table("region-errors", rows, marked=is_fitted, foot=foot, is_fitted=is_fitted)


@styled
def _draw_regions(store: Results, content: RegionsResult) -> Figure:
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
    return make_figure(drawing, "regions")


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
