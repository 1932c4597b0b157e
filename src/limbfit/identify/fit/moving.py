"""A calibration whose answer is moved from the least error to what is most probable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .objective import Measured, SiteResponse, check_responses, residuals
from .parameters import Unknowns
from .prediction import error_percent
from .state import Calibration, Iterate

Array = NDArray[np.float64]


def moved(
    found: Calibration,
    parameters: Array,
    measured: Sequence[Measured],
    responses: Sequence[SiteResponse],
    unknowns: Unknowns,
) -> Calibration | str:
    """The calibration with its last stage ended at ``parameters`` (p,), whose ``responses`` are given.

    Or why it cannot end there: a simulation that failed.
    """
    if failure := check_responses(responses, measured, len(parameters)):
        return failure
    left, _ = residuals(found.settings.objective, responses, measured)
    rows, target = unknowns.prior_rows()
    known = found.settings.force_error_percent / 100 * (rows @ np.log(parameters) - target)
    cost, before, last = 0.5 * float(left @ left + known @ known), found.history[-1], found.stages[-1]
    errors = tuple(
        error_percent(one.force_N, site.force_N) for one, site in zip(responses, measured, strict=True)
    )
    end = tuple(map(float, parameters))
    iterate = Iterate(before.stage, end, cost, errors, before.evaluations + 1, before.failures)
    stage = replace(
        last,
        parameters=end,
        cost=cost,
        iterations=last.iterations + 1,
        evaluations=last.evaluations + 1,
        reason=f"{last.reason}; then moved from the least squares to what is most probable",
    )
    return replace(
        found,
        parameters=np.array(end),
        stages=(*found.stages[:-1], stage),
        history=(*found.history, iterate),
        evaluations=found.evaluations + 1,
        responses=tuple(responses),
    )
