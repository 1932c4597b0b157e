"""Searches from several starts, and a search continued from a bound: is the optimum the only one?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from .calibration import Calibration
from .multifidelity import SearchResult
from .parameters import FIXED, Grouping, Unknowns, build_space, group_by_kind

_SAME_COST = 0.01  # relative: half a per cent of the error
# Relative, of every parameter: searches that stop on their last step end so far apart
_SAME_PARAMETERS = 0.01
_SAME_FIT = 1e-4  # rms force error per site, of its largest: fits closer than this are alike, however exact
Search = Callable[[Unknowns, Sequence[Grouping]], SearchResult]
MIN_IMPROVEMENT = 0.01  # relative fall of the squared error: less is the same optimum


@dataclass(frozen=True)
class StartResult:
    """The result of one start: ``parameters`` (p,) are None if nothing could be simulated.

    ``same`` says that the fit is as good as the best, or in its place; ``apart`` is the largest ratio of a
    parameter to the best one's.
    """

    start: tuple[float, ...]
    parameters: tuple[float, ...] | None
    cost: float | None
    evaluations: int
    converged: bool
    reason: str
    same: bool = False
    apart: float | None = None


@dataclass(frozen=True)
class MultistartResult:
    """The best calibration, the number of its start, and the result of every start, in their order."""

    best: Calibration
    number: int
    starts: tuple[StartResult, ...]

    @property
    def reached_count(self) -> int:
        """The number of starts that ended at a fit as good as the best, or in its place."""
        return sum(start.same for start in self.starts)


def draw_starts(
    unknowns: Unknowns, count: int, seed: int, grouping: Grouping | None = None
) -> tuple[Array, ...]:
    """Return ``count`` full parameter vectors (p,): first the given start, then random ones.

    Logarithms are uniform between the bounds. ``grouping`` is that of the first stage, by default one
    material: parameters that move together are drawn together, and fixed ones stay at the given start.
    """
    space = build_space(unknowns, group_by_kind(unknowns.names) if grouping is None else grouping)
    random = np.random.default_rng(seed)
    drawn = [space.expand(random.uniform(space.lower, space.upper)) for _ in range(count - 1)]
    return (unknowns.start, *drawn)


def run_multistart(
    run: Callable[[int, Unknowns], Calibration],
    unknowns: Unknowns,
    count: int,
    seed: int = 0,
    grouping: Grouping | None = None,
) -> MultistartResult:
    """Call ``run(number, unknowns)`` from ``count`` starts; see :func:`draw_starts`.

    Raises `CalibrationError` if no start can be simulated.
    """
    starts = draw_starts(unknowns, count, seed, grouping)
    calibrations: dict[int, Calibration] = {}
    failures: dict[int, str] = {}
    for number, start in enumerate(starts):
        try:
            calibrations[number] = run(number, unknowns.with_start(start))
        except CalibrationError as error:
            if count == 1:
                raise
            failures[number] = str(error)
    if not calibrations:
        raise CalibrationError(f"none of {count} starts can be simulated: {failures[0]}")
    number = min(calibrations, key=lambda one: calibrations[one].cost)
    best = calibrations[number]
    results = (
        _compare_start(start, calibrations[i], best)
        if i in calibrations
        else StartResult(tuple(start.tolist()), None, None, 0, False, failures[i])
        for i, start in enumerate(starts)
    )
    return MultistartResult(best, number, tuple(results))


def _compare_start(start: Array, calibration: Calibration, best: Calibration) -> StartResult:
    apart = float(np.exp(np.abs(np.log(calibration.parameters / best.parameters)).max()))
    allowed = _SAME_COST * best.cost + 0.5 * len(best.sites) * _SAME_FIT**2
    return StartResult(
        start=tuple(start.tolist()),
        parameters=tuple(calibration.parameters.tolist()),
        cost=calibration.cost,
        evaluations=calibration.evaluations,
        converged=calibration.converged,
        reason=calibration.reason,
        same=calibration.cost - best.cost <= allowed or apart <= 1.0 + _SAME_PARAMETERS,
        apart=apart,
    )


def describe_starts(result: MultistartResult, names: Sequence[str]) -> str:
    """Say in one sentence how many starts ended at the same optimum, and how far apart they are."""
    total = len(result.starts)
    same = [start.parameters for start in result.starts if start.same and start.parameters is not None]
    logs = np.log(np.array(same))
    spread = np.exp(np.ptp(logs, axis=0))
    widest = int(spread.argmax())
    text = f"{len(same)} of {total} starts end at the same error"
    if total > 1:
        text += f"; their {names[widest]} differs most, by a factor of {spread[widest]:.3g}"
    return text


def continue_from_bound(
    result: SearchResult,
    start: Unknowns,
    stages: Sequence[Grouping],
    search: Search,
    report: Callable[[str], object],
) -> SearchResult:
    """Search the last stage again from inside if it ended at a bound, which may hold a search in a worse
    optimum.

    ``result``: of ``search`` from ``start``. It is returned as it is if nothing ended at a bound, or if the
    second search fails. ``report``: called with a sentence when the second search begins, and when it fails.
    """
    inside = find_start_inside(result.calibration, start, stages[-1])
    if inside is None:
        return result
    names, again = inside
    message = f"{', '.join(names)} at a bound: searched again from inside"
    report(message)
    try:
        second = search(again, stages[-1:])
    except CalibrationError as error:
        report(f"warning: {message}, which fails: {error}")
        return result
    further_rounds = (replace(one, stage=len(stages) - 1) for one in second.rounds)
    calibration = combine_searches(result.calibration, second.calibration, names)
    return SearchResult(calibration, (*result.rounds, *further_rounds))


def find_start_inside(
    calibration: Calibration, unknowns: Unknowns, grouping: Grouping
) -> tuple[list[str], Unknowns] | None:
    """Return what ended at a bound, and the answer with that back at its start; None if nothing did."""
    is_stuck = unknowns.is_at_bound(calibration.parameters) & ~unknowns.is_at_bound(unknowns.start)
    is_stuck &= np.array(grouping) != FIXED
    if not is_stuck.any():
        return None
    names = [name for name, there in zip(unknowns.names, is_stuck, strict=True) if there]
    return names, unknowns.with_start(np.where(is_stuck, unknowns.start, calibration.parameters))


def combine_searches(first: Calibration, second: Calibration, names: list[str]) -> Calibration:
    """Return the better of a calibration and of its last stage searched again, with a reason that names both.

    The evaluations of both are counted; the iterates are those that led to the answer.
    """
    last, before, words = len(first.stages) - 1, first.history[-1], f"{', '.join(names)} at a bound"
    if second.cost < (1.0 - MIN_IMPROVEMENT) * first.cost:
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
