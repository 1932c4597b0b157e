"""Time in a FEBio input: steps and the automatic time stepper.

Source: FEBio User Manual 4.0, section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .curves import Curve
from .tree import Node

Array = NDArray[np.float64]
MOST_STEPS = 20_000


@dataclass(frozen=True)
class ControlPhase:
    """A step of the analysis: ``steps`` of ``size`` s.

    With ``most`` (s, or the number of the curve that gives it) FEBio adapts them, not below ``least``;
    the points of that curve are met.  ``tolerance`` is that of the displacements.
    """

    steps: int
    size: float
    least: float = 0.0
    most: float | None = None
    must: int | None = None
    tolerance: float = 1e-3

    @property
    def seconds(self) -> float:
        return self.steps * self.size


def read_phases(root: Node, curves: Mapping[int, Curve]) -> tuple[ControlPhase, ...]:
    """The analysis steps, in order."""
    steps = root.find("Step")
    if steps is not None and len(steps):
        for step in steps:
            for child in step:
                if child.tag not in ("Control", "Rigid"):
                    raise child.refuse("only <Control> and <Rigid> may change from step to step")
        controls = [step.child("Control") for step in steps]
    else:
        controls = [root.child("Control")]
    phases = tuple(_phase(control, curves) for control in controls)
    if sum(phase.steps for phase in phases) > MOST_STEPS:
        raise controls[0].refuse(f"has more than {MOST_STEPS} steps")
    return phases


def _phase(node: Node, curves: Mapping[int, Curve]) -> ControlPhase:
    analysis = node.string("analysis", "STATIC").upper()
    if analysis not in ("STATIC", "STEADY-STATE"):
        raise node.child("analysis").refuse(f"an analysis of type {analysis} is not supported, only STATIC")
    steps, size = node.number("time_steps"), node.number("step_size")
    if not (1 <= steps <= MOST_STEPS and size > 0.0):
        raise node.refuse(f"{steps:g} steps of {size:g} s: needs 1 to {MOST_STEPS} of positive size")
    solver = node.find("solver")
    tolerance = 1e-3 if solver is None else solver.number("dtol", 1e-3)
    stepper = node.find("time_stepper")
    if stepper is None:
        return ControlPhase(int(steps), size, tolerance=tolerance)
    most = stepper.find("dtmax")
    must = most.attributes.get("lc") if most is not None else None
    if must is not None and not (must.isdecimal() and int(must) in curves):
        assert most is not None
        raise most.refuse(f"there is no load controller {must!r}")
    return ControlPhase(
        int(steps),
        size,
        stepper.number("dtmin", 0.0),
        size if most is None or must is not None else most.scalar(),
        None if must is None else int(must),
        tolerance,
    )


def step_times(phases: tuple[ControlPhase, ...], curves: Mapping[int, Curve]) -> Array:
    """Times (k,) s of FEBio's steps, as long as each converges within its optimal iterations.

    From one step to the next the automatic stepper goes a fifth of the way to its largest step, and
    shortens a step that would pass a must-point or the end.
    """
    times: list[float] = [0.0]
    for phase in phases:
        start = times[-1]
        end = start + phase.seconds
        if phase.most is None:
            times += [*(start + phase.size * np.arange(1, phase.steps)), end]
            continue
        curve = curves.get(phase.must) if phase.must is not None else None
        musts = np.zeros(0) if curve is None else curve.points[:, 0]
        size, tiny = phase.size, 1e-9 * phase.seconds
        while times[-1] < end - tiny and len(times) <= MOST_STEPS:
            now = times[-1]
            ahead = musts[musts > now + tiny]
            times.append(min(now + size, end, *ahead[:1]))
            most = phase.most if curve is None else float(curve.at(times[-1]))
            size = min(size + 0.2 * max(most - size, 0.0), 5.0 * size, max(most, phase.least))
        times[-1] = end
    return np.array(times[1:])
