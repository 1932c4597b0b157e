"""When a simulation steps: dense after every turn of the indenter, once more where contact is about to end.

Placed beforehand, from the history alone, so that simulations of one site step at the same times whatever
their parameters.  After a turn the force relaxes with the tissue's own times, known only to lie between a
hundredth of the ramp and its length; what relaxes at a constant rate of displacement is the more, the slower.
The fourth derivative of such a force falls with the cube of the time since the turn, so that steps whose
error in a cubic is the same are denser towards the turn by a power of their number.  That power is the one
with the smallest largest error over relaxation times from 0.1 to 3 s (``benchmarks/time_steps.py``).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from ...phases import MotionPhase
from ..problem import History

Array = NDArray[np.float64]

# Powers of the step's number that the time in a phase goes with: from rest, and after the indenter turned.
FROM_REST, AFTER_TURN = 1.2, 3.0
AT_REST = 0.05  # of the deepest: an indenter that comes from there hardly touches
# The step put in before contact ends is at one of so many even places in the step that was planned, the last
# that is short of this share of the way to where the force is foreseen to vanish: places that do not move
# with the parameters.  What is foreseen a little beyond the next step may come before it.
PLACES, SHORT_OF_END, FORESIGHT = 4, 0.9, 1.1


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
            fresh = not times or (kind == "load" and phase.start_mm <= AT_REST * travel)
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
    if history.forced:  # contact ends where the force is stated to
        return targets
    phase = _find_phase(history, now, targets[0]) if targets else None
    if phase is None or phase.kind != "unload":
        return targets
    if forces[-1] <= 0.0 and now > phase.start_s:
        return targets[-1:] if phase is history.phases[-1] else targets
    made, allowed = _count(phase, np.asarray(times)), _count(phase, planned) + 1
    ahead = targets[0] - now
    if made + 1 + _count(phase, np.asarray(targets)) > allowed:
        return targets
    end = _end_of_contact(phase, np.asarray(times), np.asarray(forces)) - now
    if end < FORESIGHT * ahead:
        place = min(int(PLACES * SHORT_OF_END * end / ahead), PLACES - 1)
        targets[:0] = [now + ahead * place / PLACES] if place else []
    return targets


def _count(phase: MotionPhase, times: Array) -> int:
    """How many of the times lie in a phase, its start left out."""
    little = 1e-9 * phase.end_s
    return int(((times > phase.start_s + little) & (times <= phase.end_s + little)).sum())


def _find_phase(history: History, now: float, target: float) -> MotionPhase | None:
    """The phase of the step from ``now`` to ``target``."""
    middle = 0.5 * (now + target)
    return next((phase for phase in history.phases if phase.start_s <= middle <= phase.end_s), None)


def _end_of_contact(phase: MotionPhase, times: Array, forces: Array) -> float:
    """When the force is foreseen to vanish, s: its rate changes by the factor by which it changed last."""
    recent = np.flatnonzero(times >= phase.start_s * (1.0 - 1e-9))[-3:]
    if len(recent) < 3:
        return np.inf
    before, last = np.diff(forces[recent]) / np.diff(times[recent])
    if before >= 0.0 or last >= 0.0:
        return np.inf
    return float(times[-1] - forces[-1] * before / last**2)
