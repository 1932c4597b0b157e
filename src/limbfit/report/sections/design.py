"""Which sites to test and which records to make: the best choices, and what they would determine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...results.planning import DesignResult, ProtocolPlan, ProtocolResult, SiteDesign
from ..drawing.colours import INK, MUTED, ONE_MATERIAL, SIMULATED, THIRD
from ..drawing.plots import add_legend, make_figure, make_panels, set_log_scale, set_rows, styled
from ..formats import format_fixed, label, number
from ..page import Figure, Prose, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import Column, make_table, to_numeric

Designs = Sequence[SiteDesign | ProtocolPlan]
_STYLES = ((SIMULATED, "o"), (THIRD, "D"), (ONE_MATERIAL, "s"), (MUTED, "^"), (INK, "v"))
MAX_FACTOR = 100.0  # factor that is drawn
SEEN = {
    "ultrasound_sd_mm": "Ultrasound through the indenter reads every tissue's thickness to {:g} mm",
    "surface_sd_mm": "Cameras read the displacement of the skin around the indenter to {:g} mm",
    "shear_waves_sd_m_s": "Elastography reads the speed of shear waves in every tissue to {:g} m/s",
}


def make_design_section(store: Results, content: DesignResult) -> Section:
    """What the experiment ``design`` found."""
    noise = content.noise
    searched = "all choices were compared" if content.designs[0].exhaustive else (
        "choices were searched by exchanges of one candidate at a time"
    )  # fmt: skip
    words = Prose(
        f"Which {content.wanted} of the candidate indentations would determine the parameters best, "
        "judged by the Fisher information of their forces, from exact derivatives at the parameters "
        f"({content.parameters_from}); {searched}. The noise: a sensor of {number(noise.sensor_N)} N, "
        f"and an error of the model of {format_fixed(100 * noise.misfit)} % of the largest force "
        "that drifts "
        "along the trace. D-optimal is the smallest joint region of confidence, A-optimal the smallest sum "
        f"of variances. In short: {content.verdict}."
    )
    return make_section(
        "design",
        "Which sites to test",
        words,
        _make_design_table(content),
        draw_expected_figure("designs", content.designs, "testing the sites of a design"),
        _make_candidate_table(content),
        make_bullets(f"Left out: {text}." for text in content.left_out),
    )


def _make_design_table(content: DesignResult) -> Table:
    columns = (
        ("Design", "design"),
        ("Sites (depth in mm)", _list_depths),
        ("D (%)", lambda row: to_numeric(format_fixed(100 * row.d_efficiency, 0))),
        ("A (%)", lambda row: to_numeric(format_fixed(100 * row.a_efficiency, 0))),
        *make_factor_columns(content.designs),
    )
    caption = (
        "Designs: efficiencies against the best, and for each parameter the factor f of the 95 % interval to "
        "be expected (value / f to value × f)."
    )
    own = "the study's own"
    return make_table("designs", caption, columns, content.designs, marked=lambda row: row.design == own)


def _list_depths(row: SiteDesign) -> str:
    return ", ".join(f"{one.site} ({format_fixed(one.depth_mm)})" for one in row.sites)


def make_factor_columns(designs: Designs) -> list[Column]:
    """A column for each parameter with the factor of its 95 % interval to be expected of a design."""

    def factor(row: SiteDesign | ProtocolPlan, name: str) -> object:
        value = row.factor_95[name]
        return to_numeric("open" if value > MAX_FACTOR else f"×/÷ {number(value)}")

    return [(label(name), lambda row, name=name: factor(row, name)) for name in designs[0].factor_95]


@styled
def draw_expected_figure(name: str, designs: Designs, of: str) -> Figure:
    """Expected factors of the intervals by parameter; ``of``: what one is left with, in words."""
    names = list(designs[0].factor_95)
    drawing, (ax,) = make_panels(1, 1, 0.8 + 0.3 * len(names))
    count = len(designs)
    for k, row in enumerate(designs):
        color, marker = _STYLES[k % len(_STYLES)]
        factors = np.minimum([row.factor_95[name] for name in names], MAX_FACTOR)
        at = np.arange(len(names)) + 0.16 * (k - (count - 1) / 2)
        ax.plot(factors, at, marker, color=color, ms=5, label=row.design)
    set_rows(ax, [label(name) for name in names])
    set_log_scale(ax, minor=True)
    ax.axvline(2, color=MUTED, lw=0.8, ls="--")
    ax.set_xlabel("Expected factor of the 95 % interval (–)")
    add_legend(drawing, ax, columns=2)
    caption = (
        f"The factor by which each parameter would remain uncertain after {of}. "
        f"Right of the dashed line: more than twofold; {MAX_FACTOR:g} and more are drawn at {MAX_FACTOR:g}."
    )
    alt = "Expected factors of the 95 % intervals by parameter and design; the numbers are in the table"
    return make_figure(drawing, f"{name}-figure", alt, caption)


def _make_candidate_table(content: DesignResult) -> Table:
    most = max(row.bits for row in content.candidates)
    columns = (
        ("Site", "site"),
        ("Depth (mm)", "depth_mm", 2),
        ("Largest force (N)", "peak_force_N", 2),
        (
            "Information alone (bits)",
            lambda row: to_numeric(format_fixed(row.bits), row.bits / most if most else None),
        ),
    )
    caption = "The candidates: how much each would tell by itself beyond the bounds."
    return make_table("candidates", caption, columns, content.candidates)


def make_protocol_section(store: Results, content: ProtocolResult) -> Section:
    """What the experiment ``protocol`` found."""
    draws = len(content.draws)
    meaning = {"D": "the smallest joint region of confidence", "A": "the smallest sum of variances"}
    wanted = ", ".join(map(label, content.determine))
    if content.pressures:
        wanted = "the logarithms of the mean pressures of the socket's regions"
    text = (
        f"The records that fit into {format_fixed(content.minutes, 0)} min and have, on average "
        f"over {draws} "
        f"tissues that the limb may have, {meaning[content.criterion]} for "
        f"{wanted}. The first of the tissues is the "
        f"{content.parameters_from}. Every site with another indenter takes {content.setup_s:g} s to "
        f"prepare, every record {content.rest_s:g} s of rest. In short: {content.verdict}."
    )
    seen = [words.format(sd) for key, words in SEEN.items() if (sd := getattr(content, key)) is not None]
    if seen:
        text += f" {', '.join(seen)}, but for the plain ramps and the protocol by force alone."
    return make_section(
        "protocol",
        "Which records to make",
        Prose(text),
        _make_record_table(content),
        _make_protocol_table(content),
        draw_expected_figure("protocols", content.protocols, "the records of a protocol"),
        _make_pressure_table(content) if content.pressures else None,
        make_bullets(f"{text}." for text in content.left_out),
    )


def _make_record_table(content: ProtocolResult) -> Table:
    columns = (
        ("Site", "site"),
        ("Indenter", "indenter"),
        ("Depth (mm)", "depth_mm", 1),
        ("Speed (mm/s)", "speed_mm_s", 2),
        ("Hold (s)", "hold_s", 0),
        ("Largest force (N)", "peak_force_N", 1),
    )
    caption = "The designed protocol; forces at the first tissue."
    return make_table("protocol-records", caption, columns, content.records)


def _make_protocol_table(content: ProtocolResult) -> Table:
    rows = content.protocols
    columns = (
        ("Protocol", "design"),
        ("Records", "records", 0),
        ("Minutes", "minutes", 0),
        ("Determined within 25 %", "determined", 0),
        *make_factor_columns(rows),
    )
    caption = (
        "What each protocol would determine: for each parameter the factor f of the 95 % interval to be "
        "expected (value / f to value × f), the middle one of the tissues. The rows below the first "
        "do without one ingredient, in the same time."
    )
    return make_table("protocols", caption, columns, rows, marked=lambda row: row is rows[0])


def _make_pressure_table(content: ProtocolResult) -> Table:
    columns: list[Column] = [("Load, region", str)]
    for row in content.protocols:
        half = {name: 100.0 * (value - 1.0) for name, value in row.pressures_95.items()}
        columns.append((f"{row.design} (± %)", lambda name, half=half: to_numeric(format_fixed(half[name]))))
    caption = (
        "The 95 % interval to be expected of each mean pressure, by the tissue alone: to first order, with "
        "the derivatives that the socket's simulation stored."
    )
    return make_table("protocol-pressures", caption, columns, content.pressures)
