"""Colours, and matplotlib drawings as inline SVG that follows the page's light or dark theme.

Curves are drawn in *sentinel* colours that the finished SVG turns into CSS variables; the page's style
sheet gives them their light, dark and printed values. The palette is that of Okabe and Ito (2008), which
people with any colour-vision deficiency can tell apart.
"""

from __future__ import annotations

import io
import re
from html import escape
from typing import Any

import matplotlib
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Drawing

INK, GRID, MUTED = "#010101", "#010102", "#010103"
MEASURED, SIMULATED, ONE_MATERIAL, TRUTH = "#010104", "#010105", "#010106", "#010107"
THIRD = "#010108"
FITTED, HELD_OUT = SIMULATED, ONE_MATERIAL
# Tissues, outermost first, are told apart by marker and line too; from the fifth on colours come again.
_COLOURS, _MARKERS = (SIMULATED, ONE_MATERIAL, THIRD, INK), ("o", "s", "^", "D", "v", "P", "X")
_LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (8, 2)))
_TRUE_LINES: tuple[Any, ...] = (":", "-.", (0, (6, 2)), (0, (1, 3)), (0, (3, 1, 1, 1, 1, 1)))
POINT_PX = 1.5  # a drawing of 9.6 in fills the page; smaller ones keep the same size of letters
_VARIABLES = {
    INK: "--ink",
    GRID: "--grid",
    MUTED: "--muted",
    MEASURED: "--measured",
    SIMULATED: "--simulated",
    ONE_MATERIAL: "--one-material",
    TRUTH: "--truth",
    THIRD: "--third",
}

STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "limbfit",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "text.parse_math": False,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.unicode_minus": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


def tissue_style(index: int) -> dict[str, Any]:
    """Colour, marker and line of the curve of a tissue."""
    return {
        "color": _COLOURS[index % len(_COLOURS)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "ls": _LINES[index % len(_LINES)],
    }


def truth_style(index: int) -> dict[str, Any]:
    """Colour and line of the true value of a tissue's parameter."""
    return {"color": TRUTH, "ls": _TRUE_LINES[index % len(_TRUE_LINES)]}


def svg(drawing: Drawing, name: str, alt: str) -> str:
    """The drawing as one inline ``<svg>`` element whose identifiers are unique to ``name``."""
    buffer = io.StringIO()
    with matplotlib.rc_context(STYLE):
        FigureCanvasSVG(drawing).print_svg(buffer, metadata={"Date": None, "Creator": None})
    return themed(buffer.getvalue(), name, alt)


def themed(text: str, name: str, alt: str) -> str:
    """Strip what a standalone SVG needs and an inline one does not; make colours and names the page's."""
    body = text[text.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    body = body.replace("xlink:href", "href")
    body = re.sub(r'(\sid="|url\(#|href="#)', rf"\g<1>{name}-", body)
    for sentinel, variable in _VARIABLES.items():
        body = body.replace(sentinel, f"var({variable})")
    body = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", body)
    box = re.search(r'viewBox="([^"]*)"', body[: body.index(">")])
    inside = body[body.index(">") + 1 :]
    view = box.group(1) if box else "0 0 100 100"
    width = float(view.split()[2]) * POINT_PX
    head = f'<svg viewBox="{view}" style="max-width:{width:.0f}px" role="img"><title>{escape(alt)}</title>'
    return head + inside.strip()
