"""The sections of the experiments: each in a file of its own, listed here in the order of the page."""

from __future__ import annotations

from collections.abc import Callable

from ...extensions import Registry
from ..page import Note, Section
from ..store import Json, Results
from .cube import cube_section
from .design import design_section
from .protocol import protocol_section
from .regions import regions_section
from .sensitivity import SENSITIVITIES
from .socket import socket_section
from .socket_design import socket_design_section
from .uncertainty import uncertainty_section
from .validation import validation_section

Maker = Callable[[Results, Json], Section]
# By the name of the experiment; a maker is given the store and what ``<name>.json`` holds.
_OWN: dict[str, Maker] = {
    "uncertainty": uncertainty_section,
    "regions": regions_section,
    "cube": cube_section,
    **SENSITIVITIES,
    "crossvalidate": validation_section,
    "design": design_section,
    "protocol": protocol_section,
    "socket": socket_section,
    "socket_design": socket_design_section,
}
SECTIONS = Registry("report section", _OWN)


def experiment_sections(store: Results) -> tuple[Section, ...]:
    """A section for each finished experiment, then one that names those that are stale."""
    done = store.experiments
    sections = [SECTIONS[name](store, done[name]) for name in SECTIONS.names if name in done]
    if store.outdated:
        sections.append(Section("outdated", "Left out", tuple(map(_outdated, store.outdated))))
    return tuple(sections)


def _outdated(name: str) -> Note:
    verb = name.replace("sensitivity-", "sensitivity --only ").replace("socket_design", "socket design")
    return Note(
        f"The stored results of “limbfit {verb}” are left out: they were made from other inputs, settings or "
        "code. Run it again to see them here."
    )
