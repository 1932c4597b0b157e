"""A layer of one material point under the indenter: the solver's steps in time, with nothing around them.

Its elastic force is a power of the depth; the memory, the steps and the force between them are the solver's
own.  Thousands of steps cost nothing, so the error of a few is known exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np

from limbfit.arrays import Array
from limbfit.fe import History, StepControl
from limbfit.fe.memory import Memory
from limbfit.fe.motion import Drives
from limbfit.fe.result import interpolate
from limbfit.fe.solution.control import predict_remaining_times, schedule_steps


@dataclass(frozen=True)
class LayerResult:
    """Steps (n,) at ``times`` s and their ``force``, of the elastic force at a depth of 1."""

    history: History
    times: Array
    force: Array

    def force_at(self, t: Array) -> Array:
        """Force (k,) at times ``t (k,)`` s, as `Result.force_at` has it."""
        return interpolate(self.times, self.force, self.history.kinks, self.force, np.asarray(t, dtype=float))


def solve_layer(
    history: History,
    control: StepControl,
    prony: Sequence[tuple[float, float]] = ((3.0, 0.32),),
    power: float = 2.0,
) -> LayerResult:
    """The force of a layer whose elastic force is the depth to a ``power``; prony : (g, tau in s)."""
    laws: Any = SimpleNamespace(prony=np.array([prony]))
    point: Any = SimpleNamespace(regions=np.zeros(1, dtype=int), weights=np.ones((1, 1)))
    memory = Memory.rest(point, laws)
    planned = schedule_steps(history, control)
    targets, times, forces = list(planned), [0.0], [0.0]
    while targets:
        t = targets.pop(0)
        dt, depth = t - times[-1], float(history.at(t))
        increment = memory.build_increment(point, laws, t, dt, depth, 0.0, Drives.make_empty())
        scale, offset = float(increment.scale[0]), float(increment.history[0, 0, 0])
        elastic = max(depth, 0.0) ** power
        force = scale * elastic + offset
        if force < 0.0:  # the indenter has left it
            elastic, force = max(-offset / scale, 0.0), 0.0
        memory = memory.advance(point, laws, np.full((1, 1, 6), elastic), dt)
        met = len(times) > 1 and (force > 0.0) != (forces[-1] > 0.0)
        kink = met or np.isclose(t, history.kinks, rtol=1e-9).any()
        if control.stress == "linear" or kink:
            memory = memory.drop_past()
        times.append(t)
        forces.append(force)
        if control.times is None:
            targets = predict_remaining_times(history, planned, targets, times, forces)
    return LayerResult(history, np.array(times), np.array(forces))


def solve_reference_layer(history: History, parts: int = 600, **layer: Any) -> LayerResult:
    """The same with ``parts`` steps in each phase; 600 have an error of about 1e-5 of the peak."""
    part = (np.arange(1, parts + 1) / parts) ** 2.0
    times = np.concatenate([p.start_s + p.duration_s * part for p in history.phases])
    return solve_layer(history, StepControl(times=tuple(times)), **layer)


def compute_curve_error(result: LayerResult, exact: LayerResult, count: int = 2001) -> tuple[float, float]:
    """Root mean square and largest error of the whole curve over the largest force, percent."""
    t = np.linspace(0.0, float(exact.times[-1]), count)
    force = np.interp(t, exact.times, exact.force)
    error = 100.0 * (result.force_at(t) - force) / exact.force.max()
    return float(np.sqrt((error**2).mean())), float(np.abs(error).max())
