"""Which sites to test: the best choices beside the study's own."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np

from ..drawing.ink import INK, MUTED, ONE_MATERIAL, SIMULATED, STYLE, THIRD, legend_above, panels, svg
from ..formats import fixed, heading, label, number, numeric
from ..page import Block, Bullets, Cell, Figure, Prose, Row, Section, Table
from ..store import Json, Results

_STYLES = ((SIMULATED, "o"), (THIRD, "D"), (ONE_MATERIAL, "s"), (MUTED, "^"), (INK, "v"))
_WIDEST = 100.0  # factor that is drawn


def design_section(store: Results, content: Json) -> Section:
    """What the experiment ``design`` found."""
    noise = content["noise"]
    searched = "all choices were compared" if content["designs"][0]["exhaustive"] else (
        "choices were searched by exchanges of one candidate at a time"
    )  # fmt: skip
    words = Prose(
        f"Which {content['wanted']} of the candidate indentations would determine the parameters best, "
        "judged by the Fisher information of their forces, from exact derivatives at the parameters "
        f"({content['parameters_from']}); {searched}. The noise: a sensor of {number(noise['sensor_N'])} N, "
        f"and an error of the model of {fixed(100 * noise['misfit'])} % of the largest force that drifts "
        "along the trace. D-optimal is the smallest joint region of confidence, "
        "A-optimal the smallest sum of "
        f"variances. In short: {content['verdict']}."
    )
    blocks: list[Block] = [
        words,
        _design_table(content),
        expected_figure("designs", content["designs"], "testing the sites of a design"),
        _candidate_table(content),
    ]
    if content["left_out"]:
        blocks.append(Bullets(tuple(f"Left out: {text}." for text in content["left_out"])))
    return Section("design", "Which sites to test", tuple(blocks))


def _design_table(content: Json) -> Table:
    names = list(content["designs"][0]["factor_95"])
    rows = tuple(
        Row(
            (
                heading(str(row["design"])),
                Cell(", ".join(f"{one['site']} ({fixed(one['depth_mm'])})" for one in row["sites"])),
                numeric(fixed(100 * row["d_efficiency"], 0)),
                numeric(fixed(100 * row["a_efficiency"], 0)),
                *(numeric(factor(row["factor_95"][name])) for name in names),
            ),
            marked=row["design"] == "the study's own",
        )
        for row in content["designs"]
    )
    head = ("Design", "Sites (depth in mm)", "D (%)", "A (%)", *(label(name) for name in names))
    caption = (
        "Designs: efficiencies against the best, and for each parameter the factor f of the 95 % interval to "
        "be expected (value / f to value × f)."
    )
    return Table("designs", caption, head, rows)


def factor(value: float) -> str:
    """Of a 95 % interval, in words where nothing is known."""
    return "open" if value > _WIDEST else f"×/÷ {number(value)}"


def expected_figure(name: str, designs: Sequence[Json], of: str) -> Figure:
    """Expected factors of the intervals by parameter; ``of``: what one is left with, in words."""
    names = list(designs[0]["factor_95"])
    drawing, (ax,) = panels(1, 1, 0.8 + 0.3 * len(names))
    with matplotlib.rc_context(STYLE):
        count = len(designs)
        for k, row in enumerate(designs):
            color, marker = _STYLES[k % len(_STYLES)]
            factors = np.minimum([row["factor_95"][name] for name in names], _WIDEST)
            at = np.arange(len(names)) + 0.16 * (k - (count - 1) / 2)
            ax.plot(factors, at, marker, color=color, ms=5, label=row["design"])
        ax.set_yticks(range(len(names)), [label(name) for name in names])
        ax.invert_yaxis()
        ax.set_xscale("log")
        ax.axvline(2, color=MUTED, lw=0.8, ls="--")
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.xaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "25" else "")
        ax.set_xlabel("Expected factor of the 95 % interval (–)")
        ax.grid(visible=False, axis="y")
        legend_above(drawing, ax, columns=2)
    caption = (
        f"The factor by which each parameter would remain uncertain after {of}. "
        f"Right of the dashed line: more than twofold; {_WIDEST:g} and more are drawn at {_WIDEST:g}."
    )
    alt = "Expected factors of the 95 % intervals by parameter and design; the numbers are in the table"
    return Figure(f"{name}-figure", svg(drawing, f"{name}-figure", alt), caption)


def _candidate_table(content: Json) -> Table:
    most = max(row["bits"] for row in content["candidates"])
    rows = tuple(
        Row(
            (
                heading(str(row["site"])),
                numeric(fixed(row["depth_mm"], 2)),
                numeric(fixed(row["peak_force_N"], 2)),
                numeric(fixed(row["bits"]), row["bits"] / most if most > 0 else None),
            )
        )
        for row in content["candidates"]
    )
    head = ("Site", "Depth (mm)", "Largest force (N)", "Information alone (bits)")
    caption = "The candidates: how much each would tell by itself beyond the bounds."
    return Table("candidates", caption, head, rows)
