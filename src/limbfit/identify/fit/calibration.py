"""The calibration: stages of bounded least squares on a simulation that is handed in.

``calibrate`` knows no study, no mesh and no solver. It calls ``simulate(parameters)``, which returns force
and derivatives of every site. It can be stopped after any accepted iterate, and continues from its ``state``
with the same answer.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from .objective import (
    MeasuredCurve,
    Objective,
    Simulate,
    SiteResponse,
    check_responses,
    compute_residuals,
    find_new_warnings,
)
from .parameters import Grouping, SearchSpace, Unknowns, build_space, build_stage_groupings
from .prediction import compute_errors_percent
from .trust_region import FIRST_RADIUS, SearchPoint, SearchStep, minimise

# Where the very first simulation fails: once more, then ever closer to the middle of the bounds.
_START_SHIFTS = (0.0, 0.0, 0.1, 0.25, 0.5)
# Shares of the ratios between the tissues' own starts; the next stage begins with the first that completes.
_RATIO_SHARES = (1.0, 0.5, 0.0)
_PAPER_CHANGE = 0.01
_VALLEY_STEPS = 4
_MAX_TRIES = 3  # of a simulation that completed before
START_WARNINGS = ("slipped", "folded")
_MAX_FOLD_REFUSALS = 3  # trials of a stage that fold anew are refused; more are taken for what they are


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


def calibrate(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    settings: CalibrationSettings | None = None,
    *,
    stages: Sequence[Grouping] = (),
    on_iterate: Callable[[SearchState], None] | None = None,
    state: SearchState | None = None,
) -> Calibration:
    """Find the parameters that bring the simulated forces closest to the measured ones.

    Raises `CalibrationError` if no first simulation completes.

    Parameters
    ----------
    simulate : takes full parameters (p,) and returns one response per site, in the order of ``measured``. If
        a response is not completed or not finite, the trial fails and a shorter step is tried. The same holds
        if a simulation slipped that did not slip before the step, and for the first three trials of a stage
        in which elements fold that did not fold before.
    measured : the measured curves, at the times at which ``simulate`` gives the force.
    unknowns : names, start and bounds of the full parameters.
    stages : groupings (see ``build_space``), by default ``build_stage_groupings``. Each stage starts from
        the end of the one before. If tissues have different starts, which a stage with one material cannot
        represent, the next stage begins with the same ratios between the tissues.
    on_iterate : called after every accepted iterate with the state from which the search can continue.
    state : continue from here. One evaluation at its parameters is repeated and not counted.
    """
    groupings = tuple(stages) or build_stage_groupings(unknowns.names)
    run = _Search(simulate, tuple(measured), unknowns, settings or CalibrationSettings(), groupings)
    for current in run.iterate_states(state):
        if on_iterate:
            on_iterate(current)
    parameters = np.array(current.history[-1].parameters)
    return Calibration(
        names=unknowns.names,
        sites=tuple(site.name for site in measured),
        parameters=parameters,
        stages=current.stages,
        history=current.history,
        evaluations=current.evaluations,
        settings=run.settings,
        responses=run.responses_at(parameters),
    )


def evaluate_state(
    simulate: Simulate,
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    settings: CalibrationSettings,
    groupings: Sequence[Grouping],
    state: SearchState,
) -> Iterate:
    """Return the iterate at a state, simulated by ``simulate`` and not counted as an evaluation.

    Raises `CalibrationError` if it cannot be simulated.
    """
    run = _Search(simulate, tuple(measured), unknowns, settings, tuple(groupings))
    return run.build_iterate(state.stage, run.restore(state))


@dataclass
class _Search:
    """A calibration in progress: counts evaluations and keeps the responses of the last accepted point."""

    simulate: Simulate
    measured: tuple[MeasuredCurve, ...]
    unknowns: Unknowns
    settings: CalibrationSettings
    stages: tuple[Grouping, ...]
    evaluations: int = 0
    failures: int = 0
    failure: str = ""  # why the last one failed
    fold_refusals: int = 0  # trials of this stage that were refused for what folds in them
    _accepted: tuple[SiteResponse, ...] = ()  # at the last accepted point
    _stored: dict[bytes, tuple[SiteResponse, ...]] = field(default_factory=dict)

    def build_space(self, stage: int) -> SearchSpace:
        return build_space(self.unknowns, self.stages[stage])

    def evaluate(self, space: SearchSpace, z: Array, tolerated: tuple[str, ...] = ()) -> SearchPoint | None:
        """Return the point at z, simulated unless its responses are stored; None if a simulation failed.

        ``tolerated`` are the kinds of warnings that do not count as a failure.
        """
        parameters = space.expand(z)
        responses = self._stored.get(parameters.tobytes())
        if responses is None:
            self.evaluations += 1
            responses = tuple(self.simulate(parameters))
            self.failure = check_responses(responses, self.measured, len(parameters))
            if not self.failure:
                self.failure = self._find_refusal(responses, tolerated)
            if self.failure:
                self.failures += 1
                return None
            self._stored[parameters.tobytes()] = responses
        residual, jacobian = compute_residuals(self.settings.objective, responses, self.measured)
        rows, target = self.unknowns.build_prior_rows()
        scale = self.settings.force_error_percent / 100
        prior_residual = scale * (rows @ space.to_logarithms(z) - target)
        jacobian = np.concatenate([space.pull_back(jacobian, parameters), scale * rows @ space.tie])
        return SearchPoint(z, np.concatenate([residual, prior_residual]), jacobian)

    def _find_refusal(self, responses: tuple[SiteResponse, ...], tolerated: tuple[str, ...]) -> str:
        """Return why a completed trial counts as failed, or an empty text.

        A simulation that slipped gives the force of another equilibrium. Elements fold gradually: long steps
        into folding are refused, but no optimum is given up for it, and the search must not zigzag along its
        border.
        """
        slipped, folded = find_new_warnings(responses, self._accepted, self.measured)
        if slipped and "slipped" not in tolerated:
            return slipped
        if not folded or "folded" in tolerated or self.fold_refusals >= _MAX_FOLD_REFUSALS:
            return ""
        self.fold_refusals += 1
        return folded

    def responses_at(self, parameters: Array) -> tuple[SiteResponse, ...]:
        return self._stored[parameters.tobytes()]

    def accept(self, parameters: Array) -> None:
        """Keep only the responses of an accepted point; its warnings are no longer new."""
        self._accepted = self.responses_at(parameters)
        self._stored = {parameters.tobytes(): self._accepted}

    def find_start(self) -> tuple[SearchState, SearchPoint]:
        """Find a first point at which all simulations complete: the start, or nearer to the bounds' middle.

        A point at which nothing slips is preferred. Folded elements may come from the mesh and are only
        reported.
        """
        space = self.build_space(0)
        start, middle = space.reduce(np.log(self.unknowns.start)), (space.lower + space.upper) / 2
        first: SearchPoint | None = None
        for share in _START_SHIFTS:
            point = self.evaluate(space, start + share * (middle - start), START_WARNINGS)
            if point is None:
                continue
            if not any(one.slipped for one in self.responses_at(space.expand(point.z))):
                first = point
                break
            first = first or point
        if first is None:
            raise CalibrationError(f"no simulation completes near the start parameters: {self.failure}")
        self.accept(space.expand(first.z))
        state = SearchState(0, tuple(first.z.tolist()), FIRST_RADIUS, self.evaluations)
        return replace(state, history=(self.build_iterate(0, first),)), first

    def build_iterate(self, stage: int, point: SearchPoint) -> Iterate:
        parameters = self.build_space(stage).expand(point.z)
        errors = compute_errors_percent(self.responses_at(parameters), self.measured)
        return Iterate(stage, tuple(parameters.tolist()), point.cost, errors, self.evaluations, self.failures)

    def iterate_states(self, state: SearchState | None) -> Iterator[SearchState]:
        """Yield the first or continued state, then one after every accepted step and at each new stage."""
        state, point = self.find_start() if state is None else (state, self.restore(state))
        yield state
        while True:
            space = self.build_space(state.stage)
            steps = () if len(state.stages) > state.stage else self._steps(space, point, state)
            for step in steps:
                point = step.point
                self.accept(space.expand(point.z))
                state = self._advance(state, step)
                yield state
            if len(state.stages) == len(self.stages):
                return
            state, point = self._begin_stage(state, space.to_logarithms(point.z))
            yield state

    def restore(self, state: SearchState) -> SearchPoint:
        """Evaluate the point at which a run was interrupted; this evaluation was counted before."""
        space = self.build_space(state.stage)
        for _ in range(_MAX_TRIES):
            point = self.evaluate(space, np.array(state.z), START_WARNINGS)
            self.evaluations, self.failures = state.evaluations, state.history[-1].failures
            if point is not None:
                self.accept(space.expand(point.z))
                self.fold_refusals = state.folds
                return point
        raise CalibrationError(f"the simulation of the stored iterate fails now: {self.failure}")

    def _steps(self, space: SearchSpace, point: SearchPoint, state: SearchState) -> Iterator[SearchStep]:
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
            stop=self._make_paper_rule(space) if paper else self._make_valley_rule(state),
        )

    def _advance(self, state: SearchState, step: SearchStep) -> SearchState:
        """Return the state after an accepted step, which closes the stage if it was its last."""
        z, history, stages = tuple(step.point.z.tolist()), state.history, state.stages
        if z != state.z:
            history = (*history, self.build_iterate(state.stage, step.point))
        if step.reason:
            failed = self.failure and not step.converged
            result = StageResult(
                grouping=self.stages[state.stage],
                parameters=history[-1].parameters,
                cost=history[-1].cost,
                iterations=sum(1 for iterate in history if iterate.stage == state.stage) - 1,
                evaluations=self.evaluations - sum(stage.evaluations for stage in stages),
                converged=step.converged,
                reason=f"{step.reason} ({self.failure})" if failed else step.reason,
            )
            stages = (*stages, result)
        return SearchState(state.stage, z, step.radius, self.evaluations, history, stages, self.fold_refusals)

    def _begin_stage(self, state: SearchState, logarithms: Array) -> tuple[SearchState, SearchPoint]:
        """Take the same parameters into the next stage, with the ratios of the tissues' own starts.

        If all tissues start alike, nothing is simulated unless the bounds exclude the parameters.
        """
        stage = state.stage + 1
        last_space, space = self.build_space(state.stage), self.build_space(stage)
        start = np.log(self.unknowns.start)
        tissue_offsets = start - last_space.to_logarithms(last_space.reduce(start))
        # Rounding of the mean must not cost a simulation.
        tissue_offsets[np.abs(tissue_offsets) < 1e-12] = 0.0
        for share in _RATIO_SHARES if tissue_offsets.any() else (0.0,):
            z = space.reduce(logarithms + share * tissue_offsets)
            point = self.evaluate(space, z, ("folded",) if share else START_WARNINGS)
            if point is not None:
                self.accept(space.expand(z))
                break
        else:
            raise CalibrationError(f"stage {stage + 1} cannot start: {self.failure}")
        self.fold_refusals = 0
        history = (*state.history, self.build_iterate(stage, point))
        state = SearchState(stage, tuple(z.tolist()), FIRST_RADIUS, self.evaluations, history, state.stages)
        return state, point

    def _make_valley_rule(self, state: SearchState) -> Callable[[SearchPoint, SearchPoint], str]:
        """Build the rule that ends slow progress along a valley that the data leave open."""
        iterates = [iterate for iterate in state.history if iterate.stage == state.stage]
        track = [(iterate.cost, iterate.failures) for iterate in iterates]
        least = 1 - _VALLEY_STEPS * self.settings.relative_tolerance

        def stop(before: SearchPoint, after: SearchPoint) -> str:
            track.append((after.cost, self.failures))
            (cost, failures), (now, failed) = track[-1 - _VALLEY_STEPS :][0], track[-1]
            # Small steps after failures tell of the failures, not of the data.
            if len(track) > _VALLEY_STEPS and now > least * cost and failed == failures:
                why = "hardly lowered the error: the data do not separate the parameters"
                return f"{_VALLEY_STEPS} steps {why}"
            return ""

        return stop

    def _make_paper_rule(self, space: SearchSpace) -> Callable[[SearchPoint, SearchPoint], str]:
        def stop(before: SearchPoint, after: SearchPoint) -> str:
            first, second = space.expand(before.z), space.expand(after.z)
            if np.abs(second - first).max() < _PAPER_CHANGE:
                return "no parameter changed by more than 0.01"
            # The paper's objective (sites,) in N^2, whatever objective the search follows.
            old, new = (
                compute_residuals("paper", self.responses_at(p), self.measured)[0] for p in (first, second)
            )
            stays = np.abs(new - old).max() < _PAPER_CHANGE
            return "no entry of the objective changed by more than 0.01" if stays else ""

        return stop


def move_answer(
    calibration: Calibration,
    parameters: Array,
    measured: Sequence[MeasuredCurve],
    responses: Sequence[SiteResponse],
    unknowns: Unknowns,
) -> Calibration | str:
    """Return the calibration with its last stage moved to ``parameters`` (p,), whose ``responses`` are given.

    If a simulation failed there, the reason is returned instead.
    """
    if failure := check_responses(responses, measured, len(parameters)):
        return failure
    left, _ = compute_residuals(calibration.settings.objective, responses, measured)
    rows, target = unknowns.build_prior_rows()
    prior_deviations = calibration.settings.force_error_percent / 100 * (rows @ np.log(parameters) - target)
    cost = 0.5 * float(left @ left + prior_deviations @ prior_deviations)
    before, last = calibration.history[-1], calibration.stages[-1]
    errors = compute_errors_percent(responses, measured)
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
        calibration,
        parameters=np.array(end),
        stages=(*calibration.stages[:-1], stage),
        history=(*calibration.history, iterate),
        evaluations=calibration.evaluations + 1,
        responses=tuple(responses),
    )
