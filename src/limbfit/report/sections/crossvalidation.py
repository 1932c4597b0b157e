"""Cross-validation: other choices of sites, and regions left out."""

from __future__ import annotations

import numpy as np

from ...results.uncertainty import CrossvalidateResult, FoldFit, HeldoutSite
from ..drawing.colours import HELD_OUT, INK, MUTED, ONE_MATERIAL, SIMULATED
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..formats import NOTHING, format_fixed
from ..page import Figure, Prose, Section, Table, make_section
from ..store import Results
from ..tables import make_table, to_numeric


def make_crossvalidation_section(store: Results, content: CrossvalidateResult) -> Section:
    """What the experiment ``crossvalidate`` found."""
    return make_section(
        "crossvalidate",
        "Cross-validation",
        Prose(_describe_choices(content)),
        _draw_figure(content),
        _make_site_table(content),
        _make_region_table(content) if content.regions else None,
        _make_check_table(content) if content.emulator.checks else None,
    )


def _describe_choices(content: CrossvalidateResult) -> str:
    own, all_ = content.own, content.choices == content.choices_possible
    drawn = "Every choice" if all_ else f"{content.choices} of the {content.choices_possible} choices"
    limits = ""
    if content.at_limit_share > 0:
        limits = (
            f" {100 * content.at_limit_share:.0f} % of the fits ended at the edge of the region that the "
            "emulator knows: there a choice leaves parameters open, and its error is at least this."
        )
    return (
        f"{drawn} of {content.fitted_sites} sites was fitted, and the sites left were predicted. The mean "
        f"held-out error is {format_fixed(own.median_percent)} % in the middle, "
        f"{format_fixed(own.low_percent)} to {format_fixed(own.high_percent)} % for nine "
        "choices in ten. The study's "
        f"own choice ({', '.join(own.fitted)}) has {format_fixed(own.mean_error_heldout_percent)} %; "
        f"{100 * own.share_better:.0f} % of the choices do better. The fits run on an emulator of "
        f"{content.emulator.runs} simulations of all sites, which misses the solver by "
        f"{format_fixed(content.emulator.loo_percent, 2)} % of the largest force (median, "
        "each left out)."
        f"{limits}"
    )


@styled
def _draw_figure(content: CrossvalidateResult) -> Figure:
    own = content.own
    means = np.array([fold.mean_error_heldout_percent for fold in content.folds])
    sites = [row.site for row in content.sites]
    drawing, axes = make_panels(2, 2, 2.8)
    ax = axes[0]
    ax.hist(means, bins=min(24, max(5, len(means) // 3)), color=SIMULATED, alpha=0.6, label="choices")
    assert own.mean_error_heldout_percent is not None
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
    caption = (
        "Left: mean error at the sites that a choice does not fit, over the choices. Right: the error of "
        "each site over the choices that leave it out (dot: middle; bar: nine in ten), and by the study's "
        "own choice (cross)."
    )
    alt = f"Mean held-out error over {len(means)} choices of sites, and errors of each site"
    return make_figure(drawing, "crossvalidate", alt, caption)


def _make_site_table(content: CrossvalidateResult) -> Table:
    columns = (
        ("Site", "site"),
        ("Region", "region"),
        ("Choices without it", "left_out_of", 0),
        ("Error without it (%)", lambda row: to_numeric(_format_spread(row))),
        ("Error, the study's choice (%)", "own_percent", 2),
    )
    caption = (
        "Errors of each site over the choices that do not fit it, mean ± standard deviation. Marked: the "
        "sites that the study fits."
    )
    return make_table("crossvalidate-sites", caption, columns, content.sites, marked="fitted")


def _format_spread(row: HeldoutSite) -> str:
    if row.mean_percent is None:
        return NOTHING
    sd = "" if row.sd_percent is None else f" ± {format_fixed(row.sd_percent, 2)}"
    return f"{format_fixed(row.mean_percent, 2)}{sd}"


def _make_region_table(content: CrossvalidateResult) -> Table:
    def errors(fold: FoldFit) -> str:
        held = (site for site in fold.errors_percent if site not in fold.fitted)
        return ", ".join(f"{site}: {format_fixed(fold.errors_percent[site])}" for site in held)

    columns = (
        ("Region left out", "label"),
        ("Errors of its sites (%)", errors),
        ("Mean (%)", "mean_error_heldout_percent", 2),
        ("Mean of the fitted sites (%)", "mean_error_fitted_percent", 2),
    )
    caption = "Each region predicted by a model that was fitted on all sites of the other regions."
    return make_table("crossvalidate-regions", caption, columns, content.regions)


def _make_check_table(content: CrossvalidateResult) -> Table:
    columns = (
        ("Fitted sites", lambda row: ", ".join(row.fitted)),
        ("Round", "round", 0),
        ("Held-out error, emulator (%)", "heldout_emulated_percent", 2),
        ("Held-out error, solver (%)", "heldout_solved_percent", 2),
        ("Emulator against solver (%)", "emulator_error_percent", 2),
    )
    caption = (
        "The emulator against the solver at the optima of some fits: it has not seen them, and learns from "
        "those of the first round before the second."
    )
    return make_table("crossvalidate-checks", caption, columns, content.emulator.checks)
