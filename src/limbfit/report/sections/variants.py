"""What force depends on: c, bulk modulus, friction, indenter, mesh; the cube (the paper's figures 8, 9)."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...results import variants as stored
from ..drawing.colours import GRID, INK, MEASURED, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH
from ..drawing.plots import add_legend, choose_tissue_style, make_figure, make_panels, make_standalone, styled
from ..formats import format_fixed
from ..page import Figure, Section
from ..store import Results
from ..words import make_list, make_prose, make_section, make_table, write_words

_COLOURS = (SIMULATED, ONE_MATERIAL, TRUTH, THIRD, MUTED, INK)
_LINES: tuple[Any, ...] = ("-", "--", "-.", (0, (6, 2)), ":", "-")
_STYLES = tuple(zip(_COLOURS, _LINES, strict=True))
_RANGE = ("J_min", "J_low", "J_high", "J_max")
KINDS = {"skin": "Figure 8. Skin, adipose tissue", "muscle": "Figure 9. Muscle, soft tissue below the skin"}
_OWN = ((SIMULATED, "-"), (THIRD, "-"), (INK, "-"))
_OTHERS = ((ONE_MATERIAL, "--"), (TRUTH, "-."), (THIRD, (0, (6, 2))), (MUTED, ":"), (MEASURED, (0, (1, 2))))


def make_sensitivity_section(store: Results, content: stored.VariedResult, name: str) -> Section:
    """Force with one thing changed at a time: in words, in curves, and in a table of the simulations."""
    draw_figure = _FIGURES[name]
    stiffness = content if isinstance(content, stored.StiffnessResult) else None
    element = store.calibration.element if store.calibration else None
    title = write_words(f"section {name}")
    words = "compared models" if draw_figure is _draw_site_curves else ""
    return make_section(
        name,
        make_prose(name, content=content, element=element),
        make_prose("leading tissues", found=_find_leading_tissues(stiffness)) if stiffness else None,
        draw_figure(store, content),
        make_table(name, content.runs, marked="base", words=words, title=title, content=content),
        make_table("sensitivity-c-local", stiffness.local, content=content) if stiffness else None,
        make_list("warnings of variants", runs=content.runs),
    )


def _name_site(row: stored.VariedSite) -> str:
    return f"site {row.site}, {row.role}" if row.role else f"site {row.site}"


def _find_leading_tissues(content: stored.StiffnessResult) -> dict[str, dict[str, float]]:
    """The largest change of the force by each tissue, by site: whether thin and thick sites differ in it."""
    found: dict[str, dict[str, float]] = {}
    for row in content.runs:
        if row.tissue and row.peak_change_percent is not None:
            changes = found.setdefault(row.site, {})
            changes[row.tissue] = max(changes.get(row.tissue, 0.0), abs(row.peak_change_percent))
    return {site: changes for site, changes in found.items() if len(changes) > 1}


@styled
def _draw_two_sites(
    store: Results, content: Any, name: str, draw_all_sites: Callable[[Axes, Any], None]
) -> Figure:
    """Curves of the first two sites, and in a last panel what is known of all of them."""
    sites = content.sites[:2]
    drawing, axes = make_panels(len(sites) + 1, len(sites) + 1, 2.8)
    for ax, site in zip(axes, sites, strict=False):
        _draw_curves(ax, store, name, site, content)
    axes[0].set_ylabel("Force (N)")
    draw_all_sites(axes[-1], content)
    axes[-1].legend(fontsize=8)
    add_legend(drawing, axes[0], columns=5)
    return make_figure(drawing, name, content=content)


def _draw_curves(
    ax: Axes, store: Results, name: str, site: stored.VariedSite, content: stored.VariedResult
) -> None:
    """Force against time of every variant of a site."""
    curves = store.curves(name, site.site) or {}
    rows = [row for row in content.runs if row.site == site.site and row.completed]
    heads = [head for head in curves if head.endswith("_N")]
    for i, (row, head) in enumerate(zip(rows, heads, strict=False)):
        color, line = (INK, "-") if row.base else _STYLES[i % len(_STYLES)]
        ax.plot(curves["time_s"], curves[head], color=color, ls=line, label=row.label.replace(" x ", " × "))
    ax.set_title(f"{_name_site(site)}: {format_fixed(site.tissue_mm)} mm of tissue")
    ax.set_xlabel("Time (s)")
    ax.margins(x=0.01)


def _draw_derivatives(ax: Axes, content: stored.StiffnessResult) -> None:
    for i, tissue in enumerate(content.parameters):
        rows = [row for row in content.local if row.peak_percent_per_percent[tissue] is not None]
        depth = [row.tissue_mm for row in rows]
        slope = np.array([row.peak_percent_per_percent[tissue] for row in rows], dtype=float)
        style = choose_tissue_style(i)
        ax.plot(depth, slope, ls="", marker=style["marker"], color=style["color"], label=tissue)
    ax.set_title("% of force for 1 % of c")
    ax.set_xlabel("Tissue to the nearest bone (mm)")
    ax.set_ylim(0.0, 1.1 * max(ax.get_ylim()[1], 0.1))


@styled
def _draw_kappa_figure(store: Results, content: stored.VolumeResult) -> Figure:
    drawing, axes = make_panels(2, 2, 2.7)
    for i, site in enumerate(content.sites):
        color, line = _STYLES[i % len(_STYLES)]
        rows = [row for row in content.runs if row.site == site.site and row.completed]
        ratio = [row.kappa_ratio for row in rows]
        known = {key: [getattr(row, key) for row in rows] for key in ("peak_force_N", *_RANGE)}
        style: dict[str, Any] = {"color": color, "ls": line, "marker": "o", "ms": 4}
        axes[0].plot(ratio, known["peak_force_N"], label=_name_site(site), **style)
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


def _draw_refinement(ax: Axes, content: stored.RefinementResult) -> None:
    for i, site in enumerate(content.sites):
        rows = [row for row in content.runs if row.site == site.site and row.completed]
        color, line = _STYLES[i % len(_STYLES)]
        edge, peak = np.array([(row.edge_near_mm, row.peak_force_N) for row in rows], dtype=float).T
        ax.plot(edge, peak, color=color, ls=line, marker="o", label=f"site {site.site}")
        if site.limit_N is not None and site.order is not None:
            ax.plot(0.0, site.limit_N, color=color, marker="x", ls="", mew=1.8)
    ax.set(title="Largest force (N)", xlabel="Edge near the indenter (mm)")
    ax.set_xlim(left=-0.2)


@styled
def _draw_site_curves(store: Results, content: stored.FrictionResult | stored.IndenterResult) -> Figure:
    name = "sensitivity-contact" if isinstance(content, stored.FrictionResult) else "sensitivity-indenter"
    drawing, axes = make_panels(len(content.sites), 2, 2.7)
    for ax, site in zip(axes, content.sites, strict=True):
        _draw_curves(ax, store, name, site, content)
        ax.set_ylabel("Force (N)")
    add_legend(drawing, axes[0])
    return make_figure(drawing, name, words="compared models", title=write_words(f"section {name}"))


_FIGURES: dict[str, Callable[[Results, Any], Figure]] = {  # what draws that of each experiment
    "sensitivity-c": partial(_draw_two_sites, name="sensitivity-c", draw_all_sites=_draw_derivatives),
    "sensitivity-kappa": _draw_kappa_figure,
    "sensitivity-contact": _draw_site_curves,
    "sensitivity-indenter": _draw_site_curves,
    "sensitivity-mesh": partial(_draw_two_sites, name="sensitivity-mesh", draw_all_sites=_draw_refinement),
}
SENSITIVITIES = {name: partial(make_sensitivity_section, name=name) for name in _FIGURES}


def make_cube_section(store: Results, content: stored.CubeResult) -> Section:
    """What the experiment ``cube`` found."""
    words = make_prose("cube", content=content, own=filter(_is_own, content.tissues))
    table = make_table("cube", content.tissues, marked=_is_own)
    return make_section("cube", words, draw_cube_figure(content), table)


def _is_own(row: stored.CubeTissue) -> bool:
    return row.source == "this study"


def draw_cube(content: stored.CubeResult) -> str:
    """The figure as the text of an SVG file."""
    return make_standalone(draw_cube_figure(content).markup)


@styled
def draw_cube_figure(content: stored.CubeResult) -> Figure:
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


def _draw_stresses(
    above: Axes, below: Axes, rows: Sequence[stored.CubeTissue], content: stored.CubeResult
) -> None:
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
