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
_WIDTH_IN = 12.0
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
    overview = [(k, f"slice {k}", "normal") for k in _choose_slices(turned.limb)]
    suspects = [(k, f"slice {k}: {text}", "bold") for k, text in _choose_suspects(quality)]
    parts = [(_COLUMNS, overview), *([(_SUSPECT_COLUMNS, suspects)] if suspects else [])]
    height, width = (part.stop - part.start for part in window)
    ratio = float(width * turned.spacing[0] / (height * turned.spacing[1]))
    rows = [-(-len(slices) // columns) for columns, slices in parts]
    heights = [count * (_WIDTH_IN / columns / ratio + 0.25) for count, (columns, _) in zip(rows, parts)]
    figure = Figure(figsize=(_WIDTH_IN, 0.5 + sum(heights)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    places = figure.subfigures(len(parts), 1, squeeze=False, height_ratios=heights).ravel()
    for place, count, (columns, slices) in zip(places, rows, parts, strict=True):
        axes = place.subplots(count, columns, squeeze=False).ravel()
        for ax in axes:
            ax.axis("off")
        for ax, (k, title, weight) in zip(axes, slices):
            _draw(ax, image, masks, colours, k, window)
            ax.set_title(title, fontsize=8, pad=2, fontweight=weight)
    handles = [Line2D([], [], color=colours[name], label=name) for name in masks]
    figure.legend(handles=handles, loc="outside upper center", ncol=len(handles), frameon=False, fontsize=10)
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
    axes: Axes, image: Volume, masks: dict[str, Mask], colours: dict[str, str], k: int, window: Box
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
