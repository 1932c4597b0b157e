"""A search that ended at a bound, gone on from inside: a bound may hold a search in a worse optimum."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ...errors import CalibrationError
from .fidelity import Round
from .parameters import FIXED, Grouping, Unknowns
from .state import Calibration

Search = Callable[[Unknowns, Sequence[Grouping]], tuple[Calibration, tuple[Round, ...]]]
BETTER = 0.01  # relative fall of the squared error: less is the same optimum


def go_on(
    first: tuple[Calibration, tuple[Round, ...]],
    start: Unknowns,
    stages: Sequence[Grouping],
    search: Search,
    tell: Callable[[str], object],
) -> tuple[Calibration, tuple[Round, ...]]:
    """A calibration from ``start``, with its corrections, as it is once its last stage went on from inside.

    ``search`` is what it was found by, ``tell`` is given words. A second search that fails changes nothing.
    """
    found, rounds = first
    beyond = inside(found, start, stages[-1])
    if beyond is None:
        return first
    names, again = beyond
    words = f"{', '.join(names)} at a bound: searched again from inside"
    tell(words)
    try:
        second, further = search(again, stages[-1:])
    except CalibrationError as error:
        tell(f"warning: {words}, which fails: {error}")
        return first
    further = tuple(replace(one, stage=len(stages) - 1) for one in further)
    return gone_on(found, second, names), (*rounds, *further)


def inside(found: Calibration, unknowns: Unknowns, grouping: Grouping) -> tuple[list[str], Unknowns] | None:
    """What ended at a bound, and the answer with that back at its start; None where nothing did."""
    at = unknowns.at_bound(found.parameters) & ~unknowns.at_bound(unknowns.start)
    at &= np.array(grouping) != FIXED
    if not at.any():
        return None
    names = [name for name, there in zip(unknowns.names, at, strict=True) if there]
    return names, unknowns.from_start(np.where(at, unknowns.start, found.parameters))


def gone_on(first: Calibration, second: Calibration, names: list[str]) -> Calibration:
    """The better of a calibration and of its last stage searched again; its reason tells of both.

    Evaluations are those of both, iterates those that led to the answer.
    """
    last, before, words = len(first.stages) - 1, first.history[-1], f"{', '.join(names)} at a bound"
    if second.cost < (1.0 - BETTER) * first.cost:
        further = tuple(
            replace(
                one,
                stage=last,
                evaluations=before.evaluations + one.evaluations,
                failures=before.failures + one.failures,
            )
            for one in second.history
        )
        best, history = second, first.history + further
        reason = f"{second.reason}; the search had ended with {words}, and went on from inside"
    else:
        best, history = first, first.history
        reason = f"{first.reason}, with {words}; searched again from inside, without a smaller error"
    ends = first.stages[-1], second.stages[-1]
    stage = replace(
        best.stages[-1],
        iterations=sum(1 for one in history if one.stage == last) - 1,
        evaluations=sum(end.evaluations for end in ends),
        reason=reason,
    )
    return replace(
        best,
        stages=(*first.stages[:-1], stage),
        history=history,
        evaluations=first.evaluations + second.evaluations,
    )
