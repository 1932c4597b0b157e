"""Pictures beside each other, as inline SVG for the report and as PNG files.

Names, arrows, scale bars and sides of the body are set over the pictures and not burnt into them: what is
drawn where follows from each picture's parallel projection.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import matplotlib.image
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Drawing
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from ...arrays import Array
from ..formats import number

PAPER, INK = "#f6f5f1", "#222222"
FIELD_MAP = "viridis"


@dataclass(frozen=True)
class View:
    """A parallel projection: ``direction`` is where the camera looks, ``size`` is in pixels."""

    focal: Array
    direction: Array
    up: Array
    half_height_mm: float
    size: tuple[int, int]

    @property
    def right(self) -> Array:
        return np.cross(self.direction, self.up)

    @property
    def pixels_per_mm(self) -> float:
        return self.size[1] / (2 * self.half_height_mm)

    def project(self, points: Array) -> Array:
        """Pixels (n, 2), the origin at the top left, of points (n, 3) in mm."""
        offset = np.atleast_2d(points) - self.focal
        axes = np.column_stack([self.right, -self.up])
        return offset @ axes * self.pixels_per_mm + np.array(self.size) / 2


@dataclass(frozen=True)
class Mark:
    """A point of a picture with its name; ``axis`` (into the limb) is drawn as an arrow when given."""

    text: str
    position: Array
    color: str
    filled: bool = True
    axis: Array | None = None


Shot = tuple[Array, View, list[Mark]]


def embed_png(data: bytes) -> str:
    """A picture as the address of an image."""
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


_GAP, _TITLE = 14, 46


def build_picture_row(shots: Sequence[Shot], titles: Sequence[str], alt: str) -> str:
    """Pictures side by side in one SVG, with titles, labelled marks and a scale bar in each."""
    width = sum(view.size[0] for _, view, _ in shots) + _GAP * (len(shots) - 1)
    height = max(view.size[1] for _, view, _ in shots) + _TITLE
    parts, x = [], 0
    for (pixels, view, marks), title in zip(shots, titles, strict=True):
        parts.append(f'<g transform="translate({x} 0)">{_draw_svg_panel(pixels, view, marks, title)}</g>')
        x += view.size[0] + _GAP
    head = f'<svg class="picture" viewBox="0 0 {width} {height}" role="img"><title>{escape(alt)}</title>'
    return head + "".join(parts) + "</svg>"


def _draw_svg_panel(pixels: Array, view: View, marks: list[Mark], title: str) -> str:
    w, h = view.size
    buffer = io.BytesIO()
    matplotlib.image.imsave(buffer, pixels, format="png")
    image = f'<image href="{embed_png(buffer.getvalue())}" width="{w}" height="{h}"/>'
    text = f'<text class="panel-title" x="2" y="{_TITLE - 12}">{escape(title)}</text>'
    over = _draw_labels(view, marks) + _draw_scale_bar(view)
    return f'{text}<g transform="translate(0 {_TITLE})">{image}{over}</g>'


def _draw_labels(view: View, marks: list[Mark]) -> str:
    """Dots, arrows and names; names stand right of their dot and give way to each other downwards."""
    parts = [_draw_arrow(view, mark) for mark in marks if mark.axis is not None]
    dots = [mark for mark in marks if mark.axis is None]
    for mark, name_y in zip(*_place_labels(view, dots), strict=True):
        x, y = (float(v) for v in view.project(mark.position)[0])
        fill = mark.color if mark.filled else PAPER
        parts.append(f'<circle cx="{x:.0f}" cy="{y:.0f}" r="9" fill="{fill}" stroke="{mark.color}"/>')
        parts.append(f'<text class="site" x="{x + 15:.0f}" y="{name_y + 11:.0f}">{escape(mark.text)}</text>')
    return "".join(parts)


def _draw_arrow(view: View, mark: Mark) -> str:
    assert mark.axis is not None
    tip = view.project(mark.position)[0]
    step = view.project(mark.position + mark.axis)[0] - tip
    step = step / np.linalg.norm(step)
    side = np.array([-step[1], step[0]])
    tail, wing = tip - 70 * step, tip - 22 * step
    head = " ".join(f"{p[0]:.0f},{p[1]:.0f}" for p in (tip, wing + 10 * side, wing - 10 * side))
    shaft = f'x1="{tail[0]:.0f}" y1="{tail[1]:.0f}" x2="{wing[0]:.0f}" y2="{wing[1]:.0f}"'
    line = f'<line {shaft} stroke="{mark.color}" stroke-width="6"/>'
    return f'{line}<polygon points="{head}" fill="{mark.color}"/>'


def _choose_scale_mm(view: View) -> int:
    return next(mm for mm in (50, 20, 10, 5) if mm * view.pixels_per_mm < 0.4 * view.size[0])


def _draw_scale_bar(view: View) -> str:
    length = _choose_scale_mm(view)
    w, (right, bottom) = length * view.pixels_per_mm, (view.size[0] - 14, view.size[1] - 14)
    line = f'<line x1="{right - w:.1f}" y1="{bottom}" x2="{right}" y2="{bottom}" class="scale"/>'
    return f'{line}<text class="scale-text" x="{right}" y="{bottom - 10}">{length} mm</text>'


def build_legend(entries: Iterable[tuple[str, str]]) -> str:
    items = "".join(
        f'<span><i class="swatch" style="background:{color}"></i>{escape(text)}</span>'
        for text, color in entries
    )
    return f'<div class="legend">{items}</div>'


def make_colour_bar(limits: tuple[float, float], title: str, colours: str = FIELD_MAP) -> str:
    stops = ", ".join(
        "#" + "".join(f"{round(255 * v):02x}" for v in colormaps[colours](t)[:3])
        for t in np.linspace(0, 1, 9)
    )
    bar = f'<i class="colour-bar" style="background:linear-gradient(90deg, {stops})"></i>'
    low, high = (number(value) for value in limits)
    return f'<div class="legend"><span>{low}</span>{bar}<span>{high}</span><span>{escape(title)}</span></div>'


# ---- pictures as PNG ------------------------------------------------------------------------------------

_DPI, _PANEL_IN = 110, 4.6  # height of a row of panels
_AXIS_MM = 14.0
_HALO = [withStroke(linewidth=2.5, foreground=PAPER)]
_SIDES = (("L", "R"), ("P", "A"), ("S", "I"))  # towards which an axis of patient space points, and from which


@dataclass(frozen=True)
class PictureRow:
    """Panels side by side under their titles; a colour bar beside them where ``bar`` has limits and title."""

    shots: Sequence[Shot]
    titles: Sequence[str]
    bar: tuple[tuple[float, float], str] | None = None


def make_key(text: str, color: str, dot: bool = False, filled: bool = True) -> Patch | Line2D:
    """An entry of a legend: a patch, or a dot (``filled`` or open) where ``dot``."""
    if not dot:
        return Patch(facecolor=color, edgecolor=INK, linewidth=0.4, label=text)
    return Line2D([], [], ls="", marker="o", mfc=color if filled else "white", mec=color, ms=8, label=text)


def build_figure_sheet(
    title: str, rows: Sequence[PictureRow], keys: Sequence[Patch | Line2D], spare_in: float = 0.0
) -> Drawing:
    """Rows of pictures on one sheet with a title and a legend; every picture has a scale and its sides.

    ``spare_in`` inches above the legend are left free.
    """
    widths = [sum(view.size[0] / view.size[1] for _, view, _ in row.shots) for row in rows]
    height = _PANEL_IN * len(rows) + 0.9 + spare_in
    width = _PANEL_IN * max(widths) + (0.9 if any(row.bar for row in rows) else 0.1)
    margin = 0.85 / width if any(row.bar for row in rows) else 0.01
    drawing = Drawing(figsize=(width, height), dpi=_DPI, facecolor="white")
    FigureCanvasAgg(drawing)
    drawing.suptitle(title, x=0.01, y=1 - 0.1 / height, ha="left", va="top", fontsize=13)
    inside = {
        "left": 0.01,
        "right": 1 - margin,
        "top": 1 - 0.55 / height,
        "bottom": (0.4 + spare_in) / height,
    }
    grid = drawing.add_gridspec(len(rows), 1, hspace=0.07, **inside)
    for at, row in enumerate(rows):
        shares = [view.size[0] / view.size[1] for _, view, _ in row.shots]
        inner = grid[at].subgridspec(1, len(shares), width_ratios=shares, wspace=0.03)
        axes = [drawing.add_subplot(inner[0, column]) for column in range(len(shares))]
        for ax, (pixels, view, marks), name in zip(axes, row.shots, row.titles, strict=True):
            _draw_panel(ax, pixels, view, marks, name)
        if row.bar is not None:
            shades = ScalarMappable(Normalize(*row.bar[0]), FIELD_MAP)
            box = axes[-1].get_position()
            place = (1 - margin + 0.006, box.y0 + 0.1 * box.height, 0.011, 0.8 * box.height)
            drawing.colorbar(shades, cax=drawing.add_axes(place), label=row.bar[1])
    if keys:
        drawing.legend(handles=list(keys), loc="lower left", ncols=len(keys), frameon=False, fontsize=10)
    return drawing


def write_png(drawing: Drawing, file: Path) -> None:
    """Store a drawing; the file appears when it is whole."""
    draft = file.with_suffix(".part")
    drawing.savefig(draft, format="png", dpi=_DPI)
    draft.replace(file)


def _draw_panel(ax: Axes, pixels: Array, view: View, marks: list[Mark], title: str) -> None:
    w, h = view.size
    ax.imshow(pixels, extent=(0, w, h, 0), interpolation="antialiased")
    ax.set(xlim=(0, w), ylim=(h, 0), xticks=[], yticks=[])
    ax.set_title(title, fontsize=10, loc="left", pad=3)
    for spine in ax.spines.values():
        spine.set_visible(False)
    for mark, name_y in zip(*_place_labels(view, marks), strict=True):
        x, y = view.project(mark.position)[0]
        face = mark.color if mark.filled else PAPER
        ax.plot(x, y, "o", ms=6, mfc=face, mec=mark.color, mew=1.4)
        if mark.axis is not None:
            x, name_y = view.project(mark.position - _AXIS_MM * mark.axis)[0]
            tip = view.project(mark.position)[0]
            arrow = {"arrowstyle": "-|>", "color": mark.color, "lw": 1.6, "shrinkA": 0, "shrinkB": 3}
            ax.annotate("", xy=(tip[0], tip[1]), xytext=(x, name_y), arrowprops=arrow)
        ax.text(x + 0.014 * h, name_y, mark.text, fontsize=10, va="center", color=INK, path_effects=_HALO)
    right = np.array([view.right, -view.up])
    for (dx, dy), direction in zip(((1, 0), (0, 1)), right, strict=True):
        for sign in (1, -1):
            x, y = (0.5 + sign * dx * 0.475) * w, (0.5 + sign * dy * 0.478) * h
            ax.text(x, y, _name_side(sign * direction), fontsize=9, ha="center", va="center", color="#5a5a5a")
    length = _choose_scale_mm(view)
    end, base = 0.97 * w, 0.965 * h
    ax.plot([end - length * view.pixels_per_mm, end], [base, base], color=INK, lw=2)
    ax.text(end, base - 0.012 * h, f"{length} mm", fontsize=9, ha="right", va="bottom", color=INK)


def _place_labels(view: View, marks: Sequence[Mark]) -> tuple[list[Mark], list[float]]:
    """Marks from top to bottom, and the heights (pixels) at which their names do not touch."""
    ordered = sorted(marks, key=lambda m: float(view.project(m.position)[0, 1]))
    placed: list[tuple[float, float]] = []
    line = 0.036 * view.size[1]
    for mark in ordered:
        x, y = (float(v) for v in view.project(mark.position)[0])
        while any(abs(y - py) < line and abs(x - px) < line * (1 + len(mark.text)) for px, py in placed):
            y += line / 8
        placed.append((x, y))
    return ordered, [y for _, y in placed]


def _name_side(direction: Array) -> str:
    """The letter of the side of the body to which a direction (LPS) points."""
    axis = int(np.abs(direction).argmax())
    return _SIDES[axis][0 if direction[axis] > 0 else 1]
