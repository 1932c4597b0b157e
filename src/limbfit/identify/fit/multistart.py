"""Calibrations from several starts: is the optimum the only one?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import CalibrationError
from .parameters import Grouping, Unknowns, search_space, shared
from .state import Calibration

Array = NDArray[np.float64]

_SAME_COST = 0.01  # relative: half a per cent of the error
_SAME_PLACE = 0.01  # relative, of every parameter: searches that stop on their last step end so far apart
_SAME_FIT = 1e-4  # rms force error per site, of its largest: fits closer than this are alike, however exact


@dataclass(frozen=True)
class Started:
    """What came of one start: ``parameters`` (p,) None where nothing could be simulated.

    ``same``: as good a fit as the best, or in its place; ``apart``: the largest ratio of a parameter to the
    best one's.
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
class Multistart:
    """The best calibration, the number of its start, and what came of every start, in their order."""

    best: Calibration
    number: int
    starts: tuple[Started, ...]

    @property
    def reached(self) -> int:
        """Starts that ended at a fit as good as the best, or in its place."""
        return sum(start.same for start in self.starts)


def random_starts(
    unknowns: Unknowns, count: int, seed: int, grouping: Grouping | None = None
) -> tuple[Array, ...]:
    """``count`` full parameter vectors (p,): the first is the stated start, the others are random.

    Logarithms are uniform between the bounds. ``grouping`` is that of the first stage, by default one
    material: what moves together is drawn together, and what is fixed stays at the stated start.
    """
    space = search_space(unknowns, shared(unknowns.names) if grouping is None else grouping)
    random = np.random.default_rng(seed)
    drawn = [space.expand(random.uniform(space.lower, space.upper)) for _ in range(count - 1)]
    return (unknowns.start, *drawn)


def multistart(
    run: Callable[[int, Unknowns], Calibration],
    unknowns: Unknowns,
    count: int,
    seed: int = 0,
    grouping: Grouping | None = None,
) -> Multistart:
    """Run ``run(number, unknowns)`` from ``count`` starts; see :func:`random_starts`.

    Raises
    ------
    CalibrationError
        Where no start can be simulated.
    """
    starts = random_starts(unknowns, count, seed, grouping)
    found: list[Calibration | None] = []
    reasons = []
    for number, start in enumerate(starts):
        try:
            ended_at = run(number, unknowns.from_start(start))
            found.append(ended_at)
            reasons.append(ended_at.reason)
        except CalibrationError as error:
            if count == 1:
                raise
            found.append(None)
            reasons.append(str(error))
    ended = [(number, one) for number, one in enumerate(found) if one is not None]
    if not ended:
        raise CalibrationError(f"none of {count} starts can be simulated: {reasons[0]}")
    number, best = min(ended, key=lambda pair: pair[1].cost)
    told = (_started(s, one, best, why) for s, one, why in zip(starts, found, reasons, strict=True))
    return Multistart(best, number, tuple(told))


def _started(start: Array, one: Calibration | None, best: Calibration, reason: str) -> Started:
    at = tuple(start.tolist())
    if one is None:
        return Started(at, None, None, 0, False, reason)
    apart = float(np.exp(np.abs(np.log(one.parameters / best.parameters)).max()))
    allowed = _SAME_COST * best.cost + 0.5 * len(best.sites) * _SAME_FIT**2
    return Started(
        at, tuple(one.parameters.tolist()), one.cost, one.evaluations, one.converged, reason,
        same=one.cost - best.cost <= allowed or apart <= 1.0 + _SAME_PLACE, apart=apart,
    )  # fmt: skip


def describe(found: Multistart, names: Sequence[str]) -> str:
    """One sentence: how many starts ended at the same optimum, and how far apart their parameters are."""
    total = len(found.starts)
    same = [start.parameters for start in found.starts if start.same and start.parameters is not None]
    logs = np.log(np.array(same))
    spread = np.exp(np.ptp(logs, axis=0))
    widest = int(spread.argmax())
    text = f"{len(same)} of {total} starts end at the same error"
    if total > 1:
        text += f"; their {names[widest]} differs most, by a factor of {spread[widest]:.3g}"
    return text
