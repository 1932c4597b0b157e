"""What the records determine: intervals by three methods, profiles, posterior, sources, predictions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Drawing
from matplotlib.ticker import MaxNLocator

from ...results.base import Interval
from ...results.models import MixedPrediction, ModelsResult
from ...results.uncertainty import (
    IntervalParts,
    LikelihoodProfile,
    ParameterUncertainty,
    ProfileCheck,
    SourceEffect,
    UncertaintyResult,
)
from ..drawing import plots
from ..drawing.colours import INK, MEASURED, MUTED, SIMULATED, choose_truth_style
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..formats import NOTHING, format_fixed, format_limits, label, number
from ..page import Block, Bullets, Cell, Figure, Note, Prose, Section, Table, make_section
from ..store import Curves, Results, find_compared_quantity
from ..tables import Column, make_table, to_numeric

TrueValues = dict[str, tuple[float, dict[str, Any]]]  # by name: a true parameter and its line
MAX_DRAWS, MAX_SITES = 300, 18


def make_uncertainty_section(store: Results, content: UncertaintyResult) -> Section:
    """What the experiment ``uncertainty`` found."""
    return make_section(
        "uncertainty",
        "What the records determine",
        Bullets(tuple(content.verdict)),
        _describe_method(content),
        _make_parameter_table(content),
        _make_combination_table(content),
        draw_profile_figure(store, content),
        draw_pairs_figure(store, content),
        _make_evidence_table(content),
        _make_source_table(content) if content.sources else None,
        draw_prediction_figure(store, content),
        _make_prediction_table(content),
        _describe_emulator(content),
    )


def _describe_method(content: UncertaintyResult) -> Prose:
    residuals = content.residuals
    return Prose(
        "Residuals are noise of the record, estimated from what smoothing took away (its autocorrelation and "
        "the doubt about touch-down included), plus a smooth misfit of the model at each site, a Gaussian "
        "process whose size and duration are found by restricted maximum likelihood: a misfit of "
        f"{format_fixed(100 * residuals.misfit_elsewhere, 2)} % of the largest force that lasts "
        f"{format_fixed(100 * residuals.correlation, 0)} % of a record. Posterior and profiles "
        "use an emulator "
        "of the solver; the further sources are simulations of their own, carried to the parameters by the "
        "linearised fit."
    )


def _make_parameter_table(content: UncertaintyResult) -> Table:
    columns = (
        ("Parameter", lambda row: label(row.name)),
        ("Identified", lambda row: to_numeric(number(row.calibrated))),
        ("Linearised", lambda row: to_numeric(format_limits(row.linearised_95))),
        ("Posterior", lambda row: to_numeric(format_limits(row.posterior_95))),
        ("Profile", lambda row: to_numeric(format_limits(row.profile_95))),
        ("Profile says", _describe_profile),
        ("With all sources", lambda row: to_numeric(format_limits(row.with_sources_95))),
        ("Verdict", "verdict"),
    )
    caption = (
        "Parameters (c in kPa, τ in s) with 95 % intervals by three methods on the records alone, and with "
        "geometry, contact and mesh added. A profile that is determined on both sides needs no bounds."
    )
    return make_table("uncertainty-parameters", caption, columns, content.parameters)


def _describe_profile(row: ParameterUncertainty) -> str:
    """What a profile says, and which of its ends rest on an emulator beyond its simulations."""
    if row.profile_verdict is None:
        return NOTHING
    low, high = row.profile_extrapolated or (False, False)
    ends = [word for word, beyond in (("low", low), ("high", high)) if beyond]
    where = f"; {' and '.join(ends)} end extrapolated" if ends else ""
    return f"{row.profile_verdict}{where}"


def _make_combination_table(content: UncertaintyResult) -> Table:
    columns = (
        ("Combination", lambda row: Cell(row.text)),
        ("Linearised", lambda row: _format_factor(row.linearised_factor_95)),
        ("Posterior", lambda row: _format_factor(row.posterior_factor_95)),
        ("With all sources", lambda row: _format_factor(row.with_sources_factor_95)),
        ("Verdict", "verdict"),
    )
    caption = (
        "Independent products of powers of the parameters, the best known first; × and ÷ by the factor is "
        "the 95 % interval."
    )
    return make_table("uncertainty-combinations", caption, columns, content.combinations)


def _format_factor(value: float) -> Cell:
    return to_numeric(f"×÷ {number(value, 4)}" if value < 100 else "×÷ > 100")


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
        ax.set_title(f"{label(name)}: {one.verdict}", fontsize=7.5)
    plots.add_legend(drawing, axes[0])
    caption = (
        "Profile likelihood of every parameter: all others chosen anew for each value. Where the curve stays "
        "below the dotted line up to a bound, the records do not determine the parameter on that side. "
        "Dashed, with open circles: beyond the emulator's simulations, extrapolated."
    )
    if checked := [_describe_check(check) for check in content.checks]:
        caption += f" At the ends, emulator and solver differ by (in the same unit): {', '.join(checked)}."
    words = ", ".join(f"{label(name)} {one.verdict}" for name, one in profiles.items())
    return plots.make_figure(drawing, "profiles", f"Profile likelihood: {words}", caption)


def _draw_profile(ax: Axes, one: LikelihoodProfile) -> None:
    """A profile, dashed and with open circles where it is extrapolated."""
    values, rise = np.array(one.values), np.array(one.rise)
    beyond = np.array(one.extrapolated, dtype=bool)
    # The neighbours too, so that the two lines meet.
    dashed = np.where(beyond | np.r_[beyond[1:], False] | np.r_[False, beyond[:-1]], rise, np.nan)
    ax.plot(values, np.where(beyond, np.nan, rise), color=SIMULATED, marker="o", ms=2.5, label="profile")
    ax.plot(values, dashed, color=SIMULATED, ls="--", lw=1.0, zorder=1.9, label="extrapolated")
    ax.plot(values[beyond], rise[beyond], color=SIMULATED, ls="", marker="o", ms=3.0, mfc="none")


def _describe_check(check: ProfileCheck) -> str:
    """By how much emulator and solver differ at the ends of a profile."""
    failed = ", not simulated at each end" if None in check.solved else ""
    return f"{label(check.name)} {format_fixed(check.largest_difference, 2)} (the {check.why}{failed})"


def _make_evidence_table(content: UncertaintyResult) -> Table | None:
    """One material against several."""
    found = content.evidence
    if found is None:
        return None
    columns = (
        ("Model", "name"),
        ("Free parameters", "parameters", 0),
        ("−2 ln L", "minus_2_log", 1),
        ("−2 ln evidence", "minus_2_log_evidence", 1),
        ("Held-out error (%)", "heldout_percent", 2),
    )
    rows = [
        one.to_plain() | {"heldout_percent": found.heldout.get(f"{which}_percent")}
        for which, one in (("first", found.first), ("second", found.second))
    ]
    samples = format_fixed(found.first.effective_samples, 0)
    caption = (
        f"One material or several: {found.verdict}. Evidence: the likelihood's mean over the bounds. "
        f"Residuals are correlated: {samples} count, too few for criteria that count samples."
    )
    return make_table("evidence", caption, columns, rows, marked=lambda row: row["name"] == found.better)


def _make_source_table(content: UncertaintyResult) -> Table:
    """What would change the answer by how much."""
    names = list(content.sources[0].parameters_percent)

    def shift(row: SourceEffect, name: str) -> Cell:
        value, shifts = row.parameters_percent[name], row.parameters_percent.values()
        share = min(abs(value) / (max(map(abs, shifts)) or 1.0), 1.0)
        return to_numeric(f"{'' if row.shared else '±'}{format_fixed(value)}", share)

    columns: tuple[Column, ...] = (
        ("Source", "source"),
        ("Change", _describe_change),
        (
            "Force (%)",
            lambda row: to_numeric(format_fixed(float(np.mean(list(row.force_percent.values()))), 2)),
        ),
        *((f"{label(name)} (%)", lambda row, name=name: shift(row, name)) for name in names),
        ("Counted", lambda row: "yes" if row.counted else "told only"),
    )
    caption = (
        "What would change the answer, by how much: change of force (mean over the fitted sites, of the "
        "largest) and what the fit would make of it in the parameters. ± where each site has its own, drawn "
        "together as the root of the sum of squares. Large changes are extrapolated linearly."
    )
    return make_table("uncertainty-sources", caption, columns, content.sources)


def _describe_change(row: SourceEffect) -> str:
    failed = f" (not simulated at {', '.join(row.failed)})" if row.failed else ""
    return f"{row.change}{failed}"


def _make_prediction_table(content: UncertaintyResult) -> Table:
    columns = (
        ("Site", "record"),
        ("Inside (%)", _format_inside),
        ("Half-width (% of force)", "half_width_percent", 1),
        ("Parameters", "parameters_sd_percent", 2),
        ("Sources", "sources_sd_percent", 2),
        ("Noise", "noise_sd_percent", 2),
        ("Site's stiffness", "site_sd_percent", 2),
        ("Misfit", "misfit_sd_percent", 2),
    )
    found = content.predictions
    shares = found.coverage_fitted_percent, found.coverage_heldout_percent
    fitted, heldout = (format_fixed(share, 0) for share in shares)
    caption = (
        "Prediction intervals of 95 %: how much of each record lies inside, and standard deviations by cause "
        f"in percent of the largest force. Fitted sites: {fitted} % inside; held-out sites: {heldout} %."
    )
    return make_table("uncertainty-predictions", caption, columns, found.sites, marked="fitted")


def _format_inside(row: IntervalParts) -> Cell:
    told = f"not predicted: {row.reason}" if row.reason else format_fixed(row.inside_percent, 0)
    return to_numeric(told)


def _describe_emulator(content: UncertaintyResult) -> Block:
    found, chain = content.emulator, content.posterior
    last = found.rounds[-1]
    text = (
        f"Emulator: {found.runs} simulations of all fitted sites with derivatives; its stated "
        "error over "
        f"nine tenths of the posterior is at most {format_fixed(max(last.error_percent), 2)} % "
        "of the largest "
        f"force (needed: {format_fixed(min(found.needed_percent), 2)} %), left-out runs are met to "
        f"{format_fixed(max(last.loo_percent), 2)} % (median); "
        f"{format_fixed(100 * last.outside, 0)} % of the "
        f"posterior lies beyond its simulations. Chain: "
        f"{format_fixed(chain.independent_draws, 0)} independent "
        f"draws, acceptance {format_fixed(100 * chain.acceptance, 0)} %."
    )
    return Prose(text) if found.good_enough else Note(text)


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
    caption = (
        "The posterior in pairs, logarithmic axes: on the diagonal each parameter by itself. A narrow "
        "oblique cloud is a combination that is known where its parameters are not."
    )
    alt = f"Draws of the posterior for {', '.join(names)}, each against each"
    return plots.make_figure(drawing, "posterior", alt, caption)


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
        axis.set_label_text(label(name), fontsize=7)


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
    caption = (
        "Records beside their 95 % prediction intervals: uncertainty of the parameters, all counted sources, "
        "noise of the record and misfit of the model."
    )
    records = ", ".join(row.record for row, _ in pairs)
    alt = f"Measured and predicted force with intervals: {records}"
    return plots.make_figure(drawing, "predictions", alt, caption)


_MAX_PANELS = 4


def make_models_section(store: Results, content: ModelsResult) -> Section:
    """What ``limbfit uncertainty --models`` found."""
    models = make_table(
        "models",
        "Models of the same records. Evidence is 2 ln B against the study's own model: positive where the "
        "records prefer the other.",
        (
            ("Model", lambda row: f"{row.words} ({row.model})"),
            ("Fitted (%)", "error_fitted_percent", 2),
            ("Held out (%)", "error_heldout_percent", 2),
            ("Evidence", "evidence", 1),
            ("Weight (%)", lambda row: to_numeric(format_fixed(100 * row.weight, 0))),
        ),
        content.models,
    )
    records = make_table(
        "models-records",
        "The largest measured value of each record, with 95 % intervals of the study's own model and of all.",
        (
            ("Record", "record"),
            ("Use", lambda row: "fitted" if row.fitted else "held out"),
            ("Unit", "unit"),
            ("Measured", "peak", 2),
            ("Own model", lambda row: _format_model_interval(row.own_interval_95)),
            ("All models", lambda row: _format_model_interval(row.interval_95)),
            ("Between models, sd", "sd_between_models", 3),
        ),
        content.records,
    )
    return make_section(
        "models",
        "Other models of the same records",
        Prose(
            "Each model was calibrated on the fitted records and predicts every record. Models are weighed "
            "by how probable they make the fitted records; a prediction with all of them is the mixture of "
            "theirs, so that its interval holds what the choice of the model leaves open."
        ),
        models,
        _draw_model_figure(store, content),
        records,
        (Note(f"Left out: {text}") for text in content.left_out.values()),
    )


def _format_model_interval(interval: Interval) -> str:
    low, high = interval
    return f"{low:.3g} to {high:.3g}"


def _draw_model_figure(store: Results, content: ModelsResult) -> Figure | None:
    rows = [row for row in content.records if not row.fitted] or content.records
    drawn = store.with_curves("models", rows[:_MAX_PANELS])
    return _draw_model_bands(drawn, [one.model for one in content.models[1:]]) if drawn else None


@styled
def _draw_model_bands(found: Sequence[tuple[MixedPrediction, Curves]], models: Sequence[str]) -> Figure:
    drawing, axes = make_panels(len(found), min(len(found), 2), 2.8)
    for ax, (row, curves) in zip(axes, found, strict=False):
        what, unit = find_compared_quantity(curves)
        time = curves["time_s"]
        low, high = (curves[f"{what}_{end}_{unit}"] for end in ("low", "high"))
        ax.fill_between(time, low, high, color=SIMULATED, alpha=0.25, lw=0, label="95 % by all models")
        for model in models:
            ax.plot(time, curves[f"{what}_{model}_{unit}"], color=MUTED, lw=0.8)
        ax.plot(time, curves[f"{what}_own_{unit}"], color=SIMULATED, label="own model")
        ax.plot(time, curves[f"{what}_measured_{unit}"], color=INK, lw=1.0, label="measured")
        ax.set(title=f"site {row.record}", xlabel="time (s)", ylabel=f"{what} ({unit})")
        ax.set_xlim(0.0, float(np.max(time)))
    add_legend(drawing, axes[0])
    return make_figure(
        drawing,
        "models",
        "Curves of records with the predictions of several models and one band",
        "Predictions by every model (other than the study's: grey), and the 95 % band of all together.",
    )
