"""The section that holds limbfit against FEBio, where both solved the same indentation."""

from __future__ import annotations

from ..drawing import figures
from ..formats import fixed
from ..page import Block, Cell, Prose, Row, Section, Table
from ..store import Json, Results


def comparison(store: Results) -> Section:
    """Curves and differences of the sites that ``limbfit compare`` solved."""
    words = Prose(
        "The same mesh, materials and history by FEBio and by limbfit: once with limbfit's own contact, "
        "which keeps the penetration below 1 % of the depth, and once with FEBio's penalty and steps; what "
        "lies between the two is how far the indenter sinks in. Differences are in percent of FEBio's "
        "largest force."
    )
    figure = figures.compared_figure(store)
    blocks: tuple[Block, ...] = (words, *([] if figure is None else [figure]), _table(store))
    return Section("comparison", "Comparison with FEBio", blocks)


def _table(store: Results) -> Table:
    head = ("Site", "FEBio (N)", "limbfit (N)", "Largest difference (%)", "With FEBio's penalty (%)", "FEBio")
    return Table("compared", "Largest forces and differences.", head, tuple(map(_row, store.compared)))


def _row(row: Json) -> Row:
    febio = row.get("febio", {})
    ended = "completed" if febio.get("completed") else str(febio.get("reason"))
    numbers = (
        fixed(febio.get("peak_force_N"), 3),
        fixed(row.get("limbfit", {}).get("peak_force_N"), 3),
        *(
            fixed(row.get(key, {}).get("difference", {}).get("max_percent"), 2)
            for key in ("limbfit", "limbfit_matched")
        ),
    )
    cells = (Cell(text, number=True) for text in numbers)
    version = str(febio.get("version") or "FEBio")
    return Row((Cell(str(row.get("site")), header=True), *cells, Cell(f"{version}, {ended}")))
