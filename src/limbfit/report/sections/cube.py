"""The cube in uniaxial compression: the paper's figures 8 (skin) and 9 (muscle)."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from ..drawing.ink import (
    INK,
    MEASURED,
    MUTED,
    ONE_MATERIAL,
    SIMULATED,
    STYLE,
    THIRD,
    TRUTH,
    panels,
    standalone,
    svg,
)
from ..formats import fixed, heading, number, numeric
from ..page import Cell, Figure, Prose, Row, Section, Table
from ..store import Json, Results

KINDS = {"skin": "Figure 8. Skin, adipose tissue", "muscle": "Figure 9. Muscle, soft tissue below the skin"}
_OWN = ((SIMULATED, "-"), (THIRD, "-"), (INK, "-"))
_OTHERS = ((ONE_MATERIAL, "--"), (TRUTH, "-."), (THIRD, (0, (6, 2))), (MUTED, ":"), (MEASURED, (0, (1, 2))))


def cube_section(store: Results, content: Json) -> Section:
    """What the experiment ``cube`` found."""
    own = [row for row in content["tissues"] if row["source"] == "this study"]
    softest = [
        f"{row['tissue'].removesuffix(' (this study)')} {fixed(row['peak_kPa'], 2)} kPa" for row in own
    ]
    words = Prose(
        f"A cube of {content['side_mm']:g} mm of each tissue, compressed by "
        f"{content['compression_percent']:g} % within {content['ramp_s']:g} s, brought back within "
        f"{content['ramp_s']:g} s and held for {content['hold_s']:g} s, its sides free, between plates "
        "without friction that hold on to it; so the stress turns into tension on the way back where "
        "the tissue lags behind. The paper does not say how far it compressed its cube: compare the curves "
        f"with one another, not with its axes. Largest stress of this study's tissues: {', '.join(softest)}."
    )
    return Section(
        "cube", "Comparison with published tissues", (words, cube_figure(content), _table(content))
    )


def cube_drawing(content: Json) -> str:
    """The figure as the text of an SVG file."""
    return standalone(cube_figure(content).markup)


def cube_figure(content: Json) -> Figure:
    """Stress against time, and over its own peak, beside published skin and published muscle."""
    drawing, axes = panels(4, 2, 2.6)
    with matplotlib.rc_context(STYLE):
        for column, (kind, title) in enumerate(KINDS.items()):
            rows = [row for row in content["tissues"] if row["kind"] == kind]
            _draw(axes[column], axes[column + 2], rows, content)
            axes[column].set_title(title)
            axes[column + 2].set_xlabel("Time (s)")
        axes[0].set_ylabel("Compressive stress (kPa)")
        axes[2].set_ylabel("Stress over its peak (–)")
    alt = "Compressive stress of a cube against time for this study's tissues and published ones"
    caption = (
        "Figures 8 and 9 of the paper for this study. Above: Cauchy stress along the compression, positive "
        "when pushing; below: the same over its own peak, which shows how fast each tissue relaxes."
    )
    return Figure("cube", svg(drawing, "cube", alt), caption)


def _draw(above: Axes, below: Axes, rows: list[Json], content: Json) -> None:
    time = np.array([0.0, *content["time_s"]])
    own, others = iter(_OWN * len(rows)), iter(_OTHERS * len(rows))
    for row in rows:
        mine = row["source"] == "this study"
        color, line = next(own if mine else others)
        stress = np.array([0.0, *content["stress_kPa"][row["tissue"]]])
        style: dict[str, Any] = {"color": color, "ls": line, "lw": 2.2 if mine else 1.3}
        above.plot(time, stress, label=row["tissue"], **style)
        below.plot(time, stress / stress.max(), **style)
    above.legend(fontsize=7, loc="upper right")
    for ax in (above, below):
        ax.axhline(0.0, color=MUTED, lw=0.8)
        ax.margins(x=0.01)


def _table(content: Json) -> Table:
    head = (
        "Tissue", "Published or identified values", "Shear modulus, long-term (kPa)", "Instantaneous (kPa)",
        "Largest stress (kPa)", "Back at its height (kPa)", "After the hold (kPa)", "J",
        "How it was put into the law", "Source",
    )  # fmt: skip
    rows = tuple(_row(row) for row in content["tissues"])
    caption = (
        "Tissues of the cube. Moduli are those of small strains; J is the range of the ratio of volumes. The "
        "Ogden terms of each are in cube.json."
    )
    return Table("cube", caption, head, rows)


def _row(row: Json) -> Row:
    numbers = (
        number(row["shear_modulus_kPa"]),
        number(row["instantaneous_modulus_kPa"]),
        number(row["peak_kPa"]),
        number(row["back_kPa"]),
        number(row["end_kPa"]),
        f"{fixed(row['J_min'], 4)} to {fixed(row['J_max'], 4)}",
    )
    words = (Cell(row["conversion"]), Cell(row["source"]))
    cells = (heading(row["tissue"]), Cell(row["values"]), *map(numeric, numbers), *words)
    return Row(cells, marked=row["source"] == "this study")
