"""Coarse to fine: calibrate on cheap simulations whose forces are corrected by a few dear ones.

The correction (:class:`CoarseToFine`) is anchored anew at each optimum: the end of the iteration fits the
fine forces themselves; only its derivatives are the coarse ones, scaled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .calibration import calibrate, iterate_at
from .correction import CoarseToFine
from .objective import Measured, Simulate, SiteResponse, check_responses, new_doubts
from .parameters import Grouping, Unknowns, search_space, two_stages
from .state import Calibration, CalibrationSettings, Iterate, SearchState, StageResult
from .trust_region import FIRST_RADIUS

Array = NDArray[np.float64]

Forces = Callable[[Array], Sequence[SiteResponse]]
_LOOSE = 5.0  # times the tolerances where an answer is but the next start
_TRIES = 3  # of the fine simulations of a correction


@dataclass(frozen=True)
class Round:
    """One correction: the stage (-1: before any), its anchor, how far fine forces were from the expected.

    ``expected_percent``: mean absolute difference of the fine forces from the corrected coarse ones, in
    percent of the largest, per site. Sites that could not be corrected have None; ``reason`` says why, and
    then the correction before stands.
    """

    stage: int
    parameters: tuple[float, ...]
    scales: tuple[float | None, ...]
    difference_percent: tuple[float | None, ...]
    expected_percent: tuple[float | None, ...]
    reason: str = ""

    def settles(self, allowed_percent: float) -> bool:
        """Whether every site was corrected, and came out as expected."""
        known = [one for one in self.expected_percent if one is not None]
        return not self.reason and max(known, default=0.0) <= allowed_percent


@dataclass(frozen=True)
class FidelitySettings:
    """At most ``rounds`` corrections per stage, fewer where the fine forces are as expected at every site:
    within ``tolerance_percent``, or five times that in a stage that is but the start of another."""

    rounds: int = 3
    tolerance_percent: float = 0.1


@dataclass
class _Model:
    """The corrected coarse model; remembers coarse responses, which the anchors need again.

    What folds in a coarse mesh is that mesh's own and corrected with the rest: no trial is refused for it.
    """

    coarse: Simulate
    correction: CoarseToFine | None = None
    _known: dict[bytes, tuple[SiteResponse, ...]] = field(default_factory=dict)

    def plain(self, parameters: Array) -> tuple[SiteResponse, ...]:
        key = parameters.tobytes()
        if key not in self._known:
            self._known[key] = tuple(replace(one, folded="") for one in self.coarse(parameters))
        return self._known[key]

    def __call__(self, parameters: Array) -> Sequence[SiteResponse]:
        responses = self.plain(parameters)
        return responses if self.correction is None else self.correction(responses)


@dataclass(frozen=True)
class Corrected:
    """A calibration whose forces are the fine ones, and the corrections that led there."""

    calibration: Calibration
    rounds: tuple[Round, ...]
    correction: CoarseToFine | None


def calibrate_corrected(
    coarse: Simulate,
    fine: Forces,
    measured: Sequence[Measured],
    unknowns: Unknowns,
    settings: CalibrationSettings | None = None,
    fidelity: FidelitySettings | None = None,
    *,
    stages: Sequence[Grouping] = (),
    on_iterate: Callable[[SearchState], None] | None = None,
) -> Corrected:
    """Like :func:`calibrate`, on corrected coarse simulations.

    Parameters
    ----------
    coarse : force and derivatives per site, cheap.
    fine : forces per site, dear, without derivatives. Called once per round, again where it fails.
    fidelity : when corrections end.

    Notes
    -----
    An optimum whose fine forces fit worse than those of a round before went too far: the point half-way (in
    logarithms) is corrected too, and the best of a stage's corrected iterates is its answer.

    Nothing is stored between calls: given simulations that remember what they computed, a run taken up again
    repeats the interrupted one. Where a fine simulation fails, the correction before it is kept, and the
    stage has not converged.

    Raises
    ------
    CalibrationError
        Where no first simulation completes.
    """
    run = _Outer(
        _Model(coarse),
        fine,
        tuple(measured),
        unknowns,
        settings or CalibrationSettings(),
        fidelity or FidelitySettings(),
        tuple(stages) or two_stages(unknowns.names),
        on_iterate,
    )
    run.begin()
    for _ in run.stages:
        run.next_stage()
    return run.result()


@dataclass(frozen=True)
class _Standing:
    """A corrected iterate of a stage, its cost that of the fine forces, and the model as it was there."""

    state: SearchState
    iterate: Iterate
    correction: CoarseToFine

    @property
    def cost(self) -> float:
        return self.iterate.cost


@dataclass
class _Outer:
    """The loop over stages and corrections; ``state`` is that of the inner calibration at its end."""

    model: _Model
    fine: Forces
    measured: tuple[Measured, ...]
    unknowns: Unknowns
    settings: CalibrationSettings
    fidelity: FidelitySettings
    stages: tuple[Grouping, ...]
    on_iterate: Callable[[SearchState], None] | None
    state: SearchState | None = None
    history: tuple[Iterate, ...] = ()
    ended: tuple[StageResult, ...] = ()
    rounds: tuple[Round, ...] = ()

    def begin(self) -> None:
        """Correct at the start already, where it can be simulated: fine over coarse moves little."""
        space = search_space(self.unknowns, self.stages[0])
        start = space.expand(space.reduce(np.log(self.unknowns.start)))
        if not check_responses(self.model.plain(start), self.measured, len(start)):
            self._anchor(-1, start)

    def next_stage(self) -> None:
        """One stage to its end, corrected until coarse and fine agree on it."""
        stage, reason = len(self.ended), "the corrections have not settled"
        before = 0 if self.state is None else self.state.evaluations
        last = len(self.history)
        settled, is_last = False, stage == len(self.stages) - 1
        best: _Standing | None = None
        allowed = self.fidelity.tolerance_percent * (1.0 if is_last else _LOOSE)
        for _ in range(self.fidelity.rounds):
            loose = not is_last or self.model.correction is None
            inner = self._inner(stage, _LOOSE if loose else 1.0)
            reached = self._correct(stage)
            settled = reached.settles(allowed)
            if best is not None and not reached.reason and not settled and self._cost() > best.cost:
                self._go_half_way_back(stage, best)
                reached = self._correct(stage)
            if reached.reason:
                reason = f"the correction fails: {reached.reason}"
                break
            if best is None or self._cost() < best.cost:
                best = self._standing()
            if settled and not (is_last and loose):
                break
        if best is not None and best.cost < self._cost():
            self._return_to(best)
        assert self.state is not None
        end, converged = self.history[-1], inner.converged and settled
        result = replace(
            inner,
            cost=end.cost,
            iterations=len(self.history) - last - 1,
            evaluations=self.state.evaluations - before,
            converged=converged,
            reason=inner.reason if settled else f"{reason} ({inner.reason})",
        )
        self.ended = (*self.ended, result)
        self.state = replace(self.state, history=(end,), stages=self.ended)

    def _inner(self, stage: int, loose: float) -> StageResult:
        """The optimum of the model as it is corrected now, from where the round or stage before ended."""
        start = self.state

        def keep(state: SearchState) -> None:
            fresh = state.history[len(() if start is None else start.history) :]
            self.state = state
            if self.on_iterate:
                self.on_iterate(replace(state, history=(*self.history, *fresh), stages=self.ended))

        found = calibrate(
            self.model,
            self.measured,
            self.unknowns,
            replace(self.settings, relative_tolerance=loose * self.settings.relative_tolerance),
            stages=self.stages[: stage + 1],
            on_iterate=keep,
            state=start,
        )
        self.history += found.history[len(() if start is None else start.history) :]
        return found.stages[stage]

    def _cost(self) -> float:
        return self.history[-1].cost

    def _standing(self) -> _Standing:
        assert self.state is not None
        assert self.model.correction is not None
        return _Standing(self.state, self.history[-1], self.model.correction)

    def _return_to(self, best: _Standing) -> None:
        assert self.state is not None
        self.model.correction = best.correction
        here = replace(best.iterate, evaluations=self.state.evaluations)
        self.history = (*self.history, here)
        self.state = replace(best.state, history=(here,))

    def _go_half_way_back(self, stage: int, best: _Standing) -> None:
        assert self.state is not None
        z = 0.5 * (np.array(self.state.z) + np.array(best.state.z))
        parameters = search_space(self.unknowns, self.stages[stage]).expand(z)
        here = replace(self.history[-1], parameters=tuple(parameters.tolist()))
        self.history = (*self.history[:-1], here)
        self.state = replace(self.state, z=tuple(z.tolist()), history=(here,))

    def _correct(self, stage: int) -> Round:
        """Anchor the model at an optimum, and take the iterate there as the fine forces see it."""
        assert self.state is not None
        found = self._anchor(stage, np.array(self.history[-1].parameters))
        if not found.reason:
            standing = replace(self.state, radius=FIRST_RADIUS, stages=self.ended)
            here = iterate_at(self.model, self.measured, self.unknowns, self.settings, self.stages, standing)
            here = replace(here, evaluations=self.state.evaluations, failures=self.history[-1].failures)
            self.history = (*self.history, here)
            self.state = replace(standing, history=(here,))
        return found

    def _anchor(self, stage: int, parameters: Array) -> Round:
        """Simulate the fine forces, and correct the model by them unless that fails."""
        expected, coarse = self.model(parameters), self.model.plain(parameters)
        for _ in range(_TRIES):
            fine = self.fine(parameters)
            if all(response.completed for response in fine):
                break
        correction = CoarseToFine(coarse, fine)
        reasons = [f"{m.name}: {text}" for m, text in zip(self.measured, correction.reasons) if text]
        slipped, _ = new_doubts(fine, coarse, self.measured)
        reasons += [slipped] if slipped else []
        found = Round(
            stage,
            tuple(parameters.tolist()),
            correction.scales,
            correction.differences_percent,
            CoarseToFine(expected, fine).differences_percent,
            "; ".join(reasons),
        )
        self.rounds = (*self.rounds, found)
        if not reasons:
            self.model.correction = correction
        return found

    def result(self) -> Corrected:
        parameters = np.array(self.history[-1].parameters)
        assert self.state is not None
        calibration = Calibration(
            names=self.unknowns.names,
            sites=tuple(site.name for site in self.measured),
            parameters=parameters,
            stages=self.ended,
            history=self.history,
            evaluations=self.state.evaluations,
            settings=self.settings,
            responses=tuple(self.model(parameters)),
        )
        return Corrected(calibration, self.rounds, self.model.correction)
