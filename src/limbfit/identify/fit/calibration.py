"""The identification: stages of bounded least squares on a simulation that is handed in.

``calibrate`` knows no study, no mesh and no solver. It calls ``simulate(parameters)``, which returns force
and derivatives per site, and it can be stopped after any accepted iterate and taken up again from its
``state`` with the same answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...errors import CalibrationError, ProblemError
from .objective import Measured, Simulate, SiteResponse, check_responses, new_doubts, residuals
from .parameters import Grouping, Space, Unknowns, search_space, two_stages
from .prediction import error_percent
from .state import Calibration, CalibrationSettings, Iterate, SearchState, StageResult
from .trust_region import FIRST_RADIUS, Point, SearchStep, minimise

Array = NDArray[np.float64]

# Where the very first simulation fails: once more, then ever closer to the middle of the bounds.
_RESTARTS = (0.0, 0.0, 0.1, 0.25, 0.5)
_RATIOS = (1.0, 0.5, 0.0)  # of the tissues' own starts, put on the start of the next stage until it completes
_PAPER_CHANGE = 0.01
_PATIENCE = 4  # steps
_TRIES = 3  # of a simulation that completed before
EITHER = ("slipped", "folded")
_FOLDS = 3  # trials of a stage that fold anew are refused; more are taken for what they are


def calibrate(
    simulate: Simulate,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    settings: CalibrationSettings | None = None,
    *,
    stages: Sequence[Grouping] = (),
    on_iterate: Callable[[SearchState], None] | None = None,
    state: SearchState | None = None,
) -> Calibration:
    """Find the parameters that bring the simulated forces closest to the measured ones.

    Parameters
    ----------
    simulate : from full parameters (p,) to one response per site, in the order of ``measured``. A response
    that
        is not completed, or not finite, makes the trial step fail: a shorter one is tried. So does one that
        slipped where it did not before the step, and the first three of a stage that fold anew.
    measured : the records, at the times at which ``simulate`` gives the force.
    unknowns : names, start and bounds of the full parameters.
    stages : groupings (see ``search_space``), each started from the end of the one before; by default
    ``two_stages``. Where tissues have starts of their own, which a stage could not tell apart, the next one
    puts the same ratios on its start.
    on_iterate : called after every accepted iterate with the state to be kept.
    state : go on from here; one evaluation at its parameters is repeated and not counted.

    Raises
    ------
    CalibrationError
        Where no first simulation completes.
    ProblemError
        For priors beside the paper's objective.
    """
    groupings = tuple(stages) or two_stages(unknowns.names)
    if unknowns.priors and settings is not None and settings.objective == "paper":
        raise ProblemError("the paper's objective has no place for priors", remedy="use pointwise")
    run = _Run(simulate, tuple(measured), unknowns, settings or CalibrationSettings(), groupings)
    for current in run.states(state):
        if on_iterate:
            on_iterate(current)
    return run.result(current)


def iterate_at(
    simulate: Simulate,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    settings: CalibrationSettings,
    groupings: Sequence[Grouping],
    state: SearchState,
) -> Iterate:
    """The iterate that a state stands at as ``simulate`` sees it now; it is not counted as an evaluation.

    Raises
    ------
    CalibrationError
        Where it cannot be simulated.
    """
    run = _Run(simulate, tuple(measured), unknowns, settings, tuple(groupings))
    return run.iterate(state.stage, run.again(state))


class _Run:
    """One calibration under way: counts evaluations and keeps the responses of the last accepted point."""

    def __init__(
        self,
        simulate: Simulate,
        measured: tuple[Measured, ...],
        unknowns: Unknowns,
        settings: CalibrationSettings,
        stages: tuple[Grouping, ...],
    ) -> None:
        self.simulate, self.measured, self.unknowns = simulate, measured, unknowns
        self.settings, self.stages = settings, stages
        self.evaluations = self.failures = 0
        self.failure = ""  # why the last one failed
        self.folds = 0  # trials of this stage that were refused for what folds in them
        self._here: tuple[SiteResponse, ...] = ()  # at the last accepted point
        self._responses: dict[bytes, tuple[SiteResponse, ...]] = {}

    def space(self, stage: int) -> Space:
        return search_space(self.unknowns, self.stages[stage])

    def evaluate(self, space: Space, z: Array, bear: tuple[str, ...] = ()) -> Point | None:
        """The point at z, simulated unless its responses are at hand; None where a simulation failed.

        ``bear``: kinds of doubt that are no failure.
        """
        parameters = space.expand(z)
        responses = self._responses.get(parameters.tobytes())
        if responses is None:
            self.evaluations += 1
            responses = tuple(self.simulate(parameters))
            self.failure = check_responses(responses, self.measured, len(parameters))
            if not self.failure:
                self.failure = self._doubt(responses, bear)
            if self.failure:
                self.failures += 1
                return None
            self._responses[parameters.tobytes()] = responses
        residual, jacobian = residuals(self.settings.objective, responses, self.measured)
        rows, target = self.unknowns.prior_rows()
        scale = self.settings.force_error_percent / 100
        known = scale * (rows @ space.logarithms(z) - target)
        jacobian = np.concatenate([space.pull_back(jacobian, parameters), scale * rows @ space.tie])
        return Point(z, np.concatenate([residual, known]), jacobian)

    def _doubt(self, responses: tuple[SiteResponse, ...], bear: tuple[str, ...]) -> str:
        """Why a trial counts as failed though it completed, or empty.

        A slip is the force of another equilibrium.  Folds come by and by: long steps into them are refused,
        but no optimum is given up for them, nor does the search zigzag along their border.
        """
        slipped, folded = new_doubts(responses, self._here, self.measured)
        if slipped and "slipped" not in bear:
            return slipped
        if not folded or "folded" in bear or self.folds >= _FOLDS:
            return ""
        self.folds += 1
        return folded

    def responses(self, parameters: Array) -> tuple[SiteResponse, ...]:
        return self._responses[parameters.tobytes()]

    def accept(self, parameters: Array) -> None:
        """Keep the responses of an accepted point alone; what is doubtful there may be so after it."""
        self._here = self.responses(parameters)
        self._responses = {parameters.tobytes(): self._here}

    def first(self) -> tuple[SearchState, Point]:
        """The start, or a place between it and the middle of the bounds where all simulations complete.

        One where none slips is preferred; folded elements may be the mesh's doing, and are told.
        """
        space = self.space(0)
        start, middle = space.reduce(np.log(self.unknowns.start)), (space.lower + space.upper) / 2
        found: Point | None = None
        for share in _RESTARTS:
            point = self.evaluate(space, start + share * (middle - start), EITHER)
            if point is None:
                continue
            if not any(one.slipped for one in self.responses(space.expand(point.z))):
                found = point
                break
            found = found or point
        if found is None:
            raise CalibrationError(f"no simulation completes near the start parameters: {self.failure}")
        self.accept(space.expand(found.z))
        state = SearchState(0, tuple(found.z.tolist()), FIRST_RADIUS, self.evaluations)
        return replace(state, history=(self.iterate(0, found),)), found

    def iterate(self, stage: int, point: Point) -> Iterate:
        parameters = self.space(stage).expand(point.z)
        errors = tuple(
            error_percent(response.force_N, site.force_N)
            for response, site in zip(self.responses(parameters), self.measured)
        )
        return Iterate(stage, tuple(parameters.tolist()), point.cost, errors, self.evaluations, self.failures)

    def states(self, state: SearchState | None) -> Iterator[SearchState]:
        """The first or resumed state, then one for every accepted step, finished stage and new stage."""
        state, point = self.first() if state is None else (state, self.again(state))
        yield state
        while True:
            space = self.space(state.stage)
            steps = () if len(state.stages) > state.stage else self._steps(space, point, state)
            for step in steps:
                point = step.point
                self.accept(space.expand(point.z))
                state = self._after(state, step)
                yield state
            if len(state.stages) == len(self.stages):
                return
            state, point = self._next_stage(state, space.logarithms(point.z))
            yield state

    def again(self, state: SearchState) -> Point:
        """The point at which a run was interrupted; its evaluation was counted then."""
        space = self.space(state.stage)
        for _ in range(_TRIES):
            point = self.evaluate(space, np.array(state.z), EITHER)
            self.evaluations, self.failures = state.evaluations, state.history[-1].failures
            if point is not None:
                self.accept(space.expand(point.z))
                self.folds = state.folds
                return point
        raise CalibrationError(f"the simulation of the stored iterate fails now: {self.failure}")

    def _steps(self, space: Space, point: Point, state: SearchState) -> Iterator[SearchStep]:
        done = sum(1 for iterate in state.history if iterate.stage == state.stage) - 1
        paper = self.settings.stopping == "paper"
        pointwise = self.settings.objective == "pointwise" and not paper
        norm = np.sqrt(sum(site.weight for site in self.measured))
        return minimise(
            lambda z: self.evaluate(space, z),
            point,
            space.lower,
            space.upper,
            tolerance=1e-9 if paper else self.settings.relative_tolerance,
            change=0.25 * self.settings.relative_tolerance * norm if pointwise else 0.0,
            radius=state.radius,
            max_iterations=max(self.settings.max_iterations - done, 1),
            stop=self._paper_rule(space) if paper else self._valley_rule(state),
        )

    def _after(self, state: SearchState, step: SearchStep) -> SearchState:
        """The state after an accepted step, the stage closed where it was the last."""
        history = state.history
        if tuple(step.point.z.tolist()) != state.z:
            history = (*history, self.iterate(state.stage, step.point))
        stages = state.stages
        if step.reason:
            mine = [iterate for iterate in history if iterate.stage == state.stage]
            counted = self.evaluations - sum(stage.evaluations for stage in stages)
            stages = (*stages, self._stage_result(state.stage, mine, counted, step))
        return SearchState(
            state.stage, tuple(step.point.z.tolist()), step.radius, self.evaluations, history, stages,
            self.folds,
        )  # fmt: skip

    def _stage_result(self, stage: int, mine: list[Iterate], counted: int, step: SearchStep) -> StageResult:
        last = mine[-1]
        reason = step.reason if step.converged or not self.failure else f"{step.reason} ({self.failure})"
        return StageResult(
            self.stages[stage], last.parameters, last.cost, len(mine) - 1, counted, step.converged, reason
        )

    def _next_stage(self, state: SearchState, logarithms: Array) -> tuple[SearchState, Point]:
        """The same parameters in the next space, in the ratios of the tissues' own starts.

        Where all tissues start alike, nothing is simulated unless the bounds forbid the parameters.
        """
        stage = state.stage + 1
        before, space = self.space(state.stage), self.space(stage)
        start = np.log(self.unknowns.start)
        own = start - before.logarithms(before.reduce(start))
        own[np.abs(own) < 1e-12] = 0.0  # rounding of the mean must not cost a simulation
        for share in _RATIOS if own.any() else (0.0,):
            z = space.reduce(logarithms + share * own)
            point = self.evaluate(space, z, ("folded",) if share else EITHER)
            if point is not None:
                self.accept(space.expand(z))
                break
        else:
            raise CalibrationError(f"stage {stage + 1} cannot start: {self.failure}")
        self.folds = 0
        history = (*state.history, self.iterate(stage, point))
        return SearchState(
            stage, tuple(z.tolist()), FIRST_RADIUS, self.evaluations, history, state.stages
        ), point

    def _valley_rule(self, state: SearchState) -> Callable[[Point, Point], str]:
        """Ends a creep along a valley in which the data cannot tell one place from another."""
        mine = [iterate for iterate in state.history if iterate.stage == state.stage]
        track = [(iterate.cost, iterate.failures) for iterate in mine]
        least = 1 - _PATIENCE * self.settings.relative_tolerance

        def stop(before: Point, after: Point) -> str:
            track.append((after.cost, self.failures))
            (cost, failures), (now, failed) = track[-1 - _PATIENCE :][0], track[-1]
            # Small steps after failures tell of the failures, not of the data.
            if len(track) > _PATIENCE and now > least * cost and failed == failures:
                return f"{_PATIENCE} steps hardly lowered the error: the data do not separate the parameters"
            return ""

        return stop

    def _paper_rule(self, space: Space) -> Callable[[Point, Point], str]:
        def stop(before: Point, after: Point) -> str:
            if np.abs(space.expand(after.z) - space.expand(before.z)).max() < _PAPER_CHANGE:
                return "no parameter changed by more than 0.01"
            if np.abs(self._equation_8(space, after) - self._equation_8(space, before)).max() < _PAPER_CHANGE:
                return "no entry of the objective changed by more than 0.01"
            return ""

        return stop

    def _equation_8(self, space: Space, point: Point) -> Array:
        """The paper's objective (sites,) N^2, whatever the objective that is followed."""
        return residuals("paper", self.responses(space.expand(point.z)), self.measured)[0]

    def result(self, state: SearchState) -> Calibration:
        parameters = np.array(state.history[-1].parameters)
        return Calibration(
            names=self.unknowns.names,
            sites=tuple(site.name for site in self.measured),
            parameters=parameters,
            stages=state.stages,
            history=state.history,
            evaluations=state.evaluations,
            settings=self.settings,
            responses=self.responses(parameters),
        )
