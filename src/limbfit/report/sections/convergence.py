"""How the identification went: its iterates, and simulations that completed but are doubtful."""

from __future__ import annotations

from collections import Counter

from ...results.identification import SearchStage, SimulationDoubts
from ..drawing.figures import draw_convergence_figure
from ..drawing.interactive import draw_convergence_curves
from ..formats import format_fixed, format_with_unit, number
from ..page import Bullets, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import Column, make_table, to_numeric

_KINDS = {
    "folded": "elements inside out",
    "slipped": "force falls in loading",
    "sunk": "indenter too deep in the skin",
    "unbalanced": "equilibrium beyond the tolerance",
    "unsettled": "friction not settled",
    "inexact": "inexact sensitivities",
}
EQUAL_PERCENT = 0.01  # of the largest force: what the tolerance of an equilibrium leaves


def make_convergence_section(store: Results) -> Section:
    """How the identification went."""
    stages = store.stages
    texts = (
        f"{stage.name.capitalize()}: {'' if stage.converged else 'not '}converged after "
        f"{len(stage.iterations)} iterates and {stage.evaluations} evaluations; {stage.reason}."
        for stage in stages
    )
    return make_section(
        "convergence",
        "Convergence of the identification",
        make_bullets(texts),
        draw_convergence_figure(store),
        draw_convergence_curves(store),
        describe_search(store),
        (make_iteration_table(store, stage) for stage in stages if stage.iterations),
        otherwise="No identification is stored yet.",
    )


def make_iteration_table(store: Results, stage: SearchStage) -> Table:
    """Every accepted iterate of one identification stage."""
    known = tuple(stage.parameters)
    tissues = known if stage.name != "one material" else known[:1]
    columns: tuple[Column, ...] = (
        ("Iteration", "iteration"),
        ("Objective", lambda step: to_numeric(number(step.cost, 4))),
        ("Error (%)", "error_percent", 2),
        *(
            (
                f"{tissue + ' ' if len(tissues) > 1 else ''}{format_with_unit(key)}",
                lambda step, t=tissue, k=key: to_numeric(number(step.parameters[t][k])),
            )
            for tissue in tissues
            for key in store.law.keys
        ),
    )
    caption = f"Iterations of the stage “{stage.name}”."
    name = f"iterations-{stage.name.replace(' ', '-')}"
    return make_table(name, caption, columns, stage.iterations, folded=True)


def describe_search(store: Results) -> tuple[Bullets | None, Table | None]:
    """What the record of the identification says of its doubtful simulations; nothing where none is."""
    if store.calibration is None:
        return None, None
    found = store.calibration.doubts
    rows, answer = found.search, found.answer
    texts = [_summarise_search(found)] if rows else []
    texts += [
        f"At the answer, site {site}: {doubt.text}." for site, doubts in answer.items() for doubt in doubts
    ]
    for site, one in store.calibration.contact.items():
        if (off := one.from_rest_percent or 0.0) > EQUAL_PERCENT:
            texts.append(
                f"The answer's force from rest differs from the fitted one by "
                f"{format_fixed(off, 2)} % at site "
                f"{site}: its tissue has more than one equilibrium, or steps were cut."
            )
    columns = (
        ("Evaluation", "evaluation"),
        ("Site", "site"),
        ("Doubt", lambda row: _KINDS[row.kind]),
        ("How many", "count", 0),
        ("From (% of the depth)", lambda row: to_numeric(format_fixed(100 * row.share, 0))),
        ("Accepted iterate", lambda row: "no" if row.iterate is None else row.iterate),
    )
    caption = "Simulations of the search that completed but are doubtful."
    table = make_table("doubtful-simulations", caption, columns, rows, folded=True)
    return make_bullets(texts), table if rows else None


def _summarise_search(found: SimulationDoubts) -> str:
    kinds = Counter(row.kind for row in found.search)
    words = ", ".join(f"{_KINDS[kind]} in {count}" for kind, count in kinds.items())
    used = sum(row.iterate is not None for row in found.search)
    return (
        f"{found.doubtful} of {found.simulations} simulations of the search completed but are doubtful "
        f"({words}); {used} of these doubts are at accepted iterates. A step is shortened where the force "
        "newly falls, and up to three times a stage where elements newly fold."
    )
