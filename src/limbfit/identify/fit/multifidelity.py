"""Calibration on cheap coarse simulations that are corrected by a few expensive fine ones.

``F(p) = F_fine(a) + s (F_coarse(p) - F_coarse(a))`` per site. At the anchor ``a`` both meshes are simulated.
The scalar ``s`` takes the coarse curve there to the fine one in least squares. The correction is exact in
value at the anchor and scaled in slope (space mapping with a zero-order output map: Bandler 2004; the scaled
slope is that of manifold mapping with one singular direction: Echeverria and Hemker 2005).

It is anchored anew at each optimum. At the end of the iteration the forces that are fitted are the fine ones;
only the derivatives are the coarse ones, scaled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...arrays import Array
from ...errors import CalibrationError
from .calibration import (
    Calibration,
    CalibrationSettings,
    Iterate,
    SearchState,
    StageResult,
    calibrate,
    evaluate_state,
)
from .objective import MeasuredCurve, Simulate, SiteResponse, check_responses, find_new_warnings
from .parameters import Grouping, Unknowns, build_space, build_stage_groupings
from .prediction import compute_error_percent
from .trust_region import FIRST_RADIUS

# Of the coarse and of the fine simulations, in reasons
COARSE_MESH, FINE_MESH = "in the search", "on the whole mesh"
_LOOSENING = 5.0  # times the tolerances where an answer is but the next start
_MAX_TRIES = 3  # of the fine simulations of a correction


@dataclass(frozen=True)
class MeshCorrection:
    """The responses of sites at an anchor, on their coarse and on their fine meshes, in the same order.

    Calling it corrects coarse responses at any parameters. A site of which either response failed, is not
    finite or has no force is not corrected: ``reasons`` says why, and its corrected response has no numbers.
    The fine responses need no derivatives.

    Raises `CalibrationError` if the two, or the responses to be corrected, are not of the same sites and
    times: an error of the caller.
    """

    coarse: Sequence[SiteResponse]
    fine: Sequence[SiteResponse]

    def __post_init__(self) -> None:
        _check_same_sites(self.coarse, self.fine)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Why each site cannot be corrected; empty where it can."""
        pairs = zip(self.coarse, self.fine)
        return tuple(_find_fault(c, COARSE_MESH) or _find_fault(f, FINE_MESH) for c, f in pairs)

    @cached_property
    def scales(self) -> tuple[float | None, ...]:
        """The factor s of each site that takes the coarse curve to the fine one; None where there is none."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(
            None if reason else float(f.force_N @ c.force_N / (c.force_N @ c.force_N))
            for c, f, reason in pairs
        )

    @property
    def differences_percent(self) -> tuple[float | None, ...]:
        """Mean absolute difference of fine and coarse force per site, in percent of the largest fine one."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(
            None if reason else compute_error_percent(c.force_N, f.force_N) for c, f, reason in pairs
        )

    def __call__(self, responses: Sequence[SiteResponse]) -> list[SiteResponse]:
        """Return coarse responses (force and derivatives) as the fine meshes would give them."""
        _check_same_sites(responses, self.coarse)
        parts = zip(responses, self.coarse, self.fine, self.scales, self.reasons)
        return [_correct_response(*part) for part in parts]

    def select(self, sites: Sequence[int]) -> MeshCorrection:
        """Return the correction of some of the sites."""
        return MeshCorrection([self.coarse[i] for i in sites], [self.fine[i] for i in sites])


def _correct_response(
    response: SiteResponse, coarse: SiteResponse, fine: SiteResponse, scale: float | None, reason: str
) -> SiteResponse:
    if not response.completed:
        reason = reason or f"{COARSE_MESH}: {response.fault}"
    if scale is None or reason:
        nothing = np.full_like(response.force_N, np.nan), np.full_like(response.jacobian, np.nan)
        return SiteResponse(*nothing, False, reason, response.site)
    doubtful = dict.fromkeys(f"{COARSE_MESH}: {text}" for text in (*coarse.warnings, *response.warnings))
    return replace(
        response,
        force_N=fine.force_N + scale * (response.force_N - coarse.force_N),
        jacobian=scale * response.jacobian,
        warnings=(*fine.warnings, *doubtful),
    )


def _find_fault(response: SiteResponse, where: str) -> str:
    """Return why a response cannot be an anchor, or an empty text."""
    fault = response.fault or ("" if np.any(response.force_N) else "there is no force")
    return fault and f"{where}: {fault}"


def _check_same_sites(responses: Sequence[SiteResponse], expected: Sequence[SiteResponse]) -> None:
    if len(responses) != len(expected):
        raise CalibrationError(f"{len(responses)} and {len(expected)} responses are not of the same sites")
    for one, other in zip(responses, expected):
        if (one.site, one.force_N.shape) != (other.site, other.force_N.shape):
            raise CalibrationError(f"responses of sites {one.site!r} and {other.site!r}, or of other times")


