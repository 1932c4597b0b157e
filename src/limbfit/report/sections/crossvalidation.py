"""Cross-validation: other choices of sites, and regions left out."""

from __future__ import annotations

import numpy as np

from ...results.uncertainty import CrossvalidateResult
from ..drawing.colours import HELD_OUT, INK, MUTED, ONE_MATERIAL, SIMULATED
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..page import Figure, Section, make_section
from ..store import Results
from ..tables import make_table
from ..words import make_prose


def make_crossvalidation_section(store: Results, content: CrossvalidateResult) -> Section:
    """What the experiment ``crossvalidate`` found."""
    checks = content.emulator.checks
    return make_section(
        "crossvalidate",
        "Cross-validation",
        make_prose("crossvalidate", content=content),
        _draw_figure(content),
        make_table("crossvalidate-sites", content.sites, marked="fitted"),
        make_table("crossvalidate-regions", content.regions) if content.regions else None,
        make_table("crossvalidate-checks", checks) if checks else None,
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
    return make_figure(drawing, "crossvalidate", content=content)
