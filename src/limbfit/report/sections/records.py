"""Indentation records in the report: what was found in them, and the paper's figure 3."""

from __future__ import annotations

import matplotlib
from matplotlib.axes import Axes

from ..drawing.figures import thin
from ..drawing.ink import GRID, INK, MUTED, SIMULATED, STYLE, legend_above, panels, svg
from ..formats import fixed, heading, numeric
from ..page import Cell, Figure, Row, Table
from ..store import Curves, Json, Results
from ..tables import NOTHING

MOST_NAMED = 6  # phases whose names have room in a panel


def record_figure(store: Results, site: str) -> Figure | None:
    """Figure 3: one site's record as the robot wrote it, and regularised from touch-down on."""
    raw, regular = store.curves("traces", f"{site}-raw"), store.curves("traces", site)
    if raw is None or regular is None:
        return None
    facts = store.traces.get(site, {})
    start = (facts.get("touch_down_s", 0.0), facts.get("touch_down_mm", 0.0))
    drawing, axes = panels(3, 3, 2.5)
    with matplotlib.rc_context(STYLE):
        _draw_record(axes, thin(raw), regular, start)
        for ax in axes[:2]:
            _mark_phases(ax, facts.get("phases") or [])
        legend_above(drawing, axes[0])
    peak, depth = fixed(facts.get("peak_force_N"), 2), fixed(facts.get("depth_mm"), 2)
    alt = f"Record of site {site}: displacement and force against time, and force against displacement"
    caption = (
        f"Figure 3 of the paper for this study: record of site {site}, raw and regularised. The dashed "
        f"line is the touch-down that was found; {_told(facts)}every phase is regularised by itself and the "
        f"peak is kept ({peak} N at {depth} mm)."
    )
    return Figure("record", svg(drawing, "record", alt), caption)


def _draw_record(axes: list[Axes], raw: Curves, regular: Curves, start: tuple[float, float]) -> None:
    time, depth = regular["time_s"] + start[0], regular["displacement_mm"] + start[1]
    pairs = [
        (("time_s", "displacement_mm"), (time, depth), ("Time (s)", "Displacement (mm)")),
        (("time_s", "force_N"), (time, regular["force_N"]), ("Time (s)", "Force (N)")),
        (("displacement_mm", "force_N"), (depth, regular["force_N"]), ("Displacement (mm)", "Force (N)")),
    ]
    for ax, (columns, curve, labels) in zip(axes, pairs, strict=True):
        ax.plot(raw[columns[0]], raw[columns[1]], color=MUTED, lw=0.9, label="as recorded")
        ax.plot(*curve, color=SIMULATED, lw=1.8, label="regularised")
        at = start[1] if columns[0] == "displacement_mm" else start[0]
        ax.axvline(at, color=INK, lw=0.8, ls="--", label="touch-down")
        ax.set_xlabel(labels[0])
        ax.set_ylabel(labels[1])


def _told(facts: Json) -> str:
    words = facts.get("phases_in_words")
    return f"the indenter's phases are {words} (holds are shaded); " if words else ""


def _mark_phases(ax: Axes, phases: list[Json]) -> None:
    """Holds shaded, boundaries as thin lines, names where there is room."""
    for phase in phases:
        start, end = phase["start_s"], phase["end_s"]
        if phase["kind"] == "hold":
            ax.axvspan(start, end, facecolor=GRID, alpha=0.6, lw=0, zorder=0)
        ax.axvline(end, color=GRID, lw=0.8, zorder=0)
        if len(phases) <= MOST_NAMED:
            at, over = (start + end) / 2, ax.get_xaxis_transform()
            ax.text(
                at, 0.02, phase["kind"], color=MUTED, fontsize=6,
                transform=over, ha="center", va="bottom", rotation=90,
            )  # fmt: skip


def trace_table(store: Results) -> Table:
    """Touch-down, peak, noise and phases of every record."""
    head = (
        "Site",
        "Touch-down (s)",
        "Touch-down (mm)",
        "± (mm)",
        "Depth (mm)",
        "Largest force (N)",
        "Noise (N)",
        "Loading (mm/s)",
        "Unloading (mm/s)",
        "Phases",
    )
    keys = (
        ("touch_down_s", 3),
        ("touch_down_mm", 3),
        ("touch_down_uncertainty_mm", 3),
        ("depth_mm", 2),
        ("peak_force_N", 2),
        ("noise_N", 3),
        ("speed_load_mm_s", 3),
        ("speed_unload_mm_s", 3),
    )
    rows = tuple(
        Row(
            (
                heading(site),
                *(numeric(fixed(facts.get(key), digits)) for key, digits in keys),
                Cell(facts.get("phases_in_words") or NOTHING),
            ),
            facts.get("site", site) in store.fitted,
        )
        for site, facts in store.traces.items()
    )
    return Table("trace-facts", "What was found in each indentation record.", head, rows)
