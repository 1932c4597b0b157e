"""The sections of the experiments: each in a file of its own, listed here in the order of the page."""

from __future__ import annotations

from collections.abc import Callable

from .cube import cube_section
from .page import Note, Section
from .store import Json, Store

Maker = Callable[[Store, Json], Section]
# By the name of the experiment; a maker is given the store and what ``<name>.json`` holds.
MAKERS: dict[str, Maker] = {"cube": cube_section}


def experiment_sections(store: Store) -> tuple[Section, ...]:
    """A section for each finished experiment, then one that names those that are stale."""
    done = store.experiments
    sections = [make(store, done[name]) for name, make in MAKERS.items() if name in done]
    if store.outdated:
        sections.append(Section("outdated", "Left out", tuple(map(_outdated, store.outdated))))
    return tuple(sections)


def _outdated(name: str) -> Note:
    return Note(
        f"The stored results of “limbfit {name}” are left out: they were made from other inputs, settings or "
        "code. Run it again to see them here."
    )
