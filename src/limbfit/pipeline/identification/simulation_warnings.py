"""What ``calibration.json`` says of the simulations that completed but are doubtful, and of the contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ...fe import SimulationWarning
from ...identify.fit.calibration import Calibration
from ...identify.fit.objective import SiteResponse
from ...indentation import Simulation
from ...results.identification import ContactSummary, SearchDoubt, SimulationDoubt, SimulationDoubts


@dataclass(frozen=True)
class SearchWarning:
    """A doubt about a simulation of the search: in which evaluation, where, with which parameters."""

    evaluation: int
    site: str
    parameters: tuple[float, ...]
    doubt: SimulationWarning


def summarise_contact(
    answers: Mapping[str, Simulation],
    searched: Mapping[str, float | None],
    rested: Sequence[SiteResponse],
    fitted: Sequence[SiteResponse],
) -> dict[str, ContactSummary]:
    """Per site the penalty that all of its simulations hold, and what contact does at the answer.

    ``search_penalty_per_mm`` is that of the mesh on which parameters are searched; ``from_rest_percent`` how
    far the answer's force from rest is from the fitted one, in percent of its largest.
    """
    content = {}
    for (site, simulation), answer, fit in zip(answers.items(), rested, fitted, strict=True):
        off = np.max(np.abs(answer.force_N - fit.force_N)) / np.max(np.abs(fit.force_N))
        content[site] = ContactSummary(
            penalty_per_mm=simulation.facts.get("penalty_per_mm"),
            sunk_steps=simulation.facts.get("sunk_steps"),
            unbalanced_steps=simulation.facts.get("unbalanced_steps"),
            search_penalty_per_mm=searched.get(site),
            penetration_mm=simulation.penetration_mm,
            from_rest_percent=100 * float(off) if np.isfinite(off) else None,
        )
    return content


def summarise_doubts(
    searched: Sequence[SearchWarning], answers: Mapping[str, Simulation], simulations: int, found: Calibration
) -> SimulationDoubts:
    """How many of the ``simulations`` of the search are doubtful, which, and what is at the answer.

    ``iterate`` is the number of the accepted iterate that a doubt belongs to, from the beginning of the best
    start; None for a trial that was not accepted.
    """
    accepted: dict[tuple[float, ...], int] = {}
    for number, iterate in enumerate(found.history):
        accepted.setdefault(iterate.parameters, number)
    rows = [
        SearchDoubt(
            evaluation=one.evaluation,
            iterate=accepted.get(one.parameters),
            site=one.site,
            parameters=dict(zip(found.names, one.parameters, strict=True)),
            **asdict(one.doubt),
        )
        for one in searched
    ]
    return SimulationDoubts(
        simulations=simulations,
        doubtful=len({(one.evaluation, one.site) for one in searched}),
        search=rows,
        answer={
            site: [SimulationDoubt.model_validate(doubt) for doubt in one.doubts]
            for site, one in answers.items()
            if one.doubts
        },
    )
