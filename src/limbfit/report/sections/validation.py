"""Cross-validation: other choices of sites, and regions left out."""

from __future__ import annotations

import matplotlib
import numpy as np

from ..drawing.ink import HELD_OUT, INK, MUTED, ONE_MATERIAL, SIMULATED, STYLE, legend_above, panels, svg
from ..formats import fixed, heading, numeric
from ..page import Block, Cell, Figure, Prose, Row, Section, Table
from ..store import Json, Results
from ..tables import NOTHING


def validation_section(store: Results, content: Json) -> Section:
    """What the experiment ``crossvalidate`` found."""
    blocks: list[Block] = [Prose(_words(content)), _figure(content), _site_table(content)]
    if content["regions"]:
        blocks.append(_region_table(content))
    if content["emulator"]["checks"]:
        blocks.append(_check_table(content))
    return Section("crossvalidate", "Cross-validation", tuple(blocks))


def _words(content: Json) -> str:
    own, all_ = content["own"], content["choices"] == content["choices_possible"]
    drawn = "Every choice" if all_ else f"{content['choices']} of the {content['choices_possible']} choices"
    limits = ""
    if content["at_limit_share"] > 0:
        limits = (
            f" {100 * content['at_limit_share']:.0f} % of the fits ended at the edge of the region that the "
            "emulator knows: there a choice leaves parameters open, and its error is at least this."
        )
    return (
        f"{drawn} of {content['fitted_sites']} sites was fitted, and the sites left were predicted. The mean "
        f"held-out error is {fixed(own['median_percent'])} % in the middle, "
        f"{fixed(own['low_percent'])} to {fixed(own['high_percent'])} % for nine choices in ten. The study's "
        f"own choice ({', '.join(own['fitted'])}) has {fixed(own['mean_error_heldout_percent'])} %; "
        f"{100 * own['share_better']:.0f} % of the choices do better. The fits run on an emulator of "
        f"{content['emulator']['runs']} simulations of all sites, which misses the solver by "
        f"{fixed(content['emulator']['loo_percent'], 2)} % of the largest force (median, each left out)."
        f"{limits}"
    )


def _figure(content: Json) -> Figure:
    own = content["own"]
    means = np.array([fold["mean_error_heldout_percent"] for fold in content["folds"]])
    sites = [row["site"] for row in content["sites"]]
    drawing, axes = panels(2, 2, 2.8)
    with matplotlib.rc_context(STYLE):
        ax = axes[0]
        ax.hist(means, bins=min(24, max(5, len(means) // 3)), color=SIMULATED, alpha=0.6, label="choices")
        ax.axvline(own["mean_error_heldout_percent"], color=ONE_MATERIAL, lw=2, label="the study's choice")
        ax.axvline(own["median_percent"], color=INK, lw=1, ls="--", label="middle")
        ax.set_xlabel("Mean held-out error (%)")
        ax.set_ylabel("Choices of sites")
        ax = axes[1]
        for at, site in enumerate(sites):
            errors = [f["errors_percent"][site] for f in content["folds"] if site not in f["fitted"]]
            if errors:
                low, middle, high = np.percentile(errors, [5, 50, 95])
                ax.plot([at, at], [low, high], color=HELD_OUT, lw=5, alpha=0.35, solid_capstyle="butt")
                ax.plot(at, middle, "o", color=HELD_OUT, ms=4)
            ax.plot(at, own["errors_percent"][site], "x", color=MUTED, ms=6, mew=1.6)
        ax.set_xticks(range(len(sites)), sites, rotation=90 if len(sites) > 8 else 0)
        ax.set_ylim(bottom=0)
        ax.set_xlabel("Site")
        ax.set_ylabel("Error when not fitted (%)")
        ax.grid(visible=False, axis="x")
        legend_above(drawing, axes[0])
    caption = (
        "Left: mean error at the sites that a choice does not fit, over the choices. Right: the error of "
        "each site over the choices that leave it out (dot: middle; bar: nine in ten), "
        "and by the study's own "
        "choice (cross)."
    )
    alt = f"Mean held-out error over {len(means)} choices of sites, and errors of each site"
    return Figure("crossvalidate", svg(drawing, "crossvalidate", alt), caption)


def _site_table(content: Json) -> Table:
    rows = tuple(
        Row(
            (
                heading(str(row["site"])),
                Cell(str(row["region"] or NOTHING)),
                numeric(str(row["left_out_of"])),
                numeric(_spread(row)),
                numeric(fixed(row["own_percent"], 2)),
            ),
            marked=bool(row["fitted"]),
        )
        for row in content["sites"]
    )
    head = ("Site", "Region", "Choices without it", "Error without it (%)", "Error, the study's choice (%)")
    caption = (
        "Errors of each site over the choices that do not fit it, mean ± standard deviation. Marked: the "
        "sites that the study fits."
    )
    return Table("crossvalidate-sites", caption, head, rows)


def _spread(row: Json) -> str:
    if row["mean_percent"] is None:
        return NOTHING
    sd = "" if row["sd_percent"] is None else f" ± {fixed(row['sd_percent'], 2)}"
    return f"{fixed(row['mean_percent'], 2)}{sd}"


def _region_table(content: Json) -> Table:
    rows = []
    for fold in content["regions"]:
        held = [site for site in fold["errors_percent"] if site not in fold["fitted"]]
        errors = ", ".join(f"{site}: {fixed(fold['errors_percent'][site])}" for site in held)
        rows.append(
            Row(
                (
                    heading(str(fold["label"])),
                    Cell(errors),
                    numeric(fixed(fold["mean_error_heldout_percent"], 2)),
                    numeric(fixed(fold["mean_error_fitted_percent"], 2)),
                )
            )
        )
    head = ("Region left out", "Errors of its sites (%)", "Mean (%)", "Mean of the fitted sites (%)")
    caption = "Each region predicted by a model that was fitted on all sites of the other regions."
    return Table("crossvalidate-regions", caption, head, tuple(rows))


def _check_table(content: Json) -> Table:
    rows = tuple(
        Row(
            (
                heading(", ".join(row["fitted"])),
                numeric(str(row["round"])),
                numeric(fixed(row["heldout_emulated_percent"], 2)),
                numeric(fixed(row["heldout_solved_percent"], 2)),
                numeric(fixed(row["emulator_error_percent"], 2)),
            )
        )
        for row in content["emulator"]["checks"]
    )
    head = (
        "Fitted sites",
        "Round",
        "Held-out error, emulator (%)",
        "Held-out error, solver (%)",
        "Emulator against solver (%)",
    )
    caption = (
        "The emulator against the solver at the optima of some fits: it has not seen them, and learns from "
        "those of the first round before the second."
    )
    return Table("crossvalidate-checks", caption, head, rows)
