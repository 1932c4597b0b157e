"""The sections of the report, each made from the store; what is not stored is said in a sentence."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .. import site_tables, tables
from ..drawing import figures, pictures
from ..drawing.interactive import convergence_curves, explorer, record_curves
from ..drawing.observed_figures import layer_figure, surface_figure, wave_figure
from ..drawing.slices import slices_figure
from ..formats import fixed
from ..page import Block, Bullets, Figure, Note, Page, Prose, Section, Table
from ..store import Json, Results
from .comparison import comparison
from .doubted import search_doubts
from .doubts import doubts
from .experiments import experiment_sections
from .methods import method_section
from .priors import prior_shares
from .records import record_figure, trace_table
from .summary import _combinations, key_numbers, summary

PRIVACY = (
    "This report holds no name, date of birth or other identity from the images. It does show the shape of "
    "a limb and how it responds, which is health data: handle it as the study's consent allows."
)


def make_page(store: Results) -> Page:
    """Every section in the order in which a reader asks."""
    study = store.run.get("study") or {}
    name = str(study.get("name") or "Unnamed study")
    makers: tuple[Callable[[Results], Section], ...] = (
        model,
        meshes,
        records,
        fit,
        prediction,
        doubts,
        parameters,
        convergence,
    )
    closing: tuple[Callable[[Results], Section], ...] = (
        simulated,
        comparison,
        solver,
        method_section,
        timing,
        settings,
        provenance,
    )
    absent: dict[Callable[[Results], Section], bool] = {
        simulated: not store.simulated,
        comparison: not store.compared,
        doubts: "flags" not in store.predict,
    }
    version = store.run.get("limbfit", "unknown version")
    return Page(
        title=name,
        subtitle=str(study.get("description") or ""),
        key_numbers=key_numbers(store),
        summary=summary(store),
        sections=(
            *(make(store) for make in makers if not absent.get(make)),
            *experiment_sections(store),
            *(make(store) for make in closing if not absent.get(make)),
        ),
        footer=f"Made by limbfit {version} from stored results. {PRIVACY}",
    )


def _blocks(*blocks: Block | None, otherwise: str) -> tuple[Block, ...]:
    """The blocks that exist, or a note that says what is missing."""
    found = tuple(block for block in blocks if block is not None)
    return found or (Note(otherwise),)


def model(store: Results) -> Section:
    """Surfaces, sites and volumes."""
    notes = (*(store.segment.get("warnings") or ()), *(store.surfaces.get("notes") or ()))
    blocks = _blocks(
        explorer(store),
        slices_figure(store),
        pictures.surface_figure(store),
        pictures.marker_figure(store),
        tables.volume_table(store),
        tables.place_table(store) if store.sites else None,
        Bullets(notes) if notes else None,
        otherwise="No surfaces and sites are stored yet.",
    )
    source = store.segment.get("method")
    if source:
        blocks = (Prose(f"Segmentation: {source}."), *blocks)
    return Section("model", "The model", blocks)


def meshes(store: Results) -> Section:
    """Cut meshes and their quality."""
    warnings = tuple(
        f"Site {site}: {text}"
        for site, facts in store.mesh.items()
        for text in (*(facts.get("repairs") or ()), *(facts.get("warnings") or ()))
    )
    blocks = _blocks(
        pictures.mesh_figure(store, store.fitted[:4]),
        tables.mesh_table(store) if store.mesh else None,
        Bullets(warnings) if warnings else None,
        otherwise="No meshes are stored yet.",
    )
    return Section("meshes", "Meshes", blocks)


def records(store: Results) -> Section:
    """Indentation records."""
    fitted = [name for site in store.fitted for name in store.records_of(site)]
    chosen = [name for name in (*fitted, *store.traces) if store.curves("traces", name)]
    blocks = _blocks(
        record_figure(store, chosen[0]) if chosen else None,
        record_curves(store, tuple(dict.fromkeys(chosen))),
        trace_table(store) if store.traces else None,
        otherwise="No indentation records are stored yet.",
    )
    return Section("records", "Indentation records", blocks)


def fit(store: Results) -> Section:
    """Force against time at the fitted sites."""
    rows = [row for row in store.predicted if row.get("fitted")]
    blocks = _blocks(
        figures.force_figure(store, rows, "time_s", "forces-fitted", 2),
        layer_figure(store, fitted=True),
        wave_figure(store, fitted=True),
        surface_figure(store, fitted=True),
        pictures.field_figure(store, store.fitted[:4], "predict", "field"),
        otherwise="No simulated forces of fitted sites are stored yet.",
    )
    return Section("fit", "Fitted sites", blocks)


def prediction(store: Results) -> Section:
    """Everything about the sites that were not used, and table 2."""
    rows = [row for row in store.predicted if not row.get("fitted")]
    blocks = _blocks(
        site_tables.site_table(store) if store.predicted else None,
        figures.error_figure(store),
        figures.force_figure(store, rows, "time_s", "forces-held-out", 3),
        figures.force_figure(store, rows, "displacement_mm", "loops-held-out", 3),
        layer_figure(store, fitted=False),
        wave_figure(store, fitted=False),
        surface_figure(store, fitted=False),
        site_tables.observed_table(store),
        otherwise="No predictions are stored yet.",
    )
    if store.predicted and not rows:
        blocks = (*blocks, Note("Every site was fitted, so nothing tests the model on unseen data."))
    return Section("prediction", "All sites, held-out sites", blocks)


def parameters(store: Results) -> Section:
    """Table 1, intervals and correlations."""
    found: tuple[Block | None, ...] = ()
    if store.stages:
        found = (
            tables.parameter_table(store),
            figures.interval_figure(store),
            tables.correlation_table(store),
        )
    blocks = _blocks(*found, otherwise="No parameters have been identified yet.")
    if store.stages and not store.calibration.get("uncertainty"):
        blocks = (*blocks, Note("No uncertainty is stored, so the table has no intervals."))
    blocks = (*blocks, *prior_shares(store), *_combinations(store))
    residuals = _residuals(store)
    if residuals:
        blocks = (*blocks, Prose(residuals))
    return Section("parameters", "Parameters", blocks)


def _residuals(store: Results) -> str:
    """What the intervals rest on: noise, misfit of the model, errors of meshes and surfaces, by site."""
    found = (store.calibration.get("uncertainty") or {}).get("residuals") or {}
    rows = found.get("sites") or {}
    if not rows:
        return ""
    meshes, own = (
        ", ".join(
            f"{name} {fixed(100 * site[share], 1)} %"
            for name, site in rows.items()
            if site.get(share) is not None
        )
        for share in ("mesh_share", "site_share")
    )
    return (
        "The intervals rest on two kinds of residuals at the fitted sites, standard deviations of the noise "
        f"as recorded and of the smooth misfit of the model: {site_tables.noise_and_misfit(rows)}. "
        "A misfit lasts about "
        f"{fixed(100 * found['correlation'], 0)} % of a record. "
        + (
            f"The error of the meshes is added, in percent of the largest force: {meshes}."
            if meshes
            else "The error of the meshes is not in them: no other mesh was simulated."
        )
        + (
            " So is what tissue and surfaces make a site as a whole stiffer or softer, root mean square over "
            f"the record: {own}; {fixed(found['site_factor'], 1)} times what its thickness lets expect."
            if own
            else ""
        )
    )


def convergence(store: Results) -> Section:
    """How the identification went."""
    stages = store.stages
    texts = tuple(
        f"{str(stage['name']).capitalize()}: {'' if stage.get('converged') else 'not '}converged after "
        f"{len(stage.get('iterations') or ())} iterates and {stage.get('evaluations', tables.NOTHING)} "
        f"evaluations; {stage.get('reason') or 'no reason stored'}."
        for stage in stages
    )
    figure: Figure | None = figures.convergence_figure(store)
    details: tuple[Table, ...] = tuple(
        tables.iteration_table(store, stage) for stage in stages if stage.get("iterations")
    )
    blocks = _blocks(
        Bullets(texts) if texts else None,
        figure,
        convergence_curves(store),
        *search_doubts(store),
        *details,
        otherwise="No identification is stored yet.",
    )
    return Section("convergence", "Convergence of the identification", blocks)


def _doubts(rows: Sequence[Json]) -> Bullets | None:
    """The solver's warnings about the simulations of the sites; None where there are none."""
    texts = tuple(f"Site {row['site']}: {text}" for row in rows for text in row.get("warnings") or ())
    return Bullets(texts) if texts else None


