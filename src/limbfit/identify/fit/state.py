"""Settings, state and result of a calibration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ...arrays import Array
from .objective import Objective, SiteResponse
from .parameters import Grouping


@dataclass(frozen=True)
class CalibrationSettings:
    """Settings of the search.

    Parameters
    ----------
    stopping : ``"paper"`` ends where no parameter or no objective entry changed by more than 0.01, absolute
        (section 2.3).
    relative_tolerance : a stage ends where no parameter would change by more than this share (see
        ``trust_region.minimise``), where four steps in a row lowered the squared error by less than this
        share on average, or where the forces would change by less than a quarter of it, in the root mean
        square over their largest.
    max_iterations : limit of accepted steps in each stage.
    force_error_percent : weighs forces against priors. A prior that is off by one standard deviation costs as
        much as the force of one site that is off everywhere by this percentage of its largest.
    """

    objective: Objective = "pointwise"
    relative_tolerance: float = 1e-3
    max_iterations: int = 25
    stopping: Literal["relative", "paper"] = "relative"
    force_error_percent: float = 1.0


@dataclass(frozen=True)
class Iterate:
    """An accepted point: full parameters, cost, and the force error of each site in percent.

    ``evaluations`` and the ``failures`` among them are counted from the beginning.
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
    """The state from which a search continues: the current stage, its parameters, trust radius and history.

    ``folds`` counts the trials of the stage that were refused because elements folded. The parameters are
    exact: a continued run repeats the interrupted one to the last bit.
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
    """The answer: ``parameters`` (p,) by ``names``, the stages, all accepted iterates, the final responses.

    ``responses`` (force and derivatives per site at the answer) are the input of ``estimate_uncertainty``.
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
