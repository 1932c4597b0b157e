"""Time in a FEBio input: steps and the automatic time stepper.

Source: FEBio User Manual 4.0, section 3.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from .curves import LoadCurve
from .tree import XmlNode

MAX_STEPS = 20_000


@dataclass(frozen=True)
class ControlPhase:
    """A step of the analysis: ``steps`` of ``size`` s.

    With ``max_step_s``, or ``must_curve``, the number of the curve that gives it, FEBio adapts the steps, not
    below ``min_step_s``, and meets the points of that curve. ``tolerance`` is that of the displacements.
    """

    steps: int
    size: float
    min_step_s: float = 0.0
    max_step_s: float | None = None
    must_curve: int | None = None
    tolerance: float = 1e-3

    @property
    def seconds(self) -> float:
        return self.steps * self.size


def read_phases(root: XmlNode, curves: Mapping[int, LoadCurve]) -> tuple[ControlPhase, ...]:
    """Read the analysis steps, in order."""
    steps = root.find("Step")
    if steps is not None and len(steps):
        for step in steps:
            for child in step:
                if child.tag not in ("Control", "Rigid"):
                    raise child.error("only <Control> and <Rigid> may change from step to step")
        controls = [step.child("Control") for step in steps]
    else:
        controls = [root.child("Control")]
    phases = tuple(_read_phase(control, curves) for control in controls)
    if sum(phase.steps for phase in phases) > MAX_STEPS:
        raise controls[0].error(f"has more than {MAX_STEPS} steps")
    return phases


def _read_phase(node: XmlNode, curves: Mapping[int, LoadCurve]) -> ControlPhase:
    analysis = node.string("analysis", "STATIC").upper()
    if analysis not in ("STATIC", "STEADY-STATE"):
        raise node.child("analysis").error(f"an analysis of type {analysis} is not supported, only STATIC")
    steps, size = node.number("time_steps"), node.number("step_size")
    if not (1 <= steps <= MAX_STEPS and size > 0.0):
        raise node.error(f"{steps:g} steps of {size:g} s: needs 1 to {MAX_STEPS} of positive size")
    solver = node.find("solver")
    tolerance = 1e-3 if solver is None else solver.number("dtol", 1e-3)
    stepper = node.find("time_stepper")
    if stepper is None:
        return ControlPhase(int(steps), size, tolerance=tolerance)
    most = stepper.find("dtmax")
    must = most.attributes.get("lc") if most is not None else None
    if must is not None and not (must.isdecimal() and int(must) in curves):
        assert most is not None
        raise most.error(f"there is no load controller {must!r}")
    return ControlPhase(
        int(steps),
        size,
        stepper.number("dtmin", 0.0),
        size if most is None or must is not None else most.scalar(),
        None if must is None else int(must),
        tolerance,
    )


def compute_step_times(phases: tuple[ControlPhase, ...], curves: Mapping[int, LoadCurve]) -> Array:
    """Return the times (k,) s of FEBio's steps, if each converges within its optimal iterations.

    From one step to the next the automatic stepper goes a fifth of the way to its largest step, and shortens
    a step that would pass a must-point or the end.
    """
    times: list[float] = [0.0]
    for phase in phases:
        start = times[-1]
        end = start + phase.seconds
        if phase.max_step_s is None:
            times += [*(start + phase.size * np.arange(1, phase.steps)), end]
            continue
        curve = curves.get(phase.must_curve) if phase.must_curve is not None else None
        musts = np.zeros(0) if curve is None else curve.points[:, 0]
        size, tiny = phase.size, 1e-9 * phase.seconds
        while times[-1] < end - tiny and len(times) <= MAX_STEPS:
            now = times[-1]
            ahead = musts[musts > now + tiny]
            times.append(min(now + size, end, *ahead[:1]))
            most = phase.max_step_s if curve is None else float(curve.at(times[-1]))
            size = min(size + 0.2 * max(most - size, 0.0), 5.0 * size, max(most, phase.min_step_s))
        times[-1] = end
    return np.array(times[1:])
