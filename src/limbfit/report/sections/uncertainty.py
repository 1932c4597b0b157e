"""What the records determine: intervals by three methods, profiles, posterior, sources, predictions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from ..drawing.colours import MUTED, SIMULATED
from ..drawing.plots import (
    add_legend_above,
    label_outer_axes,
    make_figure,
    make_panels,
    set_log_scale,
    styled,
)
from ..drawing.uncertainty_figures import draw_pairs_figure, draw_prediction_figure, read_true_values
from ..formats import NOTHING, fixed, label, limits, number
from ..page import Block, Bullets, Cell, Figure, Note, Prose, Section, Table, make_section
from ..store import Json, Results, get_record_name
from ..tables import Column, make_table, numeric


def make_uncertainty_section(store: Results, content: Json) -> Section:
    """What the experiment ``uncertainty`` found."""
    return make_section(
        "uncertainty",
        "What the records determine",
        Bullets(tuple(content["verdict"])),
        _describe_method(content),
        _make_parameter_table(content),
        _make_combination_table(content),
        draw_profile_figure(store, content),
        draw_pairs_figure(store, content),
        _make_evidence_table(content),
        _make_source_table(content) if content["sources"] else None,
        draw_prediction_figure(store, content),
        _make_prediction_table(content),
        _describe_emulator(content),
    )


def _describe_method(content: Json) -> Prose:
    residuals = content["residuals"]
    return Prose(
        "Residuals are noise of the record, estimated from what smoothing took away (its autocorrelation and "
        "the doubt about touch-down included), plus a smooth misfit of the model at each site, a Gaussian "
        "process whose size and duration are found by restricted maximum likelihood: a misfit of "
        f"{fixed(100 * residuals['misfit_elsewhere'], 2)} % of the largest force that lasts "
        f"{fixed(100 * residuals['correlation'], 0)} % of a record. Posterior and profiles use an emulator "
        "of the solver; the further sources are simulations of their own, carried to the parameters by the "
        "linearised fit."
    )


def _make_parameter_table(content: Json) -> Table:
    columns = (
        ("Parameter", lambda row: label(row["name"])),
        ("Identified", lambda row: numeric(number(row["calibrated"]))),
        ("Linearised", lambda row: numeric(limits(row["linearised_95"]))),
        ("Posterior", lambda row: numeric(limits(row["posterior_95"]))),
        ("Profile", lambda row: numeric(limits(row["profile_95"]))),
        ("Profile says", _describe_profile),
        ("With all sources", lambda row: numeric(limits(row["with_sources_95"]))),
        ("Verdict", "verdict"),
    )
    caption = (
        "Parameters (c in kPa, τ in s) with 95 % intervals by three methods on the records alone, and with "
        "geometry, contact and mesh added. A profile that is determined on both sides needs no bounds."
    )
    return make_table("uncertainty-parameters", caption, columns, content["parameters"])


def _describe_profile(row: Json) -> str:
    """What a profile says, and which of its ends rest on an emulator beyond its simulations."""
    if row["profile_verdict"] is None:
        return NOTHING
    low, high = row["profile_extrapolated"]
    ends = [word for word, beyond in (("low", low), ("high", high)) if beyond]
    where = f"; {' and '.join(ends)} end extrapolated" if ends else ""
    return f"{row['profile_verdict']}{where}"


def _make_combination_table(content: Json) -> Table:
    columns = (
        ("Combination", lambda row: Cell(row["text"])),
        ("Linearised", lambda row: _format_factor(row["linearised_factor_95"])),
        ("Posterior", lambda row: _format_factor(row["posterior_factor_95"])),
        ("With all sources", lambda row: _format_factor(row["with_sources_factor_95"])),
        ("Verdict", "verdict"),
    )
    caption = (
        "Independent products of powers of the parameters, the best known first; × and ÷ by the factor is "
        "the 95 % interval."
    )
    return make_table("uncertainty-combinations", caption, columns, content["combinations"])


def _format_factor(value: float) -> Cell:
    return numeric(f"×÷ {number(value, 4)}" if value < 100 else "×÷ > 100")


@styled
def draw_profile_figure(store: Results, content: Json) -> Figure | None:
    """How much worse the records are met as one parameter moves and the others follow."""
    profiles = content["profiles"]
    if not profiles:
        return None
    truth = read_true_values(store)
    drawing, axes = make_panels(len(profiles), 4, 1.9)
    label_outer_axes(axes, 4, "", "Rise of −2 ln L")
    for ax, (name, one) in zip(axes, profiles.items(), strict=True):
        _draw_profile(ax, one)
        ax.axhline(one["threshold"], color=MUTED, ls=":", lw=1.2, label="95 %")
        ax.axvspan(*one["interval_95"], color=SIMULATED, alpha=0.12, lw=0)
        if name in truth:
            ax.axvline(truth[name][0], **truth[name][1], label="truth")
        ax.set_ylim(0, 2.5 * one["threshold"])
        set_log_scale(ax)
        ax.set_title(f"{label(name)}: {one['verdict']}", fontsize=7.5)
    add_legend_above(drawing, axes[0])
    caption = (
        "Profile likelihood of every parameter: all others chosen anew for each value. Where the curve stays "
        "below the dotted line up to a bound, the records do not determine the parameter on that side. "
        "Dashed, with open circles: beyond the emulator's simulations, extrapolated."
    )
    if checked := [_describe_check(check) for check in content["checks"]]:
        caption += f" At the ends, emulator and solver differ by (in the same unit): {', '.join(checked)}."
    words = ", ".join(f"{label(name)} {one['verdict']}" for name, one in profiles.items())
    return make_figure(drawing, "profiles", f"Profile likelihood: {words}", caption)


def _draw_profile(ax: Axes, one: Json) -> None:
    """A profile, dashed and with open circles where it is extrapolated."""
    values, rise = np.array(one["values"]), np.array(one["rise"])
    beyond = np.array(one["extrapolated"], dtype=bool)
    # The neighbours too, so that the two lines meet.
    dashed = np.where(beyond | np.r_[beyond[1:], False] | np.r_[False, beyond[:-1]], rise, np.nan)
    ax.plot(values, np.where(beyond, np.nan, rise), color=SIMULATED, marker="o", ms=2.5, label="profile")
    ax.plot(values, dashed, color=SIMULATED, ls="--", lw=1.0, zorder=1.9, label="extrapolated")
    ax.plot(values[beyond], rise[beyond], color=SIMULATED, ls="", marker="o", ms=3.0, mfc="none")


def _describe_check(check: Json) -> str:
    """By how much emulator and solver differ at the ends of a profile."""
    pairs = zip(check["emulated"], check["solved"], strict=True)
    off = [abs(a - b) for a, b in pairs if b is not None]
    failed = "" if len(off) == len(check["solved"]) else ", not simulated at each end"
    return f"{label(check['name'])} {fixed(max(off, default=None), 2)} (the {check['why']}{failed})"


def _make_evidence_table(content: Json) -> Table | None:
    """One material against several."""
    found = content["evidence"]
    if not found:
        return None
    heldout = found["heldout"] or {}
    columns = (
        ("Model", "name"),
        ("Free parameters", "parameters", 0),
        ("−2 ln L", "minus_2_log", 1),
        ("AIC", "aic", 1),
        ("BIC", "bic", 1),
        ("Held-out error (%)", "heldout_percent", 2),
    )
    rows = [
        found[which] | {"heldout_percent": heldout.get(f"{which}_percent")} for which in ("first", "second")
    ]
    samples = fixed(found["first"]["effective_samples"], 0)
    caption = (
        f"One material or several: {found['verdict']}. Criteria count {samples} effective samples (residuals "
        "are correlated) and the size of the misfit as a parameter; AIC is corrected for few samples."
    )
    return make_table("evidence", caption, columns, rows, marked=lambda row: row["name"] == found["better"])


def _make_source_table(content: Json) -> Table:
    """What would change the answer by how much."""
    names = list(content["sources"][0]["parameters_percent"])

    def shift(row: Json, name: str) -> Cell:
        value, shifts = row["parameters_percent"][name], row["parameters_percent"].values()
        share = min(abs(value) / (max(map(abs, shifts)) or 1.0), 1.0)
        return numeric(f"{'' if row['shared'] else '±'}{fixed(value)}", share)

    columns: tuple[Column, ...] = (
        ("Source", "source"),
        ("Change", _describe_change),
        ("Force (%)", lambda row: numeric(fixed(float(np.mean(list(row["force_percent"].values()))), 2))),
        *((f"{label(name)} (%)", lambda row, name=name: shift(row, name)) for name in names),
        ("Counted", lambda row: "yes" if row["counted"] else "told only"),
    )
    caption = (
        "What would change the answer, by how much: change of force (mean over the fitted sites, of the "
        "largest) and what the fit would make of it in the parameters. ± where each site has its own, drawn "
        "together as the root of the sum of squares. Large changes are extrapolated linearly."
    )
    return make_table("uncertainty-sources", caption, columns, content["sources"])


def _describe_change(row: Json) -> str:
    failed = f" (not simulated at {', '.join(row['failed'])})" if row["failed"] else ""
    return f"{row['change']}{failed}"


def _make_prediction_table(content: Json) -> Table:
    columns = (
        ("Site", get_record_name),
        ("Inside (%)", _format_inside),
        ("Half-width (% of force)", "half_width_percent", 1),
        ("Parameters", "parameters_sd_percent", 2),
        ("Sources", "sources_sd_percent", 2),
        ("Noise", "noise_sd_percent", 2),
        ("Misfit", "misfit_sd_percent", 2),
    )
    found = content["predictions"]
    fitted, heldout = (fixed(found[f"coverage_{use}_percent"], 0) for use in ("fitted", "heldout"))
    caption = (
        "Prediction intervals of 95 %: how much of each record lies inside, and standard deviations by cause "
        f"in percent of the largest force. Fitted sites: {fitted} % inside; held-out sites: {heldout} %."
    )
    return make_table("uncertainty-predictions", caption, columns, found["sites"], marked="fitted")


def _format_inside(row: Json) -> Cell:
    reason = row.get("reason")
    return numeric(f"not predicted: {reason}" if reason else fixed(row["inside_percent"], 0))


def _describe_emulator(content: Json) -> Block:
    found, chain = content["emulator"], content["posterior"]
    last = found["rounds"][-1]
    text = (
        f"Emulator: {found['runs']} simulations of all fitted sites with derivatives; its stated error over "
        f"nine tenths of the posterior is at most {fixed(max(last['error_percent']), 2)} % of the largest "
        f"force (needed: {fixed(min(found['needed_percent']), 2)} %), left-out runs are met to "
        f"{fixed(max(last['loo_percent']), 2)} % (median); {fixed(100 * last['outside'], 0)} % of the "
        f"posterior lies beyond its simulations. Chain: {fixed(chain['independent_draws'], 0)} independent "
        f"draws, acceptance {fixed(100 * chain['acceptance'], 0)} %."
    )
    return Prose(text) if found["good_enough"] else Note(text)
