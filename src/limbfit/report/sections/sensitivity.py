"""What the experiments of sensitivity found: c, bulk modulus, friction, indenter and mesh."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ...results.variants import (
    FrictionResult,
    IndenterResult,
    RefinedSite,
    RefinementResult,
    StiffnessResult,
    VariantRun,
    VariedSite,
    VolumeResult,
)
from ..drawing.colours import GRID, INK, MUTED, ONE_MATERIAL, SIMULATED, THIRD, TRUTH, choose_tissue_style
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..formats import format_fixed, format_friction, number
from ..page import Block, Bullets, Figure, Prose, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import Column, make_table

_COLOURS = (SIMULATED, ONE_MATERIAL, TRUTH, THIRD, MUTED, INK)
_LINES: tuple[Any, ...] = ("-", "--", "-.", (0, (6, 2)), ":", "-")
_STYLES = tuple(zip(_COLOURS, _LINES, strict=True))
Compared = StiffnessResult | VolumeResult | FrictionResult | IndenterResult | RefinementResult
_RANGE = ("J_min", "J_low", "J_high", "J_max")
_CHANGES: tuple[Column, ...] = (
    ("Largest force (N)", "peak_force_N", 3),
    ("Its change (%)", "peak_change_percent", 2),
    ("Mean change (% of it)", "mean_change_percent", 2),
)
_EFFORT: tuple[Column, ...] = (
    ("Steps", "steps", 0),
    ("Cut", "cuts", 0),
    ("Newton iterations", "newton_iterations", 0),
)


def make_stiffness_section(store: Results, content: StiffnessResult) -> Section:
    """Force against c of each tissue at equal m, at thin and thick sites, and its derivatives everywhere."""
    name = "sensitivity-c"
    words = Prose(
        "Force with c of one tissue at a time halved and doubled, all tissues with the same m "
        f"({number(content.equal_m)}, the geometric mean of those identified), as in the paper's "
        f"analysis; everything else as identified. {_describe_thickness(content)}"
    )
    more = _find_leading_tissue(content)
    return make_section(
        name,
        "Sensitivity to the stiffness of the tissues",
        words,
        Prose(more) if more else None,
        _draw_stiffness_figure(store, content),
        _make_run_table(name, "Changes of the force with c of one tissue, at equal m.", content, _CHANGES),
        _make_derivative_table(content),
        _list_warnings(content),
    )


def _describe_thickness(content: Compared) -> str:
    return _join_clauses(
        f"site {row.site}{_format_role(row, ' ({})')}: {format_fixed(row.tissue_mm)} mm of "
        "tissue to the nearest "
        f"bone, indented by {format_fixed(row.indentation_mm)} mm"
        for row in content.sites
    )


def _format_role(row: VariedSite, form: str) -> str:
    return form.format(row.role) if row.role else ""


def _join_clauses(parts: Iterable[str]) -> str:
    """Clauses as a sentence; nothing where there are none."""
    text = "; ".join(parts)
    return text[:1].upper() + text[1:] + "." if text else ""


def _find_leading_tissue(content: StiffnessResult) -> str:
    """Which tissue a thin and a thick site feel more: the paper's claim, for this study."""
    found = []
    for site in content.sites:
        changes: dict[str, float] = {}
        for row in content.runs:
            if row.site == site.site and row.tissue and row.peak_change_percent is not None:
                spread = abs(row.peak_change_percent)
                changes[row.tissue] = max(changes.get(row.tissue, 0.0), spread)
        if len(changes) > 1:
            most = max(changes, key=lambda tissue: changes[tissue])
            numbers = ", ".join(f"{tissue} {format_fixed(value)} %" for tissue, value in changes.items())
            words = f"at site {site.site} the force follows the {most} most (largest change: {numbers})"
            found.append(words)
    return _join_clauses(found)


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
    caption = (
        "Left: force at the chosen sites with c of one tissue halved and doubled, at equal m. Right: change "
        "of the largest force for one percent more c of a tissue, at every recorded site, from the exact "
        "derivatives at the identified parameters."
    )
    return make_figure(drawing, "sensitivity-c", "Force against c of each tissue", caption)


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


def _make_derivative_table(content: StiffnessResult) -> Table:
    columns: tuple[Column, ...] = (
        ("Site", "site"),
        ("Region", "region"),
        ("Tissue over bone (mm)", "tissue_mm", 1),
        *((f"{tissue} (%)", ("peak_percent_per_percent", tissue), 3) for tissue in content.parameters),
    )
    caption = "Change of the largest force in percent for one percent more c, from exact derivatives."
    return make_table("sensitivity-c-local", caption, columns, content.local)


def make_kappa_section(store: Results, content: VolumeResult) -> Section:
    """The ratio of bulk modulus to c, and the change of volume that it allows."""
    name, element = "sensitivity-kappa", store.calibration.element if store.calibration else None
    columns = (
        *_CHANGES,
        ("Least J", "J_min", 4),
        ("1 % of the volume below", "J_low", 4),
        ("1 % above", "J_high", 4),
        ("Largest J", "J_max", 4),
        ("Volume beyond 1 % (%)", "beyond_percent", 1),
    )
    words = Prose(
        f"The bulk modulus is {number(content.kappa_ratio)} times c in this study; the paper took 100, "
        "enough to keep the ratio of volumes J within 1 % of one in its models. J is the mean of an element "
        "at the deepest point, over the elements within one width of the indenter. Elements that lock "
        f"stiffen with it; those of this study are {element}. "
        f"{_describe_volume_ratio(content)}"
    )
    caption = "Force and ratio of volumes against the ratio of bulk modulus and c."
    table = _make_run_table(name, caption, content, columns)
    title = "Sensitivity to the bulk modulus"
    return make_section(name, title, words, _draw_kappa_figure(content), table, _list_warnings(content))


