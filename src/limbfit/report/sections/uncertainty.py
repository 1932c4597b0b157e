"""What the records determine: intervals, sources, other models, other choices of sites, regions (table 3)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from ...results import uncertainty as stored
from ..drawing import plots
from ..drawing.colours import HELD_OUT, INK, MUTED, ONE_MATERIAL, SIMULATED
from ..drawing.figures import draw_forces
from ..formats import format_fixed, format_parameter, format_with_unit
from ..page import Bullets, Figure, Note, Prose, Section, Table, make_bullets
from ..store import Curves, Results, find_compared_quantity
from ..words import make_prose, make_section, make_table, write_words

TrueValues = dict[str, tuple[float, dict[str, Any]]]  # by name: a true parameter and its line
MAX_DRAWS, MAX_SITES, MAX_PANELS = 300, 18, 4
MAX_FACTOR = 1e3  # of an interval over its value, in the figure


def make_uncertainty_section(store: Results, content: stored.UncertaintyResult) -> Section:
    """What the experiment ``uncertainty`` found."""
    found, evidence = content.predictions, content.evidence
    models = (evidence.first, evidence.second) if evidence else ()
    emulator = write_words("emulator", emulator=content.emulator, chain=content.posterior)
    return make_section(
        "uncertainty",
        Bullets(tuple(content.verdict)),
        make_prose("uncertainty", residuals=content.residuals),
        make_table("uncertainty-parameters", content.parameters),
        make_table("uncertainty-combinations", content.combinations, headed=False),
        draw_profile_figure(store, content),
        draw_pairs_figure(store, content),
        make_table(
            "evidence", models, marked=lambda row: evidence and row.name == evidence.better, found=evidence
        ),
        make_table("uncertainty-sources", content.sources),
        draw_prediction_figure(store, content),
        make_table("uncertainty-predictions", found.sites, marked="fitted", found=found),
        Prose(emulator) if content.emulator.good_enough else Note(emulator),
    )


@plots.styled
def draw_profile_figure(store: Results, content: stored.UncertaintyResult) -> Figure | None:
    """How much worse the records are met as one parameter moves and the others follow."""
    profiles = content.profiles
    if not profiles:
        return None
    truth = read_true_values(store)
    drawing, axes = plots.make_panels(len(profiles), 4, 1.9)
    plots.label_outer(axes, 4, "", "Rise of −2 ln L")
    for ax, (name, one) in zip(axes, profiles.items(), strict=True):
        _draw_profile(ax, one)
        ax.axhline(one.threshold, color=MUTED, ls=":", lw=1.2, label="95 %")
        ax.axvspan(*one.interval_95, color=SIMULATED, alpha=0.12, lw=0)
        if name in truth:
            ax.axvline(truth[name][0], **truth[name][1], label="truth")
        ax.set_ylim(0, 2.5 * one.threshold)
        plots.set_log_scale(ax)
        ax.set_title(f"{format_parameter(name)}: {one.verdict}", fontsize=7.5)
    plots.add_legend(drawing, axes[0])
    return plots.make_figure(drawing, "profiles", profiles=profiles, checks=content.checks)


def _draw_profile(ax: Axes, profile: stored.LikelihoodProfile) -> None:
    """A profile, dashed and with open circles where it is extrapolated."""
    values, rise = np.array(profile.values), np.array(profile.rise)
    beyond = np.array(profile.extrapolated, dtype=bool)
    # The neighbours too, so that the two lines meet.
    dashed = np.where(beyond | np.r_[beyond[1:], False] | np.r_[False, beyond[:-1]], rise, np.nan)
    ax.plot(values, np.where(beyond, np.nan, rise), color=SIMULATED, marker="o", ms=2.5, label="profile")
    ax.plot(values, dashed, color=SIMULATED, ls="--", lw=1.0, zorder=1.9, label="extrapolated")
    ax.plot(values[beyond], rise[beyond], color=SIMULATED, ls="", marker="o", ms=3.0, mfc="none")


def read_true_values(store: Results) -> TrueValues:
    """The phantom's true parameters by name, with their line; none for a patient."""
    found = store.truth.get("parameters") or {}
    return {
        f"{tissue}.{name}": (float(value), plots.choose_truth_style(i))
        for i, (tissue, values) in enumerate(found.items())
        for name, value in values.items()
    }


@plots.styled
def draw_pairs_figure(store: Results, content: stored.UncertaintyResult) -> Figure | None:
    """Draws of the posterior, every parameter against every other, in logarithms."""
    draws = store.curves("uncertainty", "draws")
    if draws is None:
        return None
    names = [row.name for row in content.parameters if np.ptp(draws[row.name]) > 0]
    n = len(names)
    drawing = Drawing(figsize=(plots.PANEL_WIDTH_IN, plots.PANEL_WIDTH_IN * 0.8), layout="constrained")
    drawing.get_layout_engine().set(w_pad=0.01, h_pad=0.01, wspace=0.02, hspace=0.02)  # type: ignore[union-attr, call-arg]
    drawing.patch.set_alpha(0)
    identified = {row.name: row.calibrated for row in content.parameters}
    for i in range(n):
        for j in range(i + 1):
            ax = drawing.add_subplot(n, n, i * n + j + 1)
            _draw_pair(ax, draws, names[i], names[j], read_true_values(store), identified)
            ax.tick_params(labelsize=5, length=2)
            _name_axis(ax.xaxis, names[j] if i == n - 1 else "", i == n - 1)
            _name_axis(ax.yaxis, names[i] if j == 0 else "", j == 0 and i > 0)
    return plots.make_figure(drawing, "posterior", names=names)


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
        axis.set_label_text(format_parameter(name), fontsize=7)


