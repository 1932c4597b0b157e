"""Sites whose record does not fit the identified model, with the evidence (see `identify.outliers`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...identify.objective import Measured, SiteResponse
from ...identify.outliers import Exchange, FirstOrder, as_driven, find_outliers
from ...identify.plausibility import explained
from ...indentation import Simulation, SimulationJob
from ..context import Context
from ..simulations import SimulationCache
from .plausible import stored_flags
from .traces import SiteRecord

Array = NDArray[np.float64]


def outlier_record(
    context: Context,
    cache: SimulationCache,
    records: Sequence[SiteRecord],
    ours: Sequence[Simulation],
    best: Array,
    one: Array,
    searched: Sequence[SiteRecord],
) -> dict[str, Any]:
    """What ``predict.json`` holds of flags: on the records themselves, and on those that the model misses.

    Parameters
    ----------
    ours : the records' simulations with the identified parameters ``best``, with derivatives.
    one : the answer with one material.
    searched : the records on the meshes on which parameters are searched.
    """
    plain = stored_flags(context)
    whole = [i for i, simulation in enumerate(ours) if simulation.completed]
    records, searched = [records[i] for i in whole], [searched[i] for i in whole]
    known = [_response(ours[i]) for i in whole]

    def simulate(parameters: Array) -> list[SiteResponse]:
        if np.array_equal(parameters, best):
            return known
        return _run(context, cache, [record.job(parameters, start=best) for record in searched])

    def exactly(parameters: Array, i: int, j: int) -> tuple[SiteResponse, SiteResponse]:
        jobs = [_driven_by(searched[a], searched[b], parameters) for a, b in ((i, j), (j, i))]
        one, two = _run(context, cache, jobs)
        return one, two

    found = find_outliers(
        simulate,
        [Measured(record.site.name, record.force_N) for record in records],
        best,
        _exchange(records),
        exactly,
        one,
    )
    left_out = [{**asdict(entry), "standardised": entry.standardised} for entry in found.left_out]
    flags = [flag.to_dict() | {"found": "in the record"} for flag in plain]
    against = explained(found.flags, plain)
    flags += [flag.to_dict() | {"found": "against the model"} for flag in against]
    return {"flags": flags, "left_out": left_out}


def _exchange(records: Sequence[SiteRecord]) -> Callable[[FirstOrder], Exchange]:
    """From the expansion of all sites to about what two answer to each other's record."""

    def build(first: FirstOrder) -> Exchange:
        def pair(parameters: Array, i: int, j: int) -> tuple[SiteResponse, SiteResponse]:
            histories = [(records[k].times_s, records[k].displacement_mm) for k in (i, j)]
            one, two = first.responses[i], first.responses[j]
            return as_driven(one, *histories), as_driven(two, *histories[::-1])

        return pair

    return build


def _driven_by(site: SiteRecord, other: SiteRecord, parameters: Array) -> SimulationJob:
    """The site driven by the record of another one."""
    model = replace(site.model, knots_s=other.model.knots_s, knots_mm=other.model.knots_mm)
    return replace(site, model=model, times_s=other.times_s).job(parameters)


def _run(context: Context, cache: SimulationCache, jobs: Sequence[SimulationJob]) -> list[SiteResponse]:
    found = []
    for simulation in cache.run(jobs, context.executor):
        context.tell("predict", 0, 0, f"looking at site {simulation.site} for what is wrong")
        found.append(_response(simulation))
    return found


def _response(simulation: Simulation) -> SiteResponse:
    assert simulation.jacobian is not None
    return SiteResponse(simulation.force_N, simulation.jacobian, simulation.completed, simulation.reason)
