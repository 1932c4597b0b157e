"""How the identification went: its iterates, and simulations that completed but are doubtful."""

from __future__ import annotations

from collections import Counter

from ...results.identification import SearchStage, SimulationDoubts
from ..drawing.figures import draw_convergence_figure
from ..drawing.interactive import draw_convergence_curves
from ..page import Bullets, Section, Table, make_bullets, make_section
from ..store import Results
from ..tables import make_table
from ..words import write_words

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
    name = f"iterations-{stage.name.replace(' ', '-')}"
    return make_table(
        name, stage.iterations, folded=True, words="iterations", stage=stage, tissues=tissues, store=store
    )


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
            texts.append(write_words("doubt of the answer", site=site, off=off))
    table = make_table("doubtful-simulations", rows, folded=True, kinds=_KINDS)
    return make_bullets(texts), table if rows else None


def _summarise_search(found: SimulationDoubts) -> str:
    kinds = Counter(_KINDS[row.kind] for row in found.search)
    used = sum(row.iterate is not None for row in found.search)
    return write_words("doubts of the search", found=found, kinds=kinds, used=used)