@plots.styled
def draw_prediction_figure(store: Results, content: stored.UncertaintyResult) -> Figure | None:
    """Records beside their prediction intervals, held-out sites first."""
    rows = sorted(content.predictions.sites, key=lambda row: row.fitted)[:MAX_SITES]
    pairs = store.with_curves("uncertainty/predictions", rows)
    if not pairs:
        return None
    drawing, axes = plots.make_panels(len(pairs), 3, 2.0)
    plots.label_outer(axes, 3, "Time (s)", "Force (N)")
    for ax, (row, curves) in zip(axes, pairs, strict=True):
        draw_forces(ax, curves, "time_s", "predicted", "predicted")
        ax.axhline(0, color=MUTED, lw=0.6)
        kind = "fitted" if row.fitted else "held out"
        ax.set_title(f"site {row.record}, {kind}: {format_fixed(row.inside_percent, 0)} % inside")
    plots.add_legend(drawing, axes[0])
    return plots.make_figure(drawing, "predictions", records=[row.record for row, _ in pairs])


def make_models_section(store: Results, content: stored.ModelsResult) -> Section:
    """What ``limbfit uncertainty --models`` found."""
    return make_section(
        "models",
        make_prose("models"),
        make_table("models", content.models),
        _draw_model_figure(store, content),
        make_table("models-records", content.records),
        (Note(f"Left out: {text}") for text in content.left_out.values()),
    )


@plots.styled
def _draw_model_figure(store: Results, content: stored.ModelsResult) -> Figure | None:
    rows = [row for row in content.records if not row.fitted] or content.records
    found = store.with_curves("models", rows[:MAX_PANELS])
    if not found:
        return None
    drawing, axes = plots.make_panels(len(found), min(len(found), 2), 2.8)
    for ax, (row, curves) in zip(axes, found, strict=False):
        what, unit = find_compared_quantity(curves)
        time = curves["time_s"]
        low, high = (curves[f"{what}_{end}_{unit}"] for end in ("low", "high"))
        ax.fill_between(time, low, high, color=SIMULATED, alpha=0.25, lw=0, label="95 % by all models")
        for model in content.models[1:]:
            ax.plot(time, curves[f"{what}_{model.model}_{unit}"], color=MUTED, lw=0.8)
        ax.plot(time, curves[f"{what}_own_{unit}"], color=SIMULATED, label="own model")
        ax.plot(time, curves[f"{what}_measured_{unit}"], color=INK, lw=1.0, label="measured")
        ax.set(title=f"site {row.record}", xlabel="time (s)", ylabel=f"{what} ({unit})")
        ax.set_xlim(0.0, float(np.max(time)))
    plots.add_legend(drawing, axes[0])
    return plots.make_figure(drawing, "models")


def make_crossvalidation_section(store: Results, content: stored.CrossvalidateResult) -> Section:
    """What the experiment ``crossvalidate`` found."""
    return make_section(
        "crossvalidate",
        make_prose("crossvalidate", content=content),
        _draw_errors(content),
        make_table("crossvalidate-sites", content.sites, marked="fitted"),
        make_table("crossvalidate-regions", content.regions),
        make_table("crossvalidate-checks", content.emulator.checks),
    )


@plots.styled
def _draw_errors(content: stored.CrossvalidateResult) -> Figure:
    own = content.own
    means = np.array([fold.mean_error_heldout_percent for fold in content.folds])
    sites = [row.site for row in content.sites]
    drawing, axes = plots.make_panels(2, 2, 2.8)
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
    plots.add_legend(drawing, axes[0])
    return plots.make_figure(drawing, "crossvalidate", content=content)


def make_regions_section(store: Results, content: stored.RegionsResult) -> Section:
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


def make_error_table(store: Results, content: stored.RegionsResult) -> Table | None:
    """The errors of each region's records with its own model and with the whole limb's."""

    def is_fitted(row: tuple[stored.RegionFitted, str]) -> bool:
        region, record = row
        facts = store.traces.get(record)
        return (facts.site if facts else record) in region.fitted_sites

    rows = [(region, record) for region in content.regions for record in region.own_error_percent_by_site]
    means = make_table("region-means", content.regions)
    foot = means.rows if means else ()
    return make_table("region-errors", rows, marked=is_fitted, foot=foot, is_fitted=is_fitted)


@plots.styled
def _draw_regions(store: Results, content: stored.RegionsResult) -> Figure:
    """Errors by region as bars; each parameter by region with its interval, against the whole limb's."""
    regions, count = content.regions, 1 + len(store.law.keys)
    names = [row.region for row in regions]
    drawing, axes = plots.make_panels(count, count, 0.9 + 0.34 * len(regions))
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
    plots.add_legend(drawing, *axes[:2])
    return plots.make_figure(drawing, "regions")


def _draw_parameter(ax: Axes, content: stored.RegionsResult, name: str) -> None:
    tissues = list(content.whole.parameters)
    for i, tissue in enumerate(tissues):
        style = plots.choose_tissue_style(i)
        ax.axvline(content.whole.parameters[tissue][name], color=style["color"], ls=style["ls"], lw=0.9)
        for at, row in enumerate(content.regions):
            value, limits = row.parameters[tissue][name], row.intervals_95[tissue][name]
            y = at + 0.3 * (i - (len(tissues) - 1) / 2)
            low, high = max(limits[0], value / MAX_FACTOR), min(limits[1], value * MAX_FACTOR)
            ax.plot([low, high], [y, y], color=style["color"], lw=4, alpha=0.3, solid_capstyle="butt")
            label = tissue if at == 0 else None
            ax.plot(value, y, ls="", marker=style["marker"], color=style["color"], ms=5, label=label)
    plots.set_log_scale(ax)
    ax.set_title(format_with_unit(name))
    ax.set_yticks([])
