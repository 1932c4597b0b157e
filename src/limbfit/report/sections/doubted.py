"""Simulations that completed but are doubtful: how many of the search, where, and what of the answer."""

from __future__ import annotations

from collections import Counter

from ..formats import fixed, heading, numeric
from ..page import Bullets, Cell, Row, Table
from ..store import Json, Results

_WORDS = {
    "folded": "elements inside out",
    "slipped": "force falls in loading",
    "sunk": "indenter too deep in the skin",
    "unbalanced": "equilibrium beyond the tolerance",
    "unsettled": "friction not settled",
    "inexact": "inexact sensitivities",
}


def search_doubts(store: Results) -> tuple[Bullets | Table, ...]:
    """What the record of the identification says of its doubtful simulations; nothing where none is."""
    found = store.calibration.get("doubts") or {}
    rows, answer = found.get("search") or [], found.get("answer") or {}
    texts = [
        f"At the answer, site {site}: {doubt['text']}." for site, doubts in answer.items() for doubt in doubts
    ]
    if rows:
        texts.insert(0, _summary(found, rows))
    off = {site: one.get("from_rest_percent") or 0.0 for site, one in _contact(store).items()}
    texts += [
        f"The answer's force from rest differs from the fitted one by {fixed(value, 2)} % at site {site}: "
        "its tissue has more than one equilibrium, or steps were cut."
        for site, value in off.items()
        if value > _SAME_PERCENT
    ]
    bullets = (Bullets(tuple(texts)),) if texts else ()
    return (*bullets, _table(rows)) if rows else bullets


_SAME_PERCENT = 0.01  # of the largest force: what the tolerance of an equilibrium leaves


def _contact(store: Results) -> Json:
    return dict(store.calibration.get("contact") or {})


def _summary(found: Json, rows: list[Json]) -> str:
    kinds = Counter(row["kind"] for row in rows)
    words = ", ".join(f"{_WORDS[kind]} in {count}" for kind, count in kinds.items())
    used = sum(row["iterate"] is not None for row in rows)
    return (
        f"{found['doubtful']} of {found['simulations']} simulations of the search completed but are doubtful "
        f"({words}); {used} of these doubts are at accepted iterates. A step is shortened where the force "
        "newly falls, and up to three times a stage where elements newly fold."
    )


def _table(rows: list[Json]) -> Table:
    return Table(
        name="doubtful-simulations",
        caption="Simulations of the search that completed but are doubtful.",
        head=("Evaluation", "Site", "Doubt", "How many", "From (% of the depth)", "Accepted iterate"),
        rows=tuple(
            Row(
                (
                    heading(str(row["evaluation"])),
                    Cell(str(row["site"])),
                    Cell(_WORDS[row["kind"]]),
                    numeric(str(row["count"])),
                    numeric(fixed(100 * row["share"], 0)),
                    Cell("no" if row["iterate"] is None else str(row["iterate"])),
                )
            )
            for row in rows
        ),
        folded=True,
    )
