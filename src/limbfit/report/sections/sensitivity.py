"""What the experiments of sensitivity found: c, bulk modulus, friction, indenter and mesh."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...results.variants import (
    FrictionResult,
    IndenterResult,
    RefinementResult,
    StiffnessResult,
    VariantRun,
    VariedSite,
    VolumeResult,
)
from ..drawing.colours import GRID, INK, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH, choose_tissue_style
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..formats import format_fixed
from ..page import Bullets, Figure, Section, make_bullets, make_section
from ..store import Results
from ..tables import make_table
from ..words import make_prose, write_words

_COLOURS = (SIMULATED, ONE_MATERIAL, TRUTH, THIRD, MUTED, INK)
_LINES: tuple[Any, ...] = ("-", "--", "-.", (0, (6, 2)), ":", "-")
_STYLES = tuple(zip(_COLOURS, _LINES, strict=True))
Compared = StiffnessResult | VolumeResult | FrictionResult | IndenterResult | RefinementResult
_RANGE = ("J_min", "J_low", "J_high", "J_max")


def make_stiffness_section(store: Results, content: StiffnessResult) -> Section:
    """Force against c of each tissue at equal m, at thin and thick sites, and its derivatives everywhere."""
    name = "sensitivity-c"
    return make_section(
        name,
        "Sensitivity to the stiffness of the tissues",
        make_prose(name, content=content),
        make_prose("leading tissues", found=_find_leading_tissues(content)),
        _draw_stiffness_figure(store, content),
        make_table(name, content.runs, marked="base"),
        make_table("sensitivity-c-local", content.local, content=content),
        _list_warnings(content),
    )


def _format_role(row: VariedSite, form: str) -> str:
    return form.format(row.role) if row.role else ""


def _find_leading_tissues(content: StiffnessResult) -> dict[str, dict[str, float]]:
    """The largest change of the force by each tissue, by site: whether thin and thick sites differ in it."""
    found: dict[str, dict[str, float]] = {}
    for row in content.runs:
        if row.tissue and row.peak_change_percent is not None:
            changes = found.setdefault(row.site, {})
            changes[row.tissue] = max(changes.get(row.tissue, 0.0), abs(row.peak_change_percent))
    return {site: changes for site, changes in found.items() if len(changes) > 1}


@styled
def _draw_stiffness_figure(store: Results, content: StiffnessResult) -> Figure:
    sites = content.sites[:2]
    drawing, axes = make_panels(len(sites) + 1, len(sites) + 1, 2.9)
    tissues = list(content.parameters)
    for ax, site in zip(axes, sites, strict=False):
        _draw_curves(ax, store, "sensitivity-c", site, content)
    _draw_derivatives(axes[-1], content, tissues)
    axes[0].set_ylabel("Force (N)")
    add_legend(drawing, axes[0], columns=5)
    return make_figure(drawing, "sensitivity-c")


def _draw_curves(ax: Axes, store: Results, name: str, site: VariedSite, content: Compared) -> None:
    """Force against time of every variant of a site."""
    curves = store.curves(name, site.site) or {}
    rows = [row for row in content.runs if row.site == site.site and row.completed]
    heads = [head for head in curves if head.endswith("_N")]
    for i, (row, head) in enumerate(zip(rows, heads, strict=False)):
        color, line = (INK, "-") if row.base else _STYLES[i % len(_STYLES)]
        ax.plot(curves["time_s"], curves[head], color=color, ls=line, label=_name_model(row))
    ax.set_title(f"site {site.site}{_format_role(site, ', {}')}: {format_fixed(site.tissue_mm)} mm of tissue")
    ax.set_xlabel("Time (s)")
    ax.margins(x=0.01)


def _draw_derivatives(ax: Axes, content: StiffnessResult, tissues: Sequence[str]) -> None:
    for i, tissue in enumerate(tissues):
        rows = [row for row in content.local if row.peak_percent_per_percent[tissue] is not None]
        depth = [row.tissue_mm for row in rows]
        slope = np.array([row.peak_percent_per_percent[tissue] for row in rows], dtype=float)
        style = choose_tissue_style(i)
        ax.plot(depth, slope, ls="", marker=style["marker"], color=style["color"], label=tissue)
    ax.set_title("% of force for 1 % of c")
    ax.set_xlabel("Tissue to the nearest bone (mm)")
    ax.set_ylim(0.0, 1.1 * max(ax.get_ylim()[1], 0.1))
    ax.legend(fontsize=8)


def make_kappa_section(store: Results, content: VolumeResult) -> Section:
    """The ratio of bulk modulus to c, and the change of volume that it allows."""
    name, element = "sensitivity-kappa", store.calibration.element if store.calibration else None
    return make_section(
        name,
        "Sensitivity to the bulk modulus",
        make_prose(name, content=content, element=element),
        _draw_kappa_figure(content),
        make_table(name, content.runs, marked="base"),
        _list_warnings(content),
    )


@styled
def _draw_kappa_figure(content: VolumeResult) -> Figure:
    drawing, axes = make_panels(2, 2, 2.7)
    for i, site in enumerate(content.sites):
        color, line = _STYLES[i % len(_STYLES)]
        rows = [row for row in content.runs if row.site == site.site and row.completed]
        ratio = [row.kappa_ratio for row in rows]
        known = {key: [getattr(row, key) for row in rows] for key in ("peak_force_N", *_RANGE)}
        style: dict[str, Any] = {"color": color, "ls": line, "marker": "o", "ms": 4}
        label = f"site {site.site}{_format_role(site, ', {}')}"
        axes[0].plot(ratio, known["peak_force_N"], label=label, **style)
        axes[1].fill_between(ratio, known["J_min"], known["J_max"], color=color, alpha=0.15, lw=0)
        axes[1].plot(ratio, known["J_low"], ratio, known["J_high"], **style)
    axes[1].axhspan(0.99, 1.01, color=GRID, zorder=0)
    axes[0].set_title("Largest force (N)")
    axes[1].set_title("Ratio of volumes J (–)")
    for ax in axes:
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        ax.set_xlabel("κ over c (–)")
        ax.axvline(content.kappa_ratio, color=MUTED, lw=0.8, ls="--")
    add_legend(drawing, axes[0])
    return make_figure(drawing, "sensitivity-kappa")


def make_contact_section(store: Results, content: FrictionResult) -> Section:
    """Sticky against frictionless contact."""
    return _compare_models(store, "sensitivity-contact", "Sensitivity to friction", content)


def make_indenter_section(store: Results, content: IndenterResult) -> Section:
    """The square against a sphere and others."""
    return _compare_models(store, "sensitivity-indenter", "Sensitivity to the indenter", content)


def make_mesh_section(store: Results, content: RefinementResult) -> Section:
    """Mesh independence."""
    name = "sensitivity-mesh"
    return make_section(
        name,
        "Mesh independence",
        make_prose(name, content=content),
        _draw_mesh_figure(store, content),
        make_table(name, content.runs, marked="base"),
        _list_warnings(content),
    )


@styled
def _draw_mesh_figure(store: Results, content: RefinementResult) -> Figure:
    sites = content.sites[:2]
    drawing, axes = make_panels(len(sites) + 1, len(sites) + 1, 2.7)
    for ax, site in zip(axes, sites, strict=False):
        _draw_curves(ax, store, "sensitivity-mesh", site, content)
    for i, site in enumerate(content.sites):
        rows = [row for row in content.runs if row.site == site.site and row.completed]
        color, line = _STYLES[i % len(_STYLES)]
        edge, peak = np.array([(row.edge_near_mm, row.peak_force_N) for row in rows], dtype=float).T
        axes[-1].plot(edge, peak, color=color, ls=line, marker="o", label=f"site {site.site}")
        if site.limit_N is not None and site.order is not None:
            axes[-1].plot(0.0, site.limit_N, color=color, marker="x", ls="", mew=1.8)
    axes[0].set_ylabel("Force (N)")
    axes[-1].set_title("Largest force (N)")
    axes[-1].set_xlabel("Edge near the indenter (mm)")
    axes[-1].set_xlim(left=-0.2)
    axes[-1].legend(fontsize=8)
    add_legend(drawing, axes[0])
    return make_figure(drawing, "sensitivity-mesh")


@styled
def _compare_models(
    store: Results, name: str, title: str, content: FrictionResult | IndenterResult
) -> Section:
    """Curves of every site, and the table of its runs."""
    drawing, axes = make_panels(len(content.sites), 2, 2.7)
    for ax, site in zip(axes, content.sites, strict=True):
        _draw_curves(ax, store, name, site, content)
        ax.set_ylabel("Force (N)")
    add_legend(drawing, axes[0])
    words: dict[str, Any] = {"words": "compared models", "title": title}
    return make_section(
        name,
        title,
        make_prose(name, content=content, changes=write_words("changes of the force", runs=content.runs)),
        make_figure(drawing, name, **words),
        make_table(name, content.runs, marked="base", **words),
        _list_warnings(content),
    )


def _name_model(row: VariantRun) -> str:
    return row.label.replace(" x ", " × ")


def _list_warnings(content: Compared) -> Bullets | None:
    """Simulations that did not reach their end, and what is doubtful about others."""
    runs = content.runs
    texts = [(row, f"stopped early: {row.reason}") for row in runs if not row.completed]
    texts += [(row, text) for row in runs for text in row.warnings]
    return make_bullets(f"Site {row.site}, {row.label}: {text}" for row, text in texts)


SENSITIVITIES: dict[str, Callable[[Results, Any], Section]] = {
    "sensitivity-c": make_stiffness_section,
    "sensitivity-kappa": make_kappa_section,
    "sensitivity-contact": make_contact_section,
    "sensitivity-indenter": make_indenter_section,
    "sensitivity-mesh": make_mesh_section,
}
