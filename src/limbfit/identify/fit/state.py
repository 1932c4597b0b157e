"""How parameters are searched for, the state of the search after every accepted iterate, and its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .objective import Objective, SiteResponse
from .parameters import Grouping

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationSettings:
    """How parameters are found.

    ``stopping="paper"`` ends where no parameter or no objective entry changed by more than 0.01, absolute
    (section 2.3); ``relative_tolerance`` is a relative change of parameters (see ``trust_region.minimise``),
    and the fall of the squared error per step below which a stage ends after four such steps; a stage also
    ends where the forces would change by less than a quarter of it, of their largest, in the root mean
    square.
    ``max_iterations`` counts accepted steps, per stage.  ``force_error_percent`` sets forces against priors:
    a prior that is one standard deviation off costs as much as the force of one site that is off by this, in
    percent of its largest, throughout.
    """

    objective: Objective = "pointwise"
    relative_tolerance: float = 1e-3
    max_iterations: int = 25
    stopping: Literal["relative", "paper"] = "relative"
    force_error_percent: float = 1.0


@dataclass(frozen=True)
class Iterate:
    """An accepted point: full parameters, cost, force error in percent per site.

    ``evaluations`` and, among them, ``failures`` are counted from the beginning.
    """

    stage: int
    parameters: tuple[float, ...]
    cost: float
    errors_percent: tuple[float, ...]
    evaluations: int
    failures: int


@dataclass(frozen=True)
class StageResult:
    """How a stage ended."""

    grouping: Grouping
    parameters: tuple[float, ...]
    cost: float
    iterations: int
    evaluations: int
    converged: bool
    reason: str


@dataclass(frozen=True)
class SearchState:
    """All that is needed to go on: the current stage, its parameters and trust radius, and what went before.

    ``folds``: trials of the stage that were refused for folded elements.

    ``parameters`` are exact: a run taken up again repeats the interrupted one to the last bit.
    """

    stage: int
    z: tuple[float, ...]
    radius: float
    evaluations: int
    history: tuple[Iterate, ...] = ()
    stages: tuple[StageResult, ...] = ()
    folds: int = 0


@dataclass(frozen=True)
class Calibration:
    """The answer: ``parameters`` (p,) by ``names``, each stage, every accepted iterate, and the final
    responses.

    ``responses`` (force and derivatives per site at the answer) are what ``uncertainty`` works on.
    """

    names: tuple[str, ...]
    sites: tuple[str, ...]
    parameters: Array
    stages: tuple[StageResult, ...]
    history: tuple[Iterate, ...]
    evaluations: int
    settings: CalibrationSettings
    responses: tuple[SiteResponse, ...] = field(repr=False)

    @property
    def converged(self) -> bool:
        return all(stage.converged for stage in self.stages)

    @property
    def reason(self) -> str:
        return self.stages[-1].reason

    @property
    def cost(self) -> float:
        return self.stages[-1].cost
