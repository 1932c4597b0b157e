"""Matplotlib drawings as inline SVG that follows the page's light or dark theme."""

import io
import math
import re
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure as Drawing

from ...arrays import Array
from ..page import Figure
from ..words import make_picture, write_words
from .colours import GRID, INK, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH, VARIABLES

PANEL_WIDTH_IN = 9.6
POINT_PX = 1.5  # a drawing of 9.6 in fills the page; smaller ones keep the same size of letters
# Tissues, outermost first, are told apart by marker and line too; from the fifth on colours come again.
_COLOURS, _MARKERS = (SIMULATED, ONE_MATERIAL, THIRD, INK), ("o", "s", "^", "D", "v", "P", "X")
_LINES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (8, 2)))
_TRUE_LINES: tuple[Any, ...] = (":", "-.", (0, (6, 2)), (0, (1, 3)), (0, (3, 1, 1, 1, 1, 1)))
_STYLE = matplotlib.rc_params_from_file(
    Path(__file__).with_name("report.mplstyle"), use_default_template=False
)
_STYLE.update(dict.fromkeys(("axes.labelcolor", "text.color", "xtick.color", "ytick.color"), INK))
_STYLE.update({"axes.edgecolor": MUTED, "grid.color": GRID})
styled = matplotlib.rc_context(_STYLE)  # decorates whatever draws


def choose_tissue_style(index: int) -> dict[str, Any]:
    """Colour, marker and line of the curve of a tissue."""
    return {
        "color": _COLOURS[index % len(_COLOURS)],
        "marker": _MARKERS[index % len(_MARKERS)],
        "ls": _LINES[index % len(_LINES)],
    }


def choose_truth_style(index: int) -> dict[str, Any]:
    """Colour and line of the true value of a tissue's parameter."""
    return {"color": TRUTH, "ls": _TRUE_LINES[index % len(_TRUE_LINES)]}


def make_panels(count: int, columns: int, height_in: float) -> tuple[Drawing, list[Axes]]:
    """A drawing of ``count`` panels in rows of ``columns``."""
    columns = min(columns, count)
    rows = math.ceil(count / columns)
    width = PANEL_WIDTH_IN if columns > 1 else PANEL_WIDTH_IN / 1.6
    drawing = Drawing(figsize=(width, rows * height_in + 0.4), layout="constrained")
    axes = [drawing.add_subplot(rows, columns, i + 1) for i in range(count)]
    for patch in (drawing.patch, *(ax.patch for ax in axes)):
        patch.set_alpha(0)
    return drawing, axes


def add_legend(drawing: Drawing, *axes: Axes, columns: int | None = None) -> None:
    """The legend of some panels over all of them, each label once."""
    named: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    handles, columns = list(named.values()), columns or len(named)
    drawing.legend(handles, list(named), loc="outside upper left", ncols=columns, labelcolor=INK)


def label_outer(axes: Sequence[Axes], columns: int, x: str, y: str) -> None:
    """Name the axes at the outer panels of rows of ``columns``: x at the bottom, y at the left."""
    for i, ax in enumerate(axes):
        if i + columns >= len(axes):
            ax.set_xlabel(x)
        if i % columns == 0:
            ax.set_ylabel(y)


def set_log_scale(ax: Axes, minor: bool = False) -> None:
    """A logarithmic x axis with plain numbers; with ``minor`` at 2 and 5 too."""
    ax.set_xscale("log")
    format_log_axis(ax.xaxis, minor)


def format_log_axis(axis: Axis, minor: bool) -> None:
    """Plain numbers at the ticks of a logarithmic axis; with ``minor`` at 2 and 5 too."""
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    named = "25" if minor else ""
    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in named else "")


def set_rows(ax: Axes, names: Sequence[str]) -> None:
    """Rows by their names, the first one at the top."""
    ax.set_yticks(range(len(names)), names)
    ax.invert_yaxis()
    ax.grid(visible=False, axis="y")


def plot_band(ax: Axes, x: Array, low: Array, high: Array) -> None:
    """A 95 % interval over x."""
    ax.fill_between(x, low, high, color=SIMULATED, alpha=0.22, lw=0, label="95 % interval")


def make_figure(drawing: Drawing, name: str, *, words: str = "", **facts: Any) -> Figure:
    """The drawing as a figure of the page: inline ``<svg>`` whose identifiers are unique to ``name``.

    What it shows is told by ``alt <name>`` and ``figure <name>``, or those of other ``words``.
    """
    buffer = io.StringIO()
    FigureCanvasSVG(drawing).print_svg(buffer, metadata={"Date": None, "Creator": None})
    alt = write_words(f"alt {words or name}", **facts)
    return make_picture(name, _make_inline(buffer.getvalue(), name, alt), words=words, **facts)


def _make_inline(text: str, name: str, alt: str) -> str:
    """Strip what a standalone SVG needs and an inline one does not; make colours and names the page's."""
    body = text[text.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL)
    body = body.replace("xlink:href", "href")
    body = re.sub(r'(\sid="|url\(#|href="#)', rf"\g<1>{name}-", body)
    for sentinel, (variable, _) in VARIABLES.items():
        body = body.replace(sentinel, variable)
    body = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", body)
    box = re.search(r'viewBox="([^"]*)"', body[: body.index(">")])
    inside = body[body.index(">") + 1 :]
    view = box.group(1) if box else "0 0 100 100"
    width = float(view.split()[2]) * POINT_PX
    head = f'<svg viewBox="{view}" style="max-width:{width:.0f}px" role="img"><title>{escape(alt)}</title>'
    return head + inside.strip()


def make_standalone(markup: str) -> str:
    """An inline drawing as the text of an SVG file: on white, with its own colours and letters."""
    for variable, colour in VARIABLES.values():
        markup = markup.replace(variable, colour)
    left, top, width, height = markup[markup.index('viewBox="') + 9 :].split('"', 1)[0].split()
    size = f'width="{float(width):g}pt" height="{float(height):g}pt" font-family="DejaVu Sans, sans-serif"'
    names = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    start = markup.index(">") + 1
    page = f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="#ffffff"/>'
    head = re.sub(r' style="[^"]*"', "", markup[:start].replace("<svg ", f"<svg {names} {size} ", 1))
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{head}{page}{markup[start:]}\n'