@dataclass(frozen=True)
class CorrectionRound:
    """One correction: its stage (-1: before any), its anchor, and the difference of fine forces from expected
    ones.

    ``expected_percent`` is the mean absolute difference of the fine forces from the corrected coarse ones, in
    percent of the largest, per site. It is None for a site that could not be corrected. ``reason`` then says
    why, and the correction before stays in use.
    """

    stage: int
    parameters: tuple[float, ...]
    scales: tuple[float | None, ...]
    difference_percent: tuple[float | None, ...]
    expected_percent: tuple[float | None, ...]
    reason: str = ""


@dataclass(frozen=True)
class CorrectionSettings:
    """At most ``rounds`` corrections per stage, and fewer if the fine forces are as expected at every site.

    That is within ``tolerance_percent``, or within five times that in a stage that is not the last.
    """

    rounds: int = 3
    tolerance_percent: float = 0.1


@dataclass(frozen=True)
class SearchResult:
    """A calibration whose forces are the fine ones, and the corrections that led to it, if there were any."""

    calibration: Calibration
    rounds: tuple[CorrectionRound, ...] = ()


def calibrate_with_correction(
    coarse: Simulate,
    fine: Simulate,
    measured: Sequence[MeasuredCurve],
    unknowns: Unknowns,
    settings: CalibrationSettings | None = None,
    fidelity: CorrectionSettings | None = None,
    *,
    stages: Sequence[Grouping] = (),
    on_iterate: Callable[[SearchState], None] | None = None,
) -> SearchResult:
    """Calibrate as :func:`calibrate` does, on corrected coarse simulations.

    Raises `CalibrationError` if no first simulation completes.

    An optimum whose fine forces fit worse than those of an earlier round went too far: the point half-way
    back (in logarithms) is corrected too, and the best corrected iterate of a stage is its answer.

    Nothing is stored between calls. If the simulations remember what they computed, a continued run repeats
    the interrupted one. If a fine simulation fails, the correction before it is kept, and the stage has not
    converged.

    ``coarse``: returns force and derivatives per site; cheap. ``fine``: returns forces per site without
    derivatives; expensive. It is called once per round, and again if it fails. ``fidelity``: when corrections
    end.
    """
    run = _CorrectionLoop(
        coarse,
        fine,
        tuple(measured),
        unknowns,
        settings or CalibrationSettings(),
        fidelity or CorrectionSettings(),
        tuple(stages) or build_stage_groupings(unknowns.names),
        on_iterate,
    )
    run.begin()
    for _ in run.stages:
        run.run_stage()
    parameters = np.array(run.history[-1].parameters)
    calibration = Calibration(
        names=unknowns.names,
        sites=tuple(site.name for site in measured),
        parameters=parameters,
        stages=run.ended,
        history=run.history,
        evaluations=run.state.evaluations,
        settings=run.settings,
        responses=tuple(run.simulate(parameters)),
    )
    return SearchResult(calibration, run.rounds)