def _describe_volume_ratio(content: VolumeResult) -> str:
    """How far J goes with the study's ratio."""
    rows = [row for row in content.runs if row.base and row.J_min is not None]
    parts = [
        f"from {format_fixed(row.J_min, 3)} to {format_fixed(row.J_max, 3)} at site {row.site}, "
        f"{format_fixed(row.beyond_percent, 0)} % of that volume beyond 1 %"
        for row in rows
    ]
    return f"Here it goes {'; '.join(parts)}." if parts else ""


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
    caption = (
        "Largest force and ratio of volumes against κ over c; dashed: the study's. Right: all elements near "
        "the indenter (shaded), the middle 98 % of their volume (lines), and the band of 1 % (grey)."
    )
    name = "sensitivity-kappa"
    return make_figure(drawing, name, "Force and ratio of volumes against the bulk modulus", caption)


def make_contact_section(store: Results, content: FrictionResult) -> Section:
    """Sticky against frictionless contact."""
    words = Prose(
        f"The skin under the indenter slips freely in this study's model ({content.friction}), or sticks "
        "to it where it has touched: the two ends of what friction can do. The paper found no significant "
        f"change of the largest force. {_describe_changes(content)}"
        if content.friction == "frictionless"
        else f"Contact in this study's model is {format_friction(content.friction)}. "
        f"{_describe_changes(content)}"
    )
    return _compare_models(store, "sensitivity-contact", "Sensitivity to friction", words, content, _EFFORT)


def make_indenter_section(store: Results, content: IndenterResult) -> Section:
    """The square against a sphere and others."""
    words = Prose(
        "The same displacement and width with other indenters. The paper expects of a sphere that "
        "simulations converge more easily than at the edges of its square: compare the effort. Forces differ "
        f"since another indenter touches another area. {_describe_changes(content)}"
    )
    effort = (*_EFFORT, ("Penetration (mm)", "penetration_mm", 3))
    return _compare_models(
        store, "sensitivity-indenter", "Sensitivity to the indenter", words, content, effort
    )


def _describe_changes(content: Compared) -> str:
    return _join_clauses(
        f"{row.label}: the largest force at site {row.site} changes by "
        f"{format_fixed(row.peak_change_percent)} %"
        for row in content.runs
        if not row.base and row.peak_change_percent is not None
    )


def make_mesh_section(store: Results, content: RefinementResult) -> Section:
    """Mesh independence."""
    name = "sensitivity-mesh"
    words = Prose(
        "The sites meshed anew with other edge lengths, everything else the same. Where element and forces "
        f"allow it, they are extrapolated to an edge of zero (Richardson). {_describe_limits(content)}"
    )
    columns = (
        ("Edge near the indenter (mm)", "edge_near_mm", 2),
        ("Nodes", "nodes", 0),
        *_CHANGES,
        _EFFORT[2],
    )
    caption = "Force on coarser and finer meshes; changes are from the study's own."
    table = _make_run_table(name, caption, content, columns)
    figure = _draw_mesh_figure(store, content)
    return make_section(name, "Mesh independence", words, figure, table, _list_warnings(content))


def _describe_limits(content: RefinementResult) -> str:
    return _join_clauses(f"at site {row.site} {_describe_limit(row)}" for row in content.sites)


def _describe_limit(row: RefinedSite) -> str:
    if row.limit_N is None:
        return "the forces do not tend to a value yet: finer meshes are needed"
    error, limit = format_fixed(row.error_percent, 2), format_fixed(row.limit_N, 3)
    if row.order is None:
        return (
            f"the study's mesh is {error} % off the finest, whose largest force is {limit} N; with this "
            "element forces do not change in one direction, so nothing is extrapolated"
        )
    order = f"order {number(row.order, 2)}" + ("" if row.order_measured else ", assumed")
    return f"the largest force tends to {limit} N ({order}), and the study's mesh is {error} % off"


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
    caption = (
        "Force against time on each mesh, and the largest force against the edge; crosses: extrapolated."
    )
    name = "sensitivity-mesh"
    return make_figure(drawing, name, "Force on coarser and finer meshes", caption)


@styled
def _compare_models(
    store: Results, name: str, title: str, words: Block, content: Compared, more: Iterable[Column]
) -> Section:
    """Curves of every site, and the table of its runs."""
    drawing, axes = make_panels(len(content.sites), 2, 2.7)
    for ax, site in zip(axes, content.sites, strict=True):
        _draw_curves(ax, store, name, site, content)
        ax.set_ylabel("Force (N)")
    add_legend(drawing, axes[0])
    alt = f"{title}: force against time"
    figure = make_figure(drawing, name, alt, "Force against time at each site.")
    table = _make_run_table(name, f"{title}: forces and effort.", content, (*_CHANGES, *more))
    return make_section(name, title, words, figure, table, _list_warnings(content))


def _make_run_table(name: str, caption: str, content: Compared, columns: Iterable[Column]) -> Table:
    first = (("Site", "site"), ("Model", _name_model))
    caption = f"{caption} Marked: as in the study."
    return make_table(name, caption, (*first, *columns), content.runs, marked="base")


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
