"""The limb with its sites and meshes; its records (the paper's figure 3), and what looks wrong in them."""

from collections.abc import Sequence

from matplotlib.axes import Axes

from ...identify.checks.outliers import MAX_STANDARDISED_ERROR, MIN_ERROR_SHARE
from ...results.limb import RecordPhase
from ..drawing import pictures
from ..drawing.colours import GRID, INK, MUTED, SIMULATED
from ..drawing.figures import thin_curves
from ..drawing.interactive import draw_record_curves, make_explorer
from ..drawing.plots import add_legend, make_figure, make_panels, styled
from ..page import Figure, Note, Prose, Section, Table, make_bullets
from ..store import Results
from ..words import make_prose, make_section, make_table, write_words

MAX_NAMED_PHASES = 6  # whose names have room in a panel


def make_model_section(store: Results) -> Section:
    """Surfaces, sites and volumes."""
    segment, surfaces = store.segment, store.surfaces
    return make_section(
        "model",
        Prose(f"Segmentation: {segment.method}.") if segment else None,
        make_explorer(store),
        pictures.draw_slices_figure(store),
        pictures.draw_surface_figure(store),
        pictures.draw_marker_figure(store),
        make_volume_table(store),
        make_table("places", store.sites, marked="fitted"),
        make_bullets((*(segment.warnings if segment else ()), *(surfaces.notes if surfaces else ()))),
    )


def make_volume_table(store: Results) -> Table | None:
    """Volumes from the label map and inside the surfaces."""
    labels, found = store.segment.volumes_cm3 if store.segment else {}, store.surfaces
    bodies = {"skin": found.skin, **found.bones, **found.regions} if found else {}
    closed = {name: body.volume_mm3 / 1000 for name, body in bodies.items()}
    names = list(dict.fromkeys([*labels, *closed]))
    rows = [{"name": name, "labels": labels.get(name), "closed": closed.get(name)} for name in names]
    return make_table("volumes", rows)


def make_mesh_section(store: Results) -> Section:
    """Cut meshes and their quality."""
    found = ((site, (*facts.repairs, *facts.warnings)) for site, facts in store.mesh.items())
    warnings = (f"Site {site}: {text}" for site, texts in found for text in texts)
    return make_section(
        "meshes",
        pictures.draw_mesh_figure(store, store.fitted[:4]),
        make_table("meshes", store.mesh.items(), marked=lambda row: row[0] in store.fitted),
        make_bullets(warnings),
    )


def make_record_section(store: Results) -> Section:
    """Indentation records."""
    fitted = [name for site in store.fitted for name in store.records_of(site)]
    chosen = [name for name in (*fitted, *store.traces) if store.curves("traces", name)]
    return make_section(
        "records",
        draw_record_figure(store, chosen[0]) if chosen else None,
        draw_record_curves(store, tuple(dict.fromkeys(chosen))),
        make_table("trace-facts", store.traces.items(), marked=lambda row: row[1].site in store.fitted),
    )


@styled
def draw_record_figure(store: Results, site: str) -> Figure | None:
    """Figure 3: one site's record as the robot wrote it, and regularised from touch-down on."""
    raw, regular, touch_down = store.record_curves(site)
    if raw is None or regular is None:
        return None
    facts = store.traces[site]
    drawing, axes = make_panels(3, 3, 2.5)
    labels = {"time_s": "Time (s)", "displacement_mm": "Displacement (mm)", "force_N": "Force (N)"}
    pairs = (("time_s", "displacement_mm"), ("time_s", "force_N"), ("displacement_mm", "force_N"))
    thin = thin_curves(raw)
    for ax, (x, y) in zip(axes, pairs, strict=True):
        ax.plot(thin[x], thin[y], color=MUTED, lw=0.9, label="as recorded")
        ax.plot(regular[x], regular[y], color=SIMULATED, lw=1.8, label="regularised")
        at = touch_down[x == "displacement_mm"]
        ax.axvline(at, color=INK, lw=0.8, ls="--", label="touch-down")
        ax.set(xlabel=labels[x], ylabel=labels[y])
    for ax in axes[:2]:
        _mark_phases(ax, facts.phases)
    add_legend(drawing, axes[0])
    return make_figure(drawing, "record", site=site, facts=facts)


def _mark_phases(ax: Axes, phases: Sequence[RecordPhase]) -> None:
    """Holds shaded, boundaries as thin lines, names where there is room."""
    for phase in phases:
        start, end = phase.start_s, phase.end_s
        if phase.kind == "hold":
            ax.axvspan(start, end, facecolor=GRID, alpha=0.6, lw=0, zorder=0)
        ax.axvline(end, color=GRID, lw=0.8, zorder=0)
        if len(phases) <= MAX_NAMED_PHASES:
            text = ax.text((start + end) / 2, 0.02, phase.kind, transform=ax.get_xaxis_transform())
            text.set(color=MUTED, fontsize=6, ha="center", va="bottom", rotation=90)


def make_record_check_section(store: Results) -> Section:
    """What looks wrong with records, the evidence for it, and each site as predicted from all others."""
    fitted = [name for site in store.fitted for name in (site, *store.records_of(site))]
    flags, left_out = (store.predict.flags, store.predict.left_out) if store.predict else ((), ())
    failures = write_words(
        "failures", rows=store.predicted, failed=store.predict.failed if store.predict else ()
    )
    return make_section(
        "doubts",
        Note(failures) if failures else None,
        make_bullets(f"{flag.text[:1].upper()}{flag.text[1:]}." for flag in flags)
        or make_prose("nothing doubtful", left_out=left_out),
        make_table("flags", flags, format_words=_format_words),
        make_table(
            "left-out",
            left_out,
            marked=lambda row: row.standardised > MAX_STANDARDISED_ERROR,
            fitted=fitted,
            least=100 * MIN_ERROR_SHARE,
        ),
    )


def _format_words(name: str) -> str:
    for unit, shown in (("_percent", " (%)"), ("_kPa", " (kPa)"), ("_mm", " (mm)"), ("_deg", " (°)")):
        if name.endswith(unit):
            return name.removesuffix(unit).replace("_", " ") + shown
    return name.replace("_", " ")