@dataclass
class _CorrectionLoop:
    """The loop over stages and corrections; ``state`` is that of the inner calibration at its end."""

    coarse: Simulate
    fine: Simulate
    measured: tuple[MeasuredCurve, ...]
    unknowns: Unknowns
    settings: CalibrationSettings
    fidelity: CorrectionSettings
    stages: tuple[Grouping, ...]
    on_iterate: Callable[[SearchState], None] | None
    state: SearchState = field(init=False)  # there is none before the first search
    history: tuple[Iterate, ...] = ()
    ended: tuple[StageResult, ...] = ()
    rounds: tuple[CorrectionRound, ...] = ()
    correction: MeshCorrection | None = None
    _stored: dict[bytes, tuple[SiteResponse, ...]] = field(default_factory=dict)

    def simulate_coarse(self, parameters: Array) -> tuple[SiteResponse, ...]:
        """Simulate on the coarse meshes; the anchors need the same responses again, so they are stored.

        Elements that fold in a coarse mesh are a property of that mesh and are corrected with the rest, so no
        trial is refused for them.
        """
        key = parameters.tobytes()
        if key not in self._stored:
            self._stored[key] = tuple(replace(one, folded="") for one in self.coarse(parameters))
        return self._stored[key]

    def simulate(self, parameters: Array) -> Sequence[SiteResponse]:
        """Simulate on the coarse meshes, corrected."""
        responses = self.simulate_coarse(parameters)
        return responses if self.correction is None else self.correction(responses)

    def begin(self) -> None:
        """Correct at the start if it can be simulated: the ratio of fine to coarse forces changes little."""
        space = build_space(self.unknowns, self.stages[0])
        start = space.expand(space.reduce(np.log(self.unknowns.start)))
        if not check_responses(self.simulate_coarse(start), self.measured, len(start)):
            self._anchor(-1, start)

    def run_stage(self) -> None:
        """Run one stage to its end, corrected until coarse and fine forces agree on it."""
        stage, reason = len(self.ended), "the corrections have not settled"
        last = len(self.history)
        before = self.state.evaluations if last else 0
        settled, is_last = False, stage == len(self.stages) - 1
        best: tuple[SearchState, MeshCorrection] | None = None
        least = np.inf  # the cost of the fine forces there
        allowed = self.fidelity.tolerance_percent * (1.0 if is_last else _LOOSENING)
        for _ in range(self.fidelity.rounds):
            loose = not is_last or self.correction is None
            inner = self._search(stage, _LOOSENING if loose else 1.0)
            reached = self._correct(stage)
            off = max((one for one in reached.expected_percent if one is not None), default=0.0)
            settled = not reached.reason and off <= allowed
            if best is not None and not reached.reason and not settled and self._cost() > least:
                self._step_half_way_back(stage, best[0])
                reached = self._correct(stage)
            if reached.reason:
                reason = f"the correction fails: {reached.reason}"
                break
            if self._cost() < least:
                assert self.correction is not None
                best, least = (self.state, self.correction), self._cost()
            if settled and not (is_last and loose):
                break
        if best is not None and least < self._cost():
            state, self.correction = best
            end = replace(state.history[-1], evaluations=self.state.evaluations)
            self.history, self.state = (*self.history, end), replace(state, history=(end,))
        end = self.history[-1]
        result = replace(
            inner,
            cost=end.cost,
            iterations=len(self.history) - last - 1,
            evaluations=self.state.evaluations - before,
            converged=inner.converged and settled,
            reason=inner.reason if settled else f"{reason} ({inner.reason})",
        )
        self.ended = (*self.ended, result)
        self.state = replace(self.state, history=(end,), stages=self.ended)

    def _search(self, stage: int, loose: float) -> StageResult:
        """Find the optimum of the model with the present correction, from where the search ended before."""
        start = self.state if self.history else None
        known = len(start.history) if start else 0

        def keep(state: SearchState) -> None:
            self.state = state
            if self.on_iterate:
                whole = (*self.history, *state.history[known:])
                self.on_iterate(replace(state, history=whole, stages=self.ended))

        found = calibrate(
            self.simulate,
            self.measured,
            self.unknowns,
            replace(self.settings, relative_tolerance=loose * self.settings.relative_tolerance),
            stages=self.stages[: stage + 1],
            on_iterate=keep,
            state=start,
        )
        self.history += found.history[known:]
        return found.stages[stage]

    def _cost(self) -> float:
        return self.history[-1].cost

    def _step_half_way_back(self, stage: int, best: SearchState) -> None:
        z = 0.5 * (np.array(self.state.z) + np.array(best.z))
        parameters = build_space(self.unknowns, self.stages[stage]).expand(z)
        here = replace(self.history[-1], parameters=tuple(parameters.tolist()))
        self.history = (*self.history[:-1], here)
        self.state = replace(self.state, z=tuple(z.tolist()), history=(here,))

    def _correct(self, stage: int) -> CorrectionRound:
        """Anchor the model at an optimum, and evaluate the iterate there with the fine forces."""
        found = self._anchor(stage, np.array(self.history[-1].parameters))
        if not found.reason:
            anchored = replace(self.state, radius=FIRST_RADIUS, stages=self.ended)
            here = evaluate_state(
                self.simulate, self.measured, self.unknowns, self.settings, self.stages, anchored
            )
            self.history = (*self.history, here)
            self.state = replace(anchored, history=(here,))
        return found

    def _anchor(self, stage: int, parameters: Array) -> CorrectionRound:
        """Simulate the fine forces, and correct the model by them unless that fails."""
        expected, coarse = self.simulate(parameters), self.simulate_coarse(parameters)
        for _ in range(_MAX_TRIES):
            fine = self.fine(parameters)
            if all(response.completed for response in fine):
                break
        correction = MeshCorrection(coarse, fine)
        reasons = [f"{m.name}: {text}" for m, text in zip(self.measured, correction.reasons) if text]
        slipped, _ = find_new_warnings(fine, coarse, self.measured)
        reasons += [slipped] if slipped else []
        found = CorrectionRound(
            stage,
            tuple(parameters.tolist()),
            correction.scales,
            correction.differences_percent,
            MeshCorrection(expected, fine).differences_percent,
            "; ".join(reasons),
        )
        self.rounds = (*self.rounds, found)
        if not reasons:
            self.correction = correction
        return found
