"""The cube in uniaxial compression: the paper's figures 8 (skin) and 9 (muscle)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...results.variants import CubeResult, CubeTissue
from ..drawing.colours import INK, MEASURED, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH
from ..drawing.plots import make_figure, make_panels, make_standalone, styled
from ..page import Figure, Section
from ..store import Results
from ..words import make_prose, make_section, make_table

KINDS = {"skin": "Figure 8. Skin, adipose tissue", "muscle": "Figure 9. Muscle, soft tissue below the skin"}
_OWN = ((SIMULATED, "-"), (THIRD, "-"), (INK, "-"))
_OTHERS = ((ONE_MATERIAL, "--"), (TRUTH, "-."), (THIRD, (0, (6, 2))), (MUTED, ":"), (MEASURED, (0, (1, 2))))


def make_cube_section(store: Results, content: CubeResult) -> Section:
    """What the experiment ``cube`` found."""
    words = make_prose("cube", content=content, own=filter(_is_own, content.tissues))
    table = make_table("cube", content.tissues, marked=_is_own)
    return make_section("cube", words, draw_cube_figure(content), table)


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
    return make_figure(drawing, "cube")


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
