"""The cube in uniaxial compression: the paper's figures 8 (skin) and 9 (muscle)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...results.variants import CubeResult, CubeTissue
from ..drawing.colours import INK, MEASURED, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH
from ..drawing.plots import make_figure, make_panels, make_standalone, styled
from ..formats import format_fixed, number
from ..page import Figure, Prose, Section, Table, make_section
from ..store import Results
from ..tables import make_table, to_numeric

KINDS = {"skin": "Figure 8. Skin, adipose tissue", "muscle": "Figure 9. Muscle, soft tissue below the skin"}
_OWN = ((SIMULATED, "-"), (THIRD, "-"), (INK, "-"))
_OTHERS = ((ONE_MATERIAL, "--"), (TRUTH, "-."), (THIRD, (0, (6, 2))), (MUTED, ":"), (MEASURED, (0, (1, 2))))


def make_cube_section(store: Results, content: CubeResult) -> Section:
    """What the experiment ``cube`` found."""
    softest = [
        f"{row.tissue.removesuffix(' (this study)')} {format_fixed(row.peak_kPa, 2)} kPa"
        for row in content.tissues
        if _is_own(row)
    ]
    words = Prose(
        f"A cube of {content.side_mm:g} mm of each tissue, compressed by "
        f"{content.compression_percent:g} % within {content.ramp_s:g} s, brought back within "
        f"{content.ramp_s:g} s and held for {content.hold_s:g} s, its sides free, between plates "
        "without friction that hold on to it; so the stress turns into tension on the way back where "
        "the tissue lags behind. The paper does not say how far it compressed its cube: compare the curves "
        f"with one another, not with its axes. Largest stress of this study's tissues: {', '.join(softest)}."
    )
    title = "Comparison with published tissues"
    return make_section("cube", title, words, draw_cube_figure(content), _make_tissue_table(content))


def _is_own(row: CubeTissue) -> bool:
    return row.source == "this study"


def draw_cube(content: CubeResult) -> str:
    """The figure as the text of an SVG file."""
    return make_standalone(draw_cube_figure(content).markup)


@styled
def draw_cube_figure(content: CubeResult) -> Figure:
    """Stress against time, and over its own peak, beside published skin and published muscle."""
    drawing, axes = make_panels(4, 2, 2.6)
    for column, (kind, title) in enumerate(KINDS.items()):
        rows = [row for row in content.tissues if row.kind == kind]
        _draw_stresses(axes[column], axes[column + 2], rows, content)
        axes[column].set_title(title)
        axes[column + 2].set_xlabel("Time (s)")
    axes[0].set_ylabel("Compressive stress (kPa)")
    axes[2].set_ylabel("Stress over its peak (–)")
    alt = "Compressive stress of a cube against time for this study's tissues and published ones"
    caption = (
        "Figures 8 and 9 of the paper for this study. Above: Cauchy stress along the compression, positive "
        "when pushing; below: the same over its own peak, which shows how fast each tissue relaxes."
    )
    return make_figure(drawing, "cube", alt, caption)


def _draw_stresses(above: Axes, below: Axes, rows: Sequence[CubeTissue], content: CubeResult) -> None:
    time = np.array([0.0, *content.time_s])
    own, others = iter(_OWN * len(rows)), iter(_OTHERS * len(rows))
    for row in rows:
        mine = _is_own(row)
        color, line = next(own if mine else others)
        stress = np.array([0.0, *content.stress_kPa[row.tissue]])
        style: dict[str, Any] = {"color": color, "ls": line, "lw": 2.2 if mine else 1.3}
        above.plot(time, stress, label=row.tissue, **style)
        below.plot(time, stress / stress.max(), **style)
    above.legend(fontsize=7, loc="upper right")
    for ax in (above, below):
        ax.axhline(0.0, color=MUTED, lw=0.8)
        ax.margins(x=0.01)


def _make_tissue_table(content: CubeResult) -> Table:
    columns = (
        ("Tissue", "tissue"),
        ("Published or identified values", "values"),
        ("Shear modulus, long-term (kPa)", lambda row: to_numeric(number(row.shear_modulus_kPa))),
        ("Instantaneous (kPa)", lambda row: to_numeric(number(row.instantaneous_modulus_kPa))),
        ("Largest stress (kPa)", lambda row: to_numeric(number(row.peak_kPa))),
        ("Back at its height (kPa)", lambda row: to_numeric(number(row.back_kPa))),
        ("After the hold (kPa)", lambda row: to_numeric(number(row.end_kPa))),
        ("J", lambda row: to_numeric(f"{format_fixed(row.J_min, 4)} to {format_fixed(row.J_max, 4)}")),
        ("How it was put into the law", "conversion"),
        ("Source", "source"),
    )
    caption = (
        "Tissues of the cube. Moduli are those of small strains; J is the range of the ratio of volumes. The "
        "Ogden terms of each are in cube.json."
    )
    return make_table("cube", caption, columns, content.tissues, marked=_is_own)
