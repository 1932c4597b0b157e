"""The whole page: its summary, and every section in the order in which a reader asks."""

from collections.abc import Callable
from statistics import fmean
from typing import Any

from ...extensions import Registry
from ..formats import format_number
from ..page import Block, KeyNumber, Note, Page, Section
from ..store import Results
from ..words import make_list, make_prose, make_section, write_words
from . import design, identification, inputs, methods, simulations, socket, uncertainty, variants

Maker = Callable[[Results, Any], Section]
# By the name of the experiment, in the order of the page; a maker is given the store and the stored result,
# of an extension as ``<name>.json`` holds it.
_OWN: dict[str, Maker] = {
    "uncertainty": uncertainty.make_uncertainty_section,
    "regions": uncertainty.make_regions_section,
    "cube": variants.make_cube_section,
    **variants.SENSITIVITIES,
    "crossvalidate": uncertainty.make_crossvalidation_section,
    "design": design.make_design_section,
    "protocol": design.make_protocol_section,
    "socket": socket.make_socket_section,
    "socket_design": socket.make_socket_design_section,
}
SECTIONS = Registry("report section", _OWN)


def make_page(store: Results) -> Page:
    """Every section in the order in which a reader asks."""
    run = store.run
    sections = (
        inputs.make_model_section(store),
        inputs.make_mesh_section(store),
        inputs.make_record_section(store),
        identification.make_fit_section(store),
        identification.make_prediction_section(store),
        identification.make_domain_section(store) if store.predict else None,
        inputs.make_record_check_section(store) if store.predict else None,
        identification.make_parameter_section(store),
        identification.make_convergence_section(store),
        uncertainty.make_models_section(store, store.models) if store.models else None,
        *_list_experiment_sections(store),
        simulations.make_simulated_section(store) if store.simulated else None,
        simulations.make_comparison_section(store) if store.compared else None,
        simulations.make_solver_section(store),
        methods.make_method_section(store),
        methods.make_timing_section(store),
        methods.make_settings_section(store),
        methods.make_provenance_section(store),
    )
    return Page(
        title=run.study.name if run else "Unnamed study",
        subtitle=run.study.description if run else "",
        key_numbers=list_key_numbers(store),
        summary=build_summary(store),
        sections=tuple(section for section in sections if section is not None),
        footer=write_words("footer", run=run),
    )


def _list_experiment_sections(store: Results) -> tuple[Section, ...]:
    """A section for each finished experiment, then one that names those that are stale."""
    found = [
        SECTIONS[name](store, one)
        for name in SECTIONS.names
        if (one := store.experiments.get(name)) is not None
    ]
    if store.outdated:
        notes = (Note(write_words("outdated", experiment=name)) for name in store.outdated)
        found.append(make_section("outdated", notes))
    return tuple(found)


def list_key_numbers(store: Results) -> tuple[KeyNumber, ...]:
    """The numbers that a reader looks for first."""
    found = []
    if store.predict:
        error = f"mean {store.compared_quantity} error at the"
        found.append(KeyNumber(store.mean_error("heldout"), "%", f"{error} held-out sites"))
        found.append(KeyNumber(store.mean_error("fitted"), "%", f"{error} fitted sites"))
    first = next(p for p in store.law.parameters if p.key == store.law.moduli[0])
    for tissue in store.tissues:
        facts = {"tissue": tissue, "modulus": first, "interval": store.interval(tissue, first.key)}
        modulus = format_number(store.stages[-1].parameters[tissue][first.key])
        found.append(KeyNumber(modulus, "kPa", write_words("modulus", **facts)))
    seconds = [stage.seconds for stage in store.run.stages.values()] if store.run else []
    if seconds:
        size, unit = (1, "s") if sum(seconds) < 120 else (60, "min")
        found.append(KeyNumber(f"{sum(seconds) / size:.0f}", unit, "computing time, all stages"))
    return tuple(found)


def build_summary(store: Results) -> tuple[Block, ...]:
    """One paragraph in plain words, then the verdict."""
    heldout = [row for row in store.predicted if not row.fitted]
    prose = make_prose(
        "summary",
        store=store,
        heldout=heldout,
        sites=len({row.site for row in heldout}),
        errors=[row.error_percent for row in heldout if row.error_percent is not None],
        means=[fmean(one) for one in store.predict.compare_held_out() if one] if store.predict else [],
    )
    return make_section("summary", prose, make_list("verdicts", found=store.uncertainty)).blocks