def simulated(store: Results) -> Section:
    """Indentations that were simulated one by one."""
    names = [str(row["site"]) for row in store.simulated][:4]
    blocks = _blocks(
        _doubts(store.simulated),
        figures.simulated_figure(store),
        pictures.field_figure(store, names, "simulate", "field-simulated"),
        tables.simulated_table(store),
        otherwise="No single indentations were simulated.",
    )
    return Section("simulated", "Simulated indentations", blocks)


def _corrections(rounds: Sequence[Json]) -> str | None:
    """How many, and what the last one changed."""
    if not rounds:
        return None
    last = rounds[-1]
    if last["reason"]:
        return f"{len(rounds)}; the last failed: {last['reason']}"
    left = max(last["change_percent_by_site"].values())
    return f"{len(rounds)}; the last changed no force by more than {left:.2g} % of its largest"


def solver(store: Results) -> Section:
    """What the simulations say about themselves."""
    facts = {
        "Objective": store.calibration.get("objective"),
        "Forward simulations of the identification": store.calibration.get("forward_runs"),
        "Of them with derivatives": store.calibration.get("forward_runs_with_sensitivities"),
        "Corrections of the search by the whole meshes": _corrections(
            store.calibration.get("corrections") or []
        ),
        "Starts": (store.calibration.get("multistart") or {}).get("summary"),
        "Linear solver": store.calibration.get("linear_solver"),
        "Element": store.calibration.get("element"),
    }
    known = {key: value for key, value in facts.items() if value is not None}
    failed = [str(row["record"]) for row in store.predicted if not row.get("completed")]
    warning = (
        f"The simulation did not reach the end of the record at: {', '.join(failed)}." if failed else None
    )
    blocks = _blocks(
        Note(warning) if warning else None,
        _doubts(store.predicted),
        tables.solver_table(store) if store.predicted else None,
        tables.pair_table("solver-facts", "The identification's solver.", ("Fact", "Value"), known)
        if known
        else None,
        otherwise="No simulations are stored yet.",
    )
    return Section("solver", "Solver", blocks)


