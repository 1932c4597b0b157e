"""Sites whose record does not fit the identified model, with the evidence (see `identify.outliers`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...identify.checks.outliers import Exchange, LogLinearModel, approximate_response, find_outliers
from ...identify.checks.plausibility import explain_warnings
from ...identify.fit.multifidelity import MeshCorrection
from ...identify.fit.objective import SiteResponse
from ...indentation import SimulationJob
from ...results.identification import LeftOutRecord
from ...results.records import RecordFlag
from ..engine.context import Context
from ..simulation.simulations import SimulationCache
from .record_checks import read_record_warnings
from .records import SiteRecord, to_response


class RecordChecks(NamedTuple):
    """What ``predict.json`` holds of the checks of the records."""

    flags: list[RecordFlag]
    left_out: list[LeftOutRecord]
    failed: list[str]


def check_records(
    context: Context,
    cache: SimulationCache,
    records: Sequence[SiteRecord],
    ours: Sequence[SiteResponse],
    best: Array,
    one: Array,
    searched: Sequence[SiteRecord],
    correction: MeshCorrection | None,
) -> RecordChecks:
    """Warnings about the records themselves, and about those that the model misses.

    Parameters
    ----------
    ours : the records' sites with the identified parameters ``best``, with derivatives; those that failed
        are not looked at.
    one : the answer with one material.
    searched : the records on the meshes on which parameters are searched.
    correction : brings responses there to those of the study's own meshes; None where they are the same.
    """
    plain = read_record_warnings(context)
    whole = [i for i, response in enumerate(ours) if response.completed]
    records, searched = [records[i] for i in whole], [searched[i] for i in whole]
    known, failed = [ours[i] for i in whole], list[str]()

    def simulate(parameters: Array) -> list[SiteResponse]:
        if np.array_equal(parameters, best):
            return known
        found = _run(context, cache, [record.job(parameters, starts=[best]) for record in searched])
        found = found if correction is None else correction.select(whole)(found)
        failed.extend(f"site {r.site}, one material: {r.reason}" for r in found if not r.completed)
        return found

    def exactly(parameters: Array, i: int, j: int) -> tuple[SiteResponse, SiteResponse]:
        jobs = [_build_driven_job(searched[a], searched[b], parameters) for a, b in ((i, j), (j, i))]
        one, two = _run(context, cache, jobs)
        pairs = ((one, two), (two, one))
        failed.extend(f"site {a.site}, record of {b.site}: {a.reason}" for a, b in pairs if not a.completed)
        return one, two

    def exchange(first: LogLinearModel) -> Exchange:
        """From the expansion of all sites to about what two answer to each other's record."""

        def pair(parameters: Array, i: int, j: int) -> tuple[SiteResponse, SiteResponse]:
            histories = [(records[k].times_s, records[k].displacement_mm) for k in (i, j)]
            one, two = first.responses[i], first.responses[j]
            return approximate_response(one, *histories), approximate_response(two, *histories[::-1])

        return pair

    found = find_outliers(
        simulate,
        [replace(record.measured, weight=1.0 / record.record.of_site) for record in records],
        best,
        exchange,
        exactly,
        one,
    )
    against = explain_warnings(found.warnings, plain)
    flags = [RecordFlag(**flag.to_dict(), found="in the record") for flag in plain]
    flags += [RecordFlag(**flag.to_dict(), found="against the model") for flag in against]
    return RecordChecks(flags, list(found.left_out), list(dict.fromkeys(failed)))


def _build_driven_job(site: SiteRecord, other: SiteRecord, parameters: Array) -> SimulationJob:
    """The site driven by the record of another one, and indented by what made that."""
    driven = other.model
    model = replace(
        site.model,
        knots_s=driven.knots_s,
        knots_mm=driven.knots_mm,
        knots_N=driven.knots_N,
        indenter=driven.indenter,
        indenter_digest=driven.indenter_digest,
        layers=(),
        skin_points=(),
    )
    return replace(site, model=model, times_s=other.times_s).job(parameters)


def _run(context: Context, cache: SimulationCache, jobs: Sequence[SimulationJob]) -> list[SiteResponse]:
    found = []
    for simulation in cache.run(jobs, context.executor):
        context.tell("predict", 0, 0, f"looking at site {simulation.site} for what is wrong")
        found.append(to_response(simulation))
    return found
