"""The quality sheet of a segmentation as one picture: outlines over slices; slices to look at, enlarged."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ...anatomy.grid import FAT, SOFT_TISSUE, LabelMap, Volume
from ...anatomy.labels.labelcheck import LIMB
from ...anatomy.labels.labelfiles import find_outlines
from ...anatomy.morphology import Box, find_box
from ...results.limb import QualityResult

Mask = NDArray[np.bool_]

COLOURS = {LIMB: "#e34a33", FAT: "#f28e2b", "tibia": "#3bb2d0", "fibula": "#f4c542"}
_OTHERS = ("#76d275", "#c58af9", "#ff9da7", "#9aa0ff")
_COLUMNS, _ROWS = 6, 3
_SUSPECT_COLUMNS = 3  # suspects in a row
_MAX_SUSPECTS = 6  # suspects drawn
_MARGIN = 4  # voxels around the limb


def draw_sheet(path: str | Path, volume: Volume, labels: LabelMap, quality: QualityResult) -> None:
    """Write the picture (PNG): slices from end to end, below them the suspects of the measures."""
    axis = "ijk".index(quality.axis)
    image, turned = volume.turn_along(axis), labels.turn_along(axis)
    window = find_box(turned.limb, _MARGIN)[1:]
    names = [name for name in turned.names.values() if name != SOFT_TISSUE]
    masks = {LIMB: turned.limb} | {name: turned.mask(name) for name in names}
    others = iter(_OTHERS * len(masks))
    colours = {name: COLOURS.get(name) or next(others) for name in masks}
    shown = _choose_slices(turned.limb)
    odd = _choose_suspects(quality)
    large_rows = -(-len(odd) // _SUSPECT_COLUMNS)
    height, width = (part.stop - part.start for part in window)
    ratio = float(width * turned.spacing[0] / (height * turned.spacing[1]))
    small, large = 12 / _COLUMNS / ratio + 0.25, 12 / _SUSPECT_COLUMNS / ratio + 0.3
    rows = -(-len(shown) // _COLUMNS)
    figure = Figure(figsize=(12, 0.9 + rows * small + large_rows * large), facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        rows + large_rows,
        _COLUMNS,
        height_ratios=[small] * rows + [large] * large_rows,
        **{"left": 0.01, "right": 0.99, "top": 1 - 0.5 / figure.get_figheight(), "bottom": 0.01},
        wspace=0.04,
        hspace=0.14,
    )
    span = _COLUMNS // _SUSPECT_COLUMNS
    for n, k in enumerate(shown):
        axes = figure.add_subplot(grid[n // _COLUMNS, n % _COLUMNS])
        _draw(axes, image, masks, colours, k, window, f"slice {k}")
    for n, (k, text) in enumerate(odd):
        place = (n % _SUSPECT_COLUMNS) * span
        axes = figure.add_subplot(grid[rows + n // _SUSPECT_COLUMNS, place : place + span])
        _draw(axes, image, masks, colours, k, window, f"slice {k}: {text}", bold=True)
    handles = [Line2D([], [], color=colours[name], label=name) for name in masks]
    figure.legend(handles=handles, loc="upper center", ncol=len(handles), frameon=False, fontsize=10)
    figure.savefig(path, dpi=100, metadata={"Software": "limbfit"})


def _choose_slices(limb: Mask) -> list[int]:
    """Slices from the limb's first to its last."""
    filled = np.flatnonzero(limb.any(axis=(1, 2)))
    count = min(_COLUMNS * _ROWS, len(filled))
    return [int(filled[n]) for n in np.unique(np.linspace(0, len(filled) - 1, count).round().astype(int))]


def _choose_suspects(quality: QualityResult) -> list[tuple[int, str]]:
    """Slices to look at with what is odd there, at most six, evenly taken from all."""
    texts: dict[int, list[str]] = {}
    for suspect in quality.suspects:
        texts.setdefault(suspect.slice, []).append(f"{suspect.label} {suspect.what}")
    slices = sorted(texts)
    if len(slices) > _MAX_SUSPECTS:
        slices = [slices[n] for n in np.linspace(0, len(slices) - 1, _MAX_SUSPECTS).round().astype(int)]
    return [(k, "; ".join(texts[k][:2])) for k in slices]


def _draw(
    axes: Axes,
    image: Volume,
    masks: dict[str, Mask],
    colours: dict[str, str],
    k: int,
    window: Box,
    title: str,
    bold: bool = False,
) -> None:
    """One slice with the outlines of its labels."""
    rows, columns = window
    plane = image.array[k][window]
    low, high = np.percentile(image.array[k], (1, 99.7))
    extent = (columns.start - 0.5, columns.start + plane.shape[1] - 0.5)
    heights = (rows.start + plane.shape[0] - 0.5, rows.start - 0.5)
    shades: dict[str, Any] = {"cmap": "gray", "vmin": low, "vmax": max(high, low + 1e-6)}
    axes.imshow(plane, extent=(*extent, *heights), origin="upper", **shades)
    for name, mask in masks.items():
        for line in find_outlines(mask[k]):
            closed = np.vstack([line, line[:1]])
            axes.plot(closed[:, 0], closed[:, 1], color=colours[name], linewidth=0.8)
    axes.set_xlim(*extent)
    axes.set_ylim(*heights)
    axes.set_aspect(float(image.spacing[1] / image.spacing[0]))
    axes.set_title(title, fontsize=8, pad=2, fontweight="bold" if bold else "normal")
    axes.axis("off")