def timing(store: Results) -> Section:
    """How long it took, and on what."""
    machine = store.run.get("machine") or {}
    words = [
        f"{machine['cores']} cores" if "cores" in machine else "",
        f"{fixed(machine['memory_GB'])} GB of memory" if "memory_GB" in machine else "",
        f"Python {machine['python']}" if "python" in machine else "",
    ]
    known = ", ".join(word for word in words if word)
    blocks = _blocks(
        tables.timing_table(store) if store.run.get("stages") else None,
        Prose(f"Machine: {known}.") if known else None,
        otherwise="No times are stored.",
    )
    return Section("timing", "Computing time", blocks)


def settings(store: Results) -> Section:
    """Every setting of the study file."""
    flat = tables.flatten(store.run.get("settings") or {})
    table = tables.pair_table(
        "all-settings", "Every setting of the study, defaults included.", ("Key", "Value"), flat
    )
    blocks = _blocks(table if flat else None, otherwise="No settings are stored.")
    return Section("settings", "Settings", blocks)


def provenance(store: Results) -> Section:
    """Versions and hashes: what someone else needs to get the same numbers."""
    versions = {"limbfit": store.run.get("limbfit")} | (store.run.get("versions") or {})
    inputs = store.run.get("inputs") or {}
    known = {name: value for name, value in versions.items() if value}
    blocks = _blocks(
        tables.pair_table("versions", "Software.", ("Library", "Version"), known) if known else None,
        tables.pair_table("inputs", "Inputs and their SHA-256.", ("Key of the study", "SHA-256"), inputs)
        if inputs
        else None,
        otherwise="No versions and input hashes are stored.",
    )
    return Section("provenance", "Versions and inputs", blocks)
