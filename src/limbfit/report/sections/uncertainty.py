"""What the records determine: intervals by three methods, profiles, posterior, sources, predictions."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from ...results.models import ModelsResult
from ...results.uncertainty import LikelihoodProfile, UncertaintyResult
from ..drawing import plots
from ..drawing.colours import INK, MEASURED, MUTED, SIMULATED, choose_truth_style
from ..formats import format_fixed, format_parameter
from ..page import Bullets, Figure, Note, Prose, Section, Table
from ..store import Curves, Results, find_compared_quantity
from ..words import make_prose, make_section, make_table, write_words

TrueValues = dict[str, tuple[float, dict[str, Any]]]  # by name: a true parameter and its line
MAX_DRAWS, MAX_SITES = 300, 18


def make_uncertainty_section(store: Results, content: UncertaintyResult) -> Section:
    """What the experiment ``uncertainty`` found."""
    found = content.predictions
    emulator = write_words("emulator", emulator=content.emulator, chain=content.posterior)
    return make_section(
        "uncertainty",
        Bullets(tuple(content.verdict)),
        make_prose("uncertainty", residuals=content.residuals),
        make_table("uncertainty-parameters", content.parameters),
        make_table("uncertainty-combinations", content.combinations, headed=False),
        draw_profile_figure(store, content),
        draw_pairs_figure(store, content),
        _make_evidence_table(content),
        make_table("uncertainty-sources", content.sources),
        draw_prediction_figure(store, content),
        make_table("uncertainty-predictions", found.sites, marked="fitted", found=found),
        Prose(emulator) if content.emulator.good_enough else Note(emulator),
    )


@plots.styled
def draw_profile_figure(store: Results, content: UncertaintyResult) -> Figure | None:
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


def _draw_profile(ax: Axes, profile: LikelihoodProfile) -> None:
    """A profile, dashed and with open circles where it is extrapolated."""
    values, rise = np.array(profile.values), np.array(profile.rise)
    beyond = np.array(profile.extrapolated, dtype=bool)
    # The neighbours too, so that the two lines meet.
    dashed = np.where(beyond | np.r_[beyond[1:], False] | np.r_[False, beyond[:-1]], rise, np.nan)
    ax.plot(values, np.where(beyond, np.nan, rise), color=SIMULATED, marker="o", ms=2.5, label="profile")
    ax.plot(values, dashed, color=SIMULATED, ls="--", lw=1.0, zorder=1.9, label="extrapolated")
    ax.plot(values[beyond], rise[beyond], color=SIMULATED, ls="", marker="o", ms=3.0, mfc="none")


def _make_evidence_table(content: UncertaintyResult) -> Table | None:
    """One material against several."""
    found = content.evidence
    if found is None:
        return None
    rows = (
        (found.first, found.heldout.get("first_percent")),
        (found.second, found.heldout.get("second_percent")),
    )
    return make_table("evidence", rows, marked=lambda row: row[0].name == found.better, found=found)


def read_true_values(store: Results) -> TrueValues:
    """The phantom's true parameters by name, with their line; none for a patient."""
    found = store.truth.get("parameters") or {}
    return {
        f"{tissue}.{name}": (float(value), choose_truth_style(i))
        for i, (tissue, values) in enumerate(found.items())
        for name, value in values.items()
    }


@plots.styled
def draw_pairs_figure(store: Results, content: UncertaintyResult) -> Figure | None:
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
def draw_prediction_figure(store: Results, content: UncertaintyResult) -> Figure | None:
    """Records beside their prediction intervals, held-out sites first."""
    rows = sorted(content.predictions.sites, key=lambda row: row.fitted)[:MAX_SITES]
    pairs = store.with_curves("uncertainty/predictions", rows)
    if not pairs:
        return None
    drawing, axes = plots.make_panels(len(pairs), 3, 2.0)
    plots.label_outer(axes, 3, "Time (s)", "Force (N)")
    for ax, (row, curves) in zip(axes, pairs, strict=True):
        time = curves["time_s"]
        quantity, unit = find_compared_quantity(curves)
        kinds = ("low", "high", "measured", "predicted")
        low, high, measured, predicted = (curves[f"{quantity}_{kind}_{unit}"] for kind in kinds)
        plots.plot_band(ax, time, low, high)
        ax.plot(time, measured, color=MEASURED, lw=2.2, alpha=0.55, label="measured")
        ax.plot(time, predicted, color=SIMULATED, lw=1.1, label="predicted")
        kind = "fitted" if row.fitted else "held out"
        ax.set_title(f"site {row.record}, {kind}: {format_fixed(row.inside_percent, 0)} % inside")
        ax.margins(x=0.01)
        if quantity != "force":
            ax.set_ylabel(f"{quantity.capitalize()} ({unit})")
    plots.add_legend(drawing, axes[0])
    for ax in axes:
        ax.axhline(0, color=MUTED, lw=0.6)
    return plots.make_figure(drawing, "predictions", records=[row.record for row, _ in pairs])


_MAX_PANELS = 4


def make_models_section(store: Results, content: ModelsResult) -> Section:
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
def _draw_model_figure(store: Results, content: ModelsResult) -> Figure | None:
    rows = [row for row in content.records if not row.fitted] or content.records
    found = store.with_curves("models", rows[:_MAX_PANELS])
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
