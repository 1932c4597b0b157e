"""Colours, and matplotlib drawings as inline SVG that follows the page's light or dark theme.

Curves are drawn in *sentinel* colours that the finished SVG turns into CSS variables; the page's style
sheet gives them their light, dark and printed values. The palette is that of Okabe and Ito (2008), which
people with any colour-vision deficiency can tell apart.
"""

from __future__ import annotations

import io
import math
import re
from html import escape
from typing import Any

import matplotlib
from matplotlib.axes import Axes
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
PANEL_WIDTH_IN = 9.6
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


def panels(count: int, columns: int, height_in: float) -> tuple[Drawing, list[Axes]]:
    """A drawing of ``count`` panels in rows of ``columns``."""
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    width = PANEL_WIDTH_IN if columns > 1 else PANEL_WIDTH_IN / 1.6
    with matplotlib.rc_context(STYLE):
        drawing = Drawing(figsize=(width, rows * height_in + 0.4), layout="constrained")
        axes = [drawing.add_subplot(rows, columns, i + 1) for i in range(count)]
    drawing.patch.set_alpha(0)
    for ax in axes:
        ax.patch.set_alpha(0)
    return drawing, axes


def legend_above(drawing: Drawing, ax: Axes, columns: int | None = None) -> None:
    """The legend of one panel over all of them."""
    handles, labels = ax.get_legend_handles_labels()
    drawing.legend(handles, labels, loc="outside upper left", ncols=columns or len(labels), labelcolor=INK)


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


# The light theme of report.css, for drawings that leave the page.
_LIGHT = {
    "--ink": "#1c2126",
    "--grid": "#e3e5e8",
    "--muted": "#6a737c",
    "--measured": "#1c2126",
    "--simulated": "#0072b2",
    "--one-material": "#c45500",
    "--truth": "#00795a",
    "--third": "#cc79a7",
}


def standalone(markup: str) -> str:
    """An inline drawing as the text of an SVG file: on white, with its own colours and letters."""
    for variable, colour in _LIGHT.items():
        markup = markup.replace(f"var({variable})", colour)
    left, top, width, height = markup[markup.index('viewBox="') + 9 :].split('"', 1)[0].split()
    size = f'width="{float(width):g}pt" height="{float(height):g}pt" font-family="DejaVu Sans, sans-serif"'
    names = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    start = markup.index(">") + 1
    page = f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="#ffffff"/>'
    head = re.sub(r' style="[^"]*"', "", markup[:start].replace("<svg ", f"<svg {names} {size} ", 1))
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{head}{page}{markup[start:]}\n'
