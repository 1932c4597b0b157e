"""The simulation in time: a generator of accepted steps, and the result made of them.

A step that does not converge is cut and tried again; what was reached is a result with its reason.  Between
two steps a simulation can be kept as JSON values and arrays, from which a later call goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import ProblemError
from ..observables import compute_element_fields
from ..problem import Problem
from ..result import (
    Result,
    SimulationWarning,
    State,
    Step,
    find_inexact_sensitivities,
    find_inexact_steps,
    find_inverted_elements,
    find_penetration,
    find_slip,
)
from ..system import System
from .control import StepControl
from .simulation import SteppedRun

# What is kept of steps; of a run as it is; and of its parts, as dataclasses.
_COLUMNS = tuple(one.name for one in fields(Step) if one.name != "state")
_PLAIN = ("stiffness", "damping", "floor", "pushing", "unbalanced", "unsettled")
_PARTS = ("memory", "slope", "pace", "takeover")


def iterate(
    problem: Problem, steps: StepControl = StepControl(), sensitivities: bool = False
) -> Iterator[Step]:
    """Accepted steps of a simulation, one by one; ends early where no step converges.

    Raises `ProblemError` before anything is solved, where the problem is impossible as stated.
    """
    yield from SteppedRun(problem, steps, sensitivities).run()


def solve(
    problem: Problem,
    steps: StepControl = StepControl(),
    sensitivities: bool = False,
    warm_start: Result | None = None,
    on_step: Callable[[Step], None] | None = None,
    store: str = "peak",
    system: System | None = None,
    checkpoints: Checkpoints | None = None,
    begin: Snapshot | None = None,
) -> Result:
    """Simulate an indentation.

    Raises `ProblemError` before anything is solved, where the problem is impossible as stated. A simulation
    that cannot go on is no error: the result says ``completed = False`` and why.

    Parameters
    ----------
    sensitivities : also the derivative of the force with respect to every material parameter.
    warm_start : an earlier result on the same mesh whose states (``store="all"``) are the first guesses.
    on_step : called with every accepted step.
    store : which states to keep: ``peak`` (the deepest of the loading), ``all`` (its stresses only) or
        ``none``.
    system : the discretisation of the same mesh, supports and contact faces, where it is known.
    checkpoints : when to keep what a later call can ``begin`` with; of problems without an indenter and with
        stated times.
    begin : of an earlier call with the same problem, steps, sensitivities and checkpoints, whose result this
        one then has: with one thread, to the last bit.
    """
    if (checkpoints or begin) and (problem.indenter is not None or steps.times is None):
        raise ProblemError("only a simulation without an indenter and with stated times can be resumed")
    started = time.perf_counter()
    run = SteppedRun(problem, steps, sensitivities, warm_start, system)
    nothing = np.zeros(run.laws.count) if sensitivities else None
    rest = Step(
        0.0, problem.history.displacement_at(0.0), 0.0, 0.0, 0.0, 0, nothing, np.zeros_like(run.rest),
        run.rest, nothing if problem.history.forced else None, run.states[0],
    )  # fmt: skip
    rows = [rest]
    if begin is not None:
        rows = _resume_run(run, begin)
        started -= begin["seconds"]
    kept: list[State] = []
    deepest_state: State | None = None
    loading_s = problem.history.loading_s * (1.0 + 1e-9)
    for step in run.run():
        rows[0] = run.onset or rows[0]
        rows.append(replace(step, state=run.states[0]))
        # What creeps deeper in a hold has relaxed: people mean the end of loading.
        deepest = step.time <= loading_s and (
            deepest_state is None or step.displacement >= deepest_state.displacement
        )
        if deepest:
            deepest_state = step.state
            kept = [replace(state, memory=None) for state in kept] if store == "all" else []
        if store == "all" or (store == "peak" and deepest):
            kept.append(step.state if deepest else replace(step.state, memory=None))
        if on_step is not None:
            on_step(step)
        if checkpoints is not None and np.isclose(step.time, checkpoints.times, rtol=1e-9, atol=0.0).any():
            checkpoints.keep(_take_snapshot(run, rows, time.perf_counter() - started))
            for factor in {id(one): one for one in (run.factor, run.slopes)}.values():
                factor.reset()  # as that of a run that begins here does
    return _build_result(run, rows, kept, deepest_state, time.perf_counter() - started)


def _take_snapshot(run: SteppedRun, rows: list[Step], seconds: float) -> Snapshot:
    """All that the further steps of a run, and its result, depend on."""
    return Snapshot.from_values(
        states=[replace(state, memory=None, grips=()) for state in run.states],
        driven=[body.motion.values for body in run.problem.bodies],
        grips=run.grips,
        count=len(run.states),
        **_collect_columns(rows),
        **{name: copy(getattr(run, name)) for name in (*_PLAIN, *_PARTS)},
        counts=dict(run.counts),
        inexact=run.slopes.counts["inexact"],
        seconds=seconds,
    )


def _resume_run(run: SteppedRun, begin: Snapshot) -> list[Step]:
    """Put a run where another was; the steps up to there, without their states."""
    first = run.states[0]
    values = zip(run.problem.bodies, begin["driven"], strict=True)
    bodies = [replace(one, motion=replace(one.motion, values=np.array(driven))) for one, driven in values]
    run.problem = replace(run.problem, bodies=tuple(bodies))
    for name in _PLAIN:
        setattr(run, name, copy(begin[name]))
    for name in _PARTS:
        if getattr(run, name) is not None:
            setattr(run, name, begin.restore(name, getattr(run, name)))
    run.grips = tuple(grip and begin.restore(f"grips.{i}", grip) for i, grip in enumerate(run.grips))
    run.states = [replace(begin.restore(f"states.{i}", first), grips=()) for i in range(begin["count"])]
    run.counts.update(begin["counts"])
    run.slopes.counts["inexact"] = begin["inexact"]
    known = {name: begin[name] for name in _COLUMNS if begin[name] is not None}
    nothing: dict[str, Any] = dict.fromkeys(_COLUMNS)
    rows = [{name: column[i] for name, column in known.items()} for i in range(len(known["time"]))]
    return [Step(state=first, **nothing | row) for row in rows]


@dataclass(frozen=True)
class FirstStep:
    """How a simulation began.

    ``place``: how far beyond where it would touch tissue at rest the indenter began, mm along its axis.
    ``times (2,)`` s: the start and the end of the first step, and ``coordinates (2, b, 6)`` the rigid bodies'
    then, mm and rad.
    """

    place: float
    times: Array
    coordinates: Array


def solve_until_onset(problem: Problem, steps: StepControl = StepControl()) -> FirstStep:
    """Solve a problem until its indenter, which may wait for tissue that moves before, begins. Raises
    `ProblemError` where the problem is impossible as stated, and where that is not reached.
    """
    run = SteppedRun(problem, steps, False)
    start, first = run.rest, None
    for step in run.run():
        if first is None:
            start, first = run.rest if run.onset is None else run.onset.coordinates, step
        if not run.touch.waits:
            times = np.array([0.0, first.time])
            return FirstStep(run.touch.offset, times, np.array([start, first.coordinates]))
    what = f"the tissue that moves before the indenter touches it found no equilibrium: {run.reason}"
    raise ProblemError(what, remedy="take smaller steps (solver.load_steps), or less force")


def _collect_columns(rows: Sequence[Step]) -> dict[str, Any]:
    """The numbers (n, ...) of steps by their names in `Step`; None where the steps have none."""
    columns = {name: [getattr(row, name) for row in rows] for name in _COLUMNS}
    return {name: None if values[0] is None else np.array(values) for name, values in columns.items()}


def _build_result(
    run: SteppedRun, rows: list[Step], kept: list[State], deepest: State | None, seconds: float
) -> Result:
    columns = _collect_columns(rows)
    doubts = _collect_warnings(run, deepest, columns)
    del columns["newton_iterations"]
    return Result(
        problem=run.problem,
        times=columns.pop("time"),
        parameter_names=run.problem.parameter_names,
        states=tuple(kept),
        completed=not run.reason,
        reason=run.reason,
        doubts=doubts,
        statistics=_collect_statistics(run, seconds, int((columns["penetration"] > run.deepest).sum())),
        system=run.system,
        **columns,
    )


def _collect_warnings(
    run: SteppedRun, deepest: State | None, columns: Mapping[str, Any]
) -> tuple[SimulationWarning, ...]:
    """The warnings about the steps of a run, of which ``deepest`` is the one farthest in."""
    times, displacement, force = (columns[name] for name in ("time", "displacement", "force"))
    folds: tuple[SimulationWarning, ...] = ()
    if deepest is not None:
        volumes = run.system.weights.sum(axis=1)
        folds = find_inverted_elements(
            run.problem.mesh, deepest.u,
            lambda: compute_element_fields(run.system, run.laws, deepest).energy * volumes,
            deepest.displacement, displacement,
        )  # fmt: skip
    return (
        *folds,
        *(() if run.problem.history.forced else find_slip(times, displacement, force)),
        *find_penetration(displacement, columns["penetration"], run.deepest, run.stiffness),
        *find_inexact_steps("unbalanced", displacement, run.unbalanced, run.control.tolerance),
        *find_inexact_steps("unsettled", displacement, run.unsettled, run.control.tolerance),
        *find_inexact_sensitivities(displacement, run.slopes.counts["inexact"]),
    )


def _collect_statistics(run: SteppedRun, seconds: float, sunk_steps: int) -> dict[str, Any]:
    used = [run.factor, *([run.slopes] if run.slopes is not run.factor else [])]
    parts = dict(run.seconds)
    for factor in used:
        for name, value in factor.seconds.items():
            parts[name] = parts.get(name, 0.0) + value
    return {
        "steps": run.counts["steps"],
        "cuts": run.counts["cuts"],
        "sunk_steps": sunk_steps,
        "unbalanced_steps": len(run.unbalanced),
        "unsettled_steps": len(run.unsettled),
        "penalty_per_mm": run.stiffness,
        "newton_iterations": run.counts["newton_iterations"],
        "factorisations": sum(factor.counts["factorisations"] for factor in used),
        "solves": sum(factor.counts["half_solves"] for factor in used) // 2,
        "double_precision": any(factor.counts["double_precision"] for factor in used),
        "linear_solver": run.factor.solver.name,
        "element": run.system.element.name,
        "unknowns": run.system.unknowns,
        "seconds": {**parts, "total": seconds},
    }


Kind = TypeVar("Kind")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What is known after a step: ``facts`` that JSON can hold, and ``arrays``, both by name."""

    facts: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    @classmethod
    def from_values(cls, **values: Any) -> Snapshot:
        """Of dataclasses, sequences, arrays and plain values; what is in something is named after a dot."""
        facts: dict[str, Any] = {}
        arrays: dict[str, NDArray[Any]] = {}
        for name, value in values.items():
            _flatten(name, value, facts, arrays)
        return cls(facts, arrays)

    def restore(self, name: str, pattern: Kind) -> Kind:
        """The value of that name, a dataclass of the kind of ``pattern``, whose other fields it takes."""
        known = {}
        for one in fields(pattern):  # type: ignore[arg-type]
            inner, old = f"{name}.{one.name}", getattr(pattern, one.name)
            if inner in self.arrays or inner in self.facts:
                known[one.name] = self[inner]
            elif is_dataclass(old):
                known[one.name] = self.restore(inner, old)
        return replace(pattern, **known)  # type: ignore[type-var]

    def __getitem__(self, name: str) -> Any:
        """An array, or a plain value."""
        return self.arrays[name] if name in self.arrays else self.facts[name]


@dataclass(frozen=True)
class Checkpoints:
    """When a simulation is kept: after the steps at ``times`` (s) ``keep`` is given a `Snapshot`."""

    times: Sequence[float]
    keep: Callable[[Snapshot], None]


def _flatten(name: str, value: Any, facts: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    if isinstance(value, np.ndarray):
        arrays[name] = value
    elif is_dataclass(value):
        for one in fields(value):
            _flatten(f"{name}.{one.name}", getattr(value, one.name), facts, arrays)
    elif isinstance(value, (list, tuple)) and any(is_dataclass(one) for one in value):
        for i, one in enumerate(value):
            _flatten(f"{name}.{i}", one, facts, arrays)
    else:
        facts[name] = value
