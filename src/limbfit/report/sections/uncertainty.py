"""What the records determine: intervals by three methods, profiles, posterior, sources, predictions."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from ..drawing.ink import MUTED, SIMULATED, STYLE, legend_above, panels, svg
from ..drawing.uncertainty_figures import pairs_figure, prediction_figure, true_values
from ..formats import fixed, heading, label, number, numeric
from ..page import Block, Bullets, Cell, Figure, Note, Prose, Row, Section, Table
from ..store import Json, Results

_MOST_PANELS_IN_A_ROW = 4


def uncertainty_section(store: Results, content: Json) -> Section:
    """What the experiment ``uncertainty`` found."""
    blocks: tuple[Block | None, ...] = (
        Bullets(tuple(content["verdict"])),
        _method(content),
        _parameters(store, content),
        _combinations(content),
        profile_figure(store, content),
        pairs_figure(store, content),
        _evidence(content),
        _sources(content) if content["sources"] else None,
        prediction_figure(store, content),
        _predictions(content),
        _emulator(content),
    )
    found = tuple(block for block in blocks if block is not None)
    return Section("uncertainty", "What the records determine", found)


def _method(content: Json) -> Prose:
    residuals = content["residuals"]
    return Prose(
        "Residuals are noise of the record, estimated from what smoothing took away (its autocorrelation "
        "and the "
        "doubt about touch-down included), plus a smooth misfit of the model at each site, a Gaussian "
        "process "
        "whose size and duration are found by restricted maximum likelihood: a misfit of "
        f"{fixed(100 * residuals['misfit_elsewhere'], 2)} % of the largest force that lasts "
        f"{fixed(100 * residuals['correlation'], 0)} % of a record. Posterior and profiles use an "
        "emulator of the "
        "solver; the further sources are simulations of their own, carried to the parameters by the "
        "linearised fit."
    )


def _range(limits: list[float] | None) -> str:
    return "–" if not limits else f"{number(limits[0])} to {number(limits[1])}"


def _parameters(store: Results, content: Json) -> Table:
    head = (
        "Parameter", "Identified", "Linearised", "Posterior", "Profile", "Profile says", "With all sources",
        "Verdict",
    )  # fmt: skip
    rows = []
    for row in content["parameters"]:
        columns = ("linearised_95", "posterior_95", "profile_95")
        ranges = [numeric(_range(row[key])) for key in columns]
        wider = numeric(_range(row["with_sources_95"]))
        words = (Cell(_profile_words(row)), wider, Cell(row["verdict"]))
        cells = (heading(label(row["name"])), numeric(number(row["calibrated"])), *ranges, *words)
        rows.append(Row(cells))
    caption = (
        "Parameters (c in kPa, τ in s) with 95 % intervals by three methods on the records alone, and with "
        "geometry, contact and mesh added. A profile that is determined on both sides needs no bounds."
    )
    return Table("uncertainty-parameters", caption, head, tuple(rows))


def _profile_words(row: Json) -> str:
    """What a profile says, and which of its ends rest on an emulator beyond its simulations."""
    if row["profile_verdict"] is None:
        return "–"
    low, high = row["profile_extrapolated"]
    ends = [word for word, beyond in (("low", low), ("high", high)) if beyond]
    where = f"; {' and '.join(ends)} end extrapolated" if ends else ""
    return f"{row['profile_verdict']}{where}"


def _combinations(content: Json) -> Table:
    head = ("Combination", "Linearised", "Posterior", "With all sources", "Verdict")
    keys = ("linearised_factor_95", "posterior_factor_95", "with_sources_factor_95")
    rows = tuple(
        Row((Cell(row["text"]), *(numeric(_factor(row[key])) for key in keys), Cell(row["verdict"])))
        for row in content["combinations"]
    )
    caption = (
        "Independent products of powers of the parameters, the best known first; × and ÷ by the factor is "
        "the "
        "95 % interval."
    )
    return Table("uncertainty-combinations", caption, head, rows)


def _factor(value: float) -> str:
    return f"×÷ {number(value, 4)}" if value < 100 else "×÷ > 100"


def profile_figure(store: Results, content: Json) -> Figure | None:
    """How much worse the records are met as one parameter moves and the others follow."""
    profiles = content["profiles"]
    if not profiles:
        return None
    truth = true_values(store)
    drawing, axes = panels(len(profiles), _MOST_PANELS_IN_A_ROW, 1.9)
    with matplotlib.rc_context(STYLE):
        for i, (ax, (name, one)) in enumerate(zip(axes, profiles.items(), strict=True)):
            _draw_profile(ax, one)
            ax.axhline(one["threshold"], color=MUTED, ls=":", lw=1.2, label="95 %")
            ax.axvspan(*one["interval_95"], color=SIMULATED, alpha=0.12, lw=0)
            if name in truth:
                ax.axvline(truth[name][0], **truth[name][1], label="truth")
            ax.set_ylim(0, 2.5 * one["threshold"])
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
            ax.xaxis.set_minor_formatter(lambda value, _: "")
            ax.set_title(f"{label(name)}: {one['verdict']}", fontsize=7.5)
            if i % _MOST_PANELS_IN_A_ROW == 0:
                ax.set_ylabel("Rise of −2 ln L")
        legend_above(drawing, axes[0])
    caption = (
        "Profile likelihood of every parameter: all others chosen anew for each value. Where the curve stays "
        "below the dotted line up to a bound, the records do not determine the parameter on that side. "
        "Dashed, with open circles: beyond the emulator's simulations, extrapolated."
    )
    checked = [_checked(check) for check in content["checks"]]
    if checked:
        caption += f" At the ends, emulator and solver differ by (in the same unit): {', '.join(checked)}."
    words = ", ".join(f"{label(name)} {one['verdict']}" for name, one in profiles.items())
    return Figure("profiles", svg(drawing, "profiles", f"Profile likelihood: {words}"), caption)


def _draw_profile(ax: Axes, one: Json) -> None:
    """A profile, dashed and with open circles where it is extrapolated."""
    values, rise = np.array(one["values"]), np.array(one["rise"])
    beyond = np.array(one["extrapolated"], dtype=bool)
    # The neighbours too, so that the two lines meet.
    dashed = np.where(beyond | np.r_[beyond[1:], False] | np.r_[False, beyond[:-1]], rise, np.nan)
    ax.plot(values, np.where(beyond, np.nan, rise), color=SIMULATED, marker="o", ms=2.5, label="profile")
    ax.plot(values, dashed, color=SIMULATED, ls="--", lw=1.0, zorder=1.9, label="extrapolated")
    ax.plot(values[beyond], rise[beyond], color=SIMULATED, ls="", marker="o", ms=3.0, mfc="none")


def _checked(check: Json) -> str:
    """By how much emulator and solver differ at the ends of a profile."""
    pairs = zip(check["emulated"], check["solved"], strict=True)
    off = [abs(a - b) for a, b in pairs if b is not None]
    failed = "" if len(off) == len(check["solved"]) else ", not simulated at each end"
    return f"{label(check['name'])} {fixed(max(off, default=None), 2)} (the {check['why']}{failed})"


def _evidence(content: Json) -> Table | None:
    """One material against several."""
    found = content["evidence"]
    if not found:
        return None
    head = ("Model", "Free parameters", "−2 ln L", "AIC", "BIC", "Held-out error (%)")
    heldout = found["heldout"]
    rows = []
    for which in ("first", "second"):
        one = found[which]
        numbers = (one["minus_2_log"], one["aic"], one["bic"])
        error = fixed(heldout.get(f"{which}_percent"), 2) if heldout else "–"
        cells = (heading(one["name"]), numeric(str(one["parameters"])), *(numeric(fixed(n)) for n in numbers))
        rows.append(Row((*cells, numeric(error)), marked=one["name"] == found["better"]))
    samples = fixed(found["first"]["effective_samples"], 0)
    caption = (
        f"One material or several: {found['verdict']}. Criteria count {samples} effective samples "
        "(residuals are "
        "correlated) and the size of the misfit as a parameter; AIC is corrected for few samples."
    )
    return Table("evidence", caption, head, tuple(rows))


def _sources(content: Json) -> Table:
    """What would change the answer by how much."""
    names = list(content["sources"][0]["parameters_percent"])
    head = ("Source", "Change", "Force (%)", *(f"{label(name)} (%)" for name in names), "Counted")
    rows = []
    for row in content["sources"]:
        forces = list(row["force_percent"].values())
        shifts = [row["parameters_percent"][name] for name in names]
        largest = max(map(abs, shifts)) or 1.0
        failed = f" (not simulated at {', '.join(row['failed'])})" if row["failed"] else ""
        sign = "" if row["shared"] else "±"
        cells = [Cell(row["change"] + failed), numeric(fixed(sum(forces) / len(forces), 2))]
        cells += [numeric(f"{sign}{fixed(v)}", share=min(abs(v) / largest, 1.0)) for v in shifts]
        rows.append(Row((heading(row["source"]), *cells, Cell("yes" if row["counted"] else "told only"))))
    caption = (
        "What would change the answer, by how much: change of force (mean over the fitted sites, of the "
        "largest) "
        "and what the fit would make of it in the parameters. ± where each site has its own, drawn "
        "together as "
        "the root of the sum of squares. Large changes are extrapolated linearly."
    )
    return Table("uncertainty-sources", caption, head, tuple(rows))


def _predictions(content: Json) -> Table:
    head = (
        "Site", "Inside (%)", "Half-width (% of force)", "Parameters", "Sources", "Noise", "Misfit",
    )  # fmt: skip
    keys = ("parameters", "sources", "noise", "misfit")
    rows = tuple(
        Row(
            (
                heading(row.get("record", row["site"])),
                numeric(
                    f"not predicted: {row['reason']}"
                    if row.get("reason")
                    else fixed(row["inside_percent"], 0)
                ),
                numeric(fixed(row["half_width_percent"])),
                *(numeric(fixed(row[f"{key}_sd_percent"], 2)) for key in keys),
            ),
            marked=row["fitted"],
        )
        for row in content["predictions"]["sites"]
    )
    coverage = content["predictions"]
    caption = (
        "Prediction intervals of 95 %: how much of each record lies inside, and standard deviations by "
        "cause in "
        f"percent of the largest force. Fitted sites: {fixed(coverage['coverage_fitted_percent'], 0)} % "
        "inside; "
        f"held-out sites: {fixed(coverage['coverage_heldout_percent'], 0)} %."
    )
    return Table("uncertainty-predictions", caption, head, rows)


def _emulator(content: Json) -> Block:
    found, chain = content["emulator"], content["posterior"]
    last = found["rounds"][-1]
    text = (
        f"Emulator: {found['runs']} simulations of all fitted sites with derivatives; its stated error "
        "over nine "
        f"tenths of the posterior is at most {fixed(max(last['error_percent']), 2)} % of the largest force "
        f"(needed: {fixed(min(found['needed_percent']), 2)} %), left-out runs are met to "
        f"{fixed(max(last['loo_percent']), 2)} % (median); {fixed(100 * last['outside'], 0)} % of the "
        "posterior "
        f"lies beyond its simulations. Chain: {fixed(chain['independent_draws'], 0)} independent draws, "
        "acceptance "
        f"{fixed(100 * chain['acceptance'], 0)} %."
    )
    return Prose(text) if found["good_enough"] else Note(text)
