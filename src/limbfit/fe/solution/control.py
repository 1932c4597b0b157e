"""How a simulation steps, and when.

Steps are placed beforehand, from the history alone, so that simulations of one site step at the same times
whatever their parameters.  They are dense after every turn of the indenter: there the force relaxes with the
tissue's own times, known only to lie between a hundredth of the ramp and its length; what relaxes at a
constant rate of displacement is the more, the slower.  The fourth derivative of such a force falls with the
cube of the time since the turn, so that steps whose error in a cubic is the same are denser towards the turn
by a power of their number.  That power is the one with the smallest largest error over relaxation times from
0.1 to 3 s (``benchmarks/time_steps.py``).

Steps that do not converge are cut.  An equilibrium that can be followed takes few iterations in short steps.
Where even those fail it has come to its end (tissue snaps past the indenter, or folds); the next one is many
iterations away, however short the step, and they are allowed there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from ...arrays import Array
from ...phases import MotionPhase
from ..problem import History, ProblemError


@dataclass(frozen=True)
class StepControl:
    """How a simulation steps; the defaults need no change.

    Parameters
    ----------
    load_steps, unload_steps : steps of an indentation on the way in and on the way out, before any is cut.
    times : (k,) s, instead of the two numbers: exactly these steps (rest at 0 left out).
    stress : how the elastic stress changes in a step: ``quadratic``, through the step before it, or
        ``linear``, as FEBio has it (second order in the step instead of third).
    tolerance : residual over reactions at equilibrium.
    max_iterations, most_iterations : of Newton's method in a step, and in all.
    max_cuts : how often a step may be cut, to 0.3 of it each time.
    penetration : largest penetration over the largest displacement; the penalty is raised beyond it.
    penalty : contact stiffness over the mean instantaneous shear modulus, 1/mm; None: 2000 / width.
    hold_penalty : it is never raised, so that forces of neighbouring parameters do not jump; a deeper
        penetration is a warning of the result.
    linear_solver : name in the solver table, multigrid (``tet10`` only), or auto.
    threads : of assembly and linear algebra.
    """

    load_steps: int = 8
    unload_steps: int = 10
    times: tuple[float, ...] | None = None
    stress: str = "quadratic"
    tolerance: float = 3e-5
    max_iterations: int = 60
    most_iterations: int = 1500
    max_cuts: int = 5
    penetration: float = 0.01
    penalty: float | None = None
    hold_penalty: bool = False
    linear_solver: str = "auto"
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("load_steps", "unload_steps", "max_iterations", "most_iterations", "threads"):
            if getattr(self, name) < 1:
                raise ProblemError(f"{name} = {getattr(self, name)} is less than one")
        for name in ("tolerance", "penetration", *(["penalty"] if self.penalty is not None else [])):
            if not getattr(self, name) > 0.0:
                raise ProblemError(f"{name} = {getattr(self, name)} is not positive")
        if self.stress not in ("quadratic", "linear"):
            raise ProblemError(f"unknown stress {self.stress!r}", remedy="use 'quadratic' or 'linear'")
        times = np.asarray(self.times if self.times is not None else (1.0,), dtype=float)
        if not (len(times) and np.isfinite(times).all() and (np.diff([0.0, *times]) > 0.0).all()):
            raise ProblemError("the times of the steps do not grow from 0")


def schedule_steps(history: History, control: StepControl, turns: Sequence[float] | Array = ()) -> Array:
    """Times (k,) of the steps, s, before any is cut: those stated, or as `grade_steps` places them.

    The ``turns (k,)`` of further bodies are among those placed.
    """
    if control.times is None:
        return insert_turning_points(
            grade_steps(history, control.load_steps, control.unload_steps), np.asarray(turns, dtype=float)
        )
    if control.times[-1] > history.times[-1] * (1.0 + 1e-9):
        what = f"a step at {control.times[-1]} s lies beyond the history's end at {history.times[-1]} s"
        raise ProblemError(what)
    return np.asarray(control.times, dtype=float)


# Powers of the step's number that the time in a phase goes with: from rest, and after the indenter turned.
FROM_REST, AFTER_TURN = 1.2, 3.0
REST_SHARE = 0.05  # of the deepest: an indenter that comes from there hardly touches
# The step put in before contact ends is at one of so many even places in the step that was planned, the last
# that is short of this share of the way to where the force is predicted to vanish: places that do not move
# with the parameters.  What is predicted a little beyond the next step may come before it.
PLACES, SHORT_OF_END, LOOK_AHEAD = 4, 0.9, 1.1


def grade_steps(history: History, load_steps: int, unload_steps: int) -> Array:
    """Times (k,) s of the steps, the end of every phase and every turn across the axis among them.

    Phases of one kind in a row share the number of steps by their lengths, but have no fewer than half of it;
    a hold has as many as unloading.  One of those is left for the end of contact
    (see `predict_remaining_times`).
    """
    budget = {"load": load_steps, "unload": unload_steps - 1, "hold": unload_steps}
    budget["approach"] = 2
    times: list[Array] = []
    travel = float(history.driver.max())
    for kind, group in groupby(history.phases, key=lambda phase: phase.kind):
        row = list(group)
        whole = sum(phase.duration_s for phase in row)
        for phase in row:
            count = round(budget[kind] * phase.duration_s / whole)
            count = max(count, (budget[kind] + 1) // 2)
            fresh = phase.start_mm <= REST_SHARE * travel and (kind == "load" or not times)
            power = FROM_REST if fresh else AFTER_TURN
            part = (np.arange(1, count + 1) / count) ** power
            times.append(phase.start_s + phase.duration_s * part)
    return insert_turning_points(np.concatenate(times), history.turns)


def insert_turning_points(times: Array, turns: Array) -> Array:
    """The times and those of the ``turns (k,)`` that are not among them, up to the last time."""
    inside = turns[turns < times[-1]]
    apart = np.abs(times[:, None] - inside).min(axis=0) > 1e-9 * times[-1]
    return np.union1d(times, inside[apart])


def predict_remaining_times(
    history: History, planned: Array, left: Sequence[float], times: Sequence[float], forces: Sequence[float]
) -> list[float]:
    """The times still to be reached, s: those ``left`` of the ``planned``, given the ``forces`` at ``times``.

    In unloading, a step is put in just before contact is about to end.  Where it has ended in the last phase,
    one step leads to the end of the history: there are no more steps than planned and one.
    """
    targets, now = list(left), times[-1]
    if history.forced or not targets:  # contact ends where the force is stated to
        return targets
    middle = 0.5 * (now + targets[0])
    phase = next((phase for phase in history.phases if phase.start_s <= middle <= phase.end_s), None)
    if phase is None or phase.kind != "unload":
        return targets
    if forces[-1] <= 0.0 and now > phase.start_s:
        return targets[-1:] if phase is history.phases[-1] else targets
    made, allowed = _count(phase, np.asarray(times)), _count(phase, planned) + 1
    ahead = targets[0] - now
    if made + 1 + _count(phase, np.asarray(targets)) > allowed:
        return targets
    end = _predict_contact_end(phase, np.asarray(times), np.asarray(forces)) - now
    if end < LOOK_AHEAD * ahead:
        place = min(int(PLACES * SHORT_OF_END * end / ahead), PLACES - 1)
        targets[:0] = [now + ahead * place / PLACES] if place else []
    return targets


def _count(phase: MotionPhase, times: Array) -> int:
    """How many of the times lie in a phase, its start left out."""
    little = 1e-9 * phase.end_s
    return int(((times > phase.start_s + little) & (times <= phase.end_s + little)).sum())


def _predict_contact_end(phase: MotionPhase, times: Array, forces: Array) -> float:
    """When the force is predicted to vanish, s: its rate changes by the factor by which it changed last."""
    recent = np.flatnonzero(times >= phase.start_s * (1.0 - 1e-9))[-3:]
    if len(recent) < 3:
        return np.inf
    before, last = np.diff(forces[recent]) / np.diff(times[recent])
    if before >= 0.0 or last >= 0.0:
        return np.inf
    return float(times[-1] - forces[-1] * before / last**2)


# A step that fails is cut to this share; from so many cuts on, so many times the iterations are allowed.
CUT, CUTS_TO_PATIENCE, PATIENCE = 0.3, 2, 5


@dataclass
class StepController:
    """How far the next step goes: to the next planned time, or a part of the way after a step that failed.

    ``usual`` iterations are allowed for an equilibrium as a rule; ``stride``, s, is the longest step now, and
    ``until`` how far steps that failed went; ``cuts`` counts those that are in force.
    """

    usual: int
    stride: float = np.inf
    until: float = 0.0
    cuts: int = 0

    @property
    def patience(self) -> int:
        """Iterations that are allowed for the next step."""
        return self.usual * (PATIENCE if self.cuts >= CUTS_TO_PATIENCE else 1)

    def next_time(self, now: float, target: float) -> float:
        """The end of the next step from ``now``, s; no step is much shorter than the one before it."""
        left = target - now
        if left <= 1.3 * self.stride:
            return target
        return now + min(self.stride, 0.5 * left)

    def cut(self, now: float, t: float) -> None:
        """Shorten the steps, after the one to ``t`` failed."""
        self.stride, self.until = CUT * (t - now), max(t, self.until)
        self.cuts += 1

    def accept(self, now: float, t: float, iterations: int) -> None:
        """Lengthen the steps again, after one to ``t`` beyond those that had failed was made."""
        if iterations > self.usual:  # another equilibrium: what was hard before is behind
            self.stride, self.cuts = np.inf, 0
        elif t >= self.until:
            self.stride, self.cuts = 2.0 * max(self.stride, t - now), max(self.cuts - 1, 0)
