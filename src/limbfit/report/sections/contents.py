"""The whole page: every section in the order in which a reader asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ...extensions import Registry
from ..page import Note, Page, Section, make_section
from ..store import Results
from .convergence import make_convergence_section
from .crossvalidation import make_crossvalidation_section
from .cube import make_cube_section
from .design import make_design_section, make_protocol_section
from .methods import make_method_section
from .model import make_mesh_section, make_model_section
from .parameters import make_parameter_section
from .prediction import make_domain_section, make_fit_section, make_prediction_section
from .provenance import make_provenance_section, make_settings_section, make_timing_section
from .records import make_record_check_section, make_record_section
from .regions import make_regions_section
from .sensitivity import SENSITIVITIES
from .simulations import make_comparison_section, make_simulated_section, make_solver_section
from .socket import make_socket_design_section, make_socket_section
from .summary import build_summary, list_key_numbers
from .uncertainty import make_models_section, make_uncertainty_section

Maker = Callable[[Results, Any], Section]
# By the name of the experiment, in the order of the page; a maker is given the store and the stored result,
# of an extension as ``<name>.json`` holds it.
_OWN: dict[str, Maker] = {
    "uncertainty": make_uncertainty_section,
    "regions": make_regions_section,
    "cube": make_cube_section,
    **SENSITIVITIES,
    "crossvalidate": make_crossvalidation_section,
    "design": make_design_section,
    "protocol": make_protocol_section,
    "socket": make_socket_section,
    "socket_design": make_socket_design_section,
}
SECTIONS = Registry("report section", _OWN)

PRIVACY = (
    "This report holds no name, date of birth or other identity from the images. It does show the shape of "
    "a limb and how it responds, which is health data: handle it as the study's consent allows."
)


def make_page(store: Results) -> Page:
    """Every section in the order in which a reader asks."""
    run = store.run
    sections = (
        make_model_section(store),
        make_mesh_section(store),
        make_record_section(store),
        make_fit_section(store),
        make_prediction_section(store),
        make_domain_section(store) if store.predict else None,
        make_record_check_section(store) if store.predict else None,
        make_parameter_section(store),
        make_convergence_section(store),
        make_models_section(store, store.models) if store.models else None,
        *_list_experiment_sections(store),
        make_simulated_section(store) if store.simulated else None,
        make_comparison_section(store) if store.compared else None,
        make_solver_section(store),
        make_method_section(store),
        make_timing_section(store),
        make_settings_section(store),
        make_provenance_section(store),
    )
    version = run.limbfit if run else "of an unknown version"
    return Page(
        title=run.study.name if run else "Unnamed study",
        subtitle=run.study.description if run else "",
        key_numbers=list_key_numbers(store),
        summary=build_summary(store),
        sections=tuple(section for section in sections if section is not None),
        footer=f"Made by limbfit {version} from stored results. {PRIVACY}",
    )


def _list_experiment_sections(store: Results) -> tuple[Section, ...]:
    """A section for each finished experiment, then one that names those that are stale."""
    found = [
        SECTIONS[name](store, one)
        for name in SECTIONS.names
        if (one := store.experiments.get(name)) is not None
    ]
    if store.outdated:
        found.append(make_section("outdated", "Left out", map(_describe_outdated, store.outdated)))
    return tuple(found)


def _describe_outdated(name: str) -> Note:
    verb = name.replace("sensitivity-", "sensitivity --only ").replace("socket_design", "socket design")
    return Note(
        f"The stored results of “limbfit {verb}” are left out: they were made from other inputs, settings or "
        "code. Run it again to see them here."
    )
