"""One's own problems from a script or a notebook: solved, drawn and fitted in a few lines.

A `Solution` shows itself: its curve as a plot, its steps as grids of pyvista. A `Fit` has tissue parameters
from measured curves, with what the curves leave open.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import cast

import numpy as np
import pyvista as pv
from matplotlib import pyplot
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from .arrays import Array
from .errors import ProblemError
from .fe import Problem, Result, State, Step, StepControl, System, list_texts
from .fe import solve as simulate
from .fe.checking import check
from .fe.kernel.assembly import is_compiled
from .fields import rest, state_fields
from .identify.fit.calibration import CalibrationSettings
from .identify.fit.calibration import calibrate as search
from .identify.fit.objective import MeasuredCurve, SiteResponse
from .identify.fit.parameters import Unknowns, group_separately
from .identify.fit.prediction import compute_errors_percent
from .identify.uncertainty.noise import estimate_curve_noise
from .identify.uncertainty.uncertainty import Uncertainty, estimate_uncertainty

__all__ = ["Fit", "Solution", "calibrate", "solve"]

Curve = tuple[ArrayLike, ArrayLike]  # times (n,) s; force (n,) N, or displacement, mm, under a force
DEFAULT_BOUND_FACTOR = 100.0  # of default bounds, over the start
CURVE = "give (times, values), both (n,), times growing"  # what a curve is
COMPILING = "limbfit compiles its kernels: half a minute, once on this machine"


@dataclass(frozen=True, repr=False)
class Solution(Result):
    """A `Result` that shows itself; ``frames`` are rest and every step, stresses included."""

    frames: tuple[State, ...] = ()

    def __repr__(self) -> str:
        ended = "complete" if self.completed else f"incomplete: {self.reason}"
        steps, end = len(self.times) - 1, self.times[-1]
        return f"<Solution: {steps} steps to {end:g} s, {self.peak_force:.3g} N at most, {ended}>"

    def to_pyvista(self, step: int | None = None) -> pv.UnstructuredGrid:
        """The mesh at rest with the fields of a step; ``grid.warp_by_vector("displacement_mm")`` moves it.
        The grid has arrays of its own: what is changed in it changes neither mesh nor solution.

        ``step``: 0 is rest, -1 the last; by default the deepest of the loading. Fields and units are those of
        ``docs/fields.md``: stress, stretch, contact pressure.
        """
        if step is None:
            frame = self.deepest
        else:
            frame = self.frames[step] if -len(self.frames) <= step < len(self.frames) else None
        if frame is None:
            has = f"there are {len(self.frames)}" if self.frames else "it was solved without frames"
            raise ProblemError(f"no step {step}: {has}", remedy="count from 0, which is rest")
        mesh = self.problem.mesh
        grid = pv.UnstructuredGrid({mesh.kind.vtk: mesh.cells}, mesh.points.copy())
        system = self.system or System(self.problem)
        point_data, cell_data = state_fields(system, self.problem, frame)
        for data, arrays in ((grid.point_data, point_data), (grid.cell_data, cell_data)):
            for name, values in arrays.items():
                data[name] = np.array(values)
        grid.cell_data["region"] = mesh.regions.copy()
        grid.field_data["region_names"] = list(mesh.region_names)  # for `read_vtu`, where it is saved
        return grid

    def plot(self, axes: Axes | None = None, label: str = "") -> Axes:
        """Draw force (N) against displacement (mm), on new axes where none are given."""
        axes = axes or new_axes()
        times = np.linspace(0.0, self.times[-1], 400)
        axes.plot(self.displacement_at(times), self.force_at(times), label=label or "simulated")
        axes.plot(self.displacement, self.force, ".", color=axes.lines[-1].get_color())
        axes.set(xlabel="displacement, mm", ylabel="force, N")
        return axes


def solve(
    problem: Problem,
    steps: StepControl | None = None,
    *,
    sensitivities: bool = False,
    frames: bool = True,
    listener: Callable[[Step], None] | None = None,
) -> Solution:
    """Simulate an indentation.

    Raises `ProblemError`, before anything is solved, where the problem is impossible as stated. A simulation
    that cannot go on is no error: the solution says ``completed = False`` and why.

    Parameters
    ----------
    steps : how it steps, and on how many threads; the defaults need no change.
    sensitivities : also the derivative of the force with respect to every material parameter.
    frames : keep every step with its stresses, for `Solution.to_pyvista`; without, the deepest alone.
    listener : called with every step.
    """
    announce_compilation()
    states: list[State] = []

    def keep(step: Step) -> None:
        if frames:
            states.append(step.state)
        if listener is not None:
            listener(step)

    result = simulate(problem, steps or StepControl(), sensitivities=sensitivities, on_step=keep)
    if frames:
        states.insert(0, rest(result.system, problem))
    return Solution(**{f.name: getattr(result, f.name) for f in fields(Result)}, frames=tuple(states))


def new_axes() -> Axes:
    """Axes on a new figure of pyplot: a notebook shows it, ``pyplot.show()`` does so in a script."""
    _, axes = pyplot.subplots(figsize=(5, 4), layout="constrained")
    return axes


def announce_compilation() -> None:
    """Say so on standard error where the kernels are not compiled yet: a first run seems to hang."""
    if not is_compiled():
        sys.stderr.write(COMPILING + "\n")


@dataclass(frozen=True)
class Fit:
    """Fitted parameters, by ``region.parameter``; mm, N, s, MPa.

    ``problems`` have the fitted materials, and were simulated in ``steps``; ``error_percent`` is the mean
    difference of each curve over its largest force. ``converged`` and ``reason`` say how the search ended.
    """

    parameters: Mapping[str, float]
    error_percent: tuple[float, ...]
    converged: bool
    reason: str
    simulations: int
    problems: tuple[Problem, ...]
    curves: tuple[tuple[Array, Array], ...]
    responses: tuple[SiteResponse, ...]
    unknowns: Unknowns
    steps: tuple[StepControl, ...]

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """What the curves determine: 95 % intervals, verdicts, correlations.

        Noise is estimated from the scatter of neighbouring differences, smooth misfit from their size.
        """
        measured = _to_measured(self.curves)
        best = np.array(list(self.parameters.values()))
        noise = estimate_curve_noise(self.responses, measured)
        return estimate_uncertainty(best, self.responses, measured, self.unknowns, noise)

    def table(self) -> str:
        """Parameters, 95 % intervals and verdicts as text."""
        known = self.uncertainty
        columns = known.names, known.parameters, known.intervals_95, known.verdicts, known.at_bound
        rows = [("parameter", "value", "95 % interval", "")]
        for name, value, (low, high), verdict, stuck in zip(*columns, strict=True):
            said = verdict + ("; at its bound" if stuck else "")
            rows.append((name, f"{value:.4g}", f"{low:.4g} to {high:.4g}", said))
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths)).rstrip() for row in rows)

    def solve(self, number: int = 0) -> Solution:
        """Simulate a problem with what was found, in the steps and with the contact penalty of the fit."""
        return solve(self.problems[number], self.steps[number])

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the curves as measured (dots) and as fitted (lines) over time."""
        axes = axes or new_axes()
        for number, ((times, force), response) in enumerate(zip(self.curves, self.responses, strict=True)):
            axes.plot(times, force, ".", color=f"C{number}", label=f"curve {number + 1}")
            axes.plot(times, response.force_N, color=f"C{number}")
        kinds = ("displacement, mm" if one.history.forced else "force, N" for one in self.problems)
        axes.set(xlabel="time, s", ylabel=" or ".join(dict.fromkeys(kinds)))
        axes.legend()
        return axes


def calibrate(
    problems: Problem | Sequence[Problem],
    curves: Curve | Sequence[Curve],
    start: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]] | None = None,
    *,
    steps: StepControl | None = None,
    listener: Callable[[str], None] | None = None,
) -> Fit:
    """Fit parameters of tissues to measured forces or creep, with exact derivatives of the solver.

    Raises `ProblemError` for parameters that the problems do not have, and curves that do not fit them, or at
    none of whose times the first simulation has a force or a displacement, and `CalibrationError` where no
    simulation completes at the start.

    Parameters
    ----------
    problems, curves : for each problem the times (n,) s and forces (n,) N that were measured, or the
        displacements (n,) mm of an indenter that a force drives; all curves count alike, whatever their size
        or number of points.
    start : where the search begins, by ``region.parameter`` as in ``problem.parameter_names``
        (``"skin.c"``, MPa); all other parameters stay as the problems have them.
    bounds : smallest and largest value of some of them; by default a hundredth of the start and a hundred
        times it.
    steps : how simulations step; the contact penalty is that of the first one throughout.
    listener : called with one line for each simulation of all problems.
    """
    cases = (problems,) if isinstance(problems, Problem) else tuple(problems)
    given = cast("Sequence[Curve]", (curves,) if isinstance(problems, Problem) else curves)
    pairs = _pair_curves(given, cases)
    unknowns = _build_unknowns(cases, start, bounds or {})
    announce_compilation()
    control = steps or StepControl()
    systems = [System(case, control.threads) for case in cases]
    model = _Model(cases, pairs, unknowns.names, [control] * len(cases), systems, listener)
    measured = _to_measured(pairs)
    names = unknowns.names
    result = search(model, measured, unknowns, CalibrationSettings(), stages=[group_separately(names)])
    best = result.parameters
    return Fit(
        parameters=dict(zip(names, best.tolist(), strict=True)),
        error_percent=compute_errors_percent(result.responses, measured),
        converged=result.stages[-1].converged,
        reason=result.stages[-1].reason,
        simulations=result.evaluations * len(cases),
        problems=tuple(with_parameters(case, dict(zip(names, best, strict=True))) for case in cases),
        curves=pairs,
        responses=tuple(result.responses),
        unknowns=unknowns,
        steps=tuple(model.steps),
    )


def with_parameters(problem: Problem, values: Mapping[str, float]) -> Problem:
    """A copy of the problem with new values of parameters, by ``region.parameter``."""
    materials = dict(problem.materials)
    for name, value in values.items():
        region, parameter = name.rsplit(".", 1)
        if region in materials and parameter in materials[region].parameter_names:
            materials[region] = materials[region].with_parameters({parameter: float(value)})
    return problem.with_materials(materials)


@dataclass
class _Model:
    """Responses and derivatives of all problems at the free parameters (p,)."""

    problems: tuple[Problem, ...]
    curves: tuple[tuple[Array, Array], ...]
    names: tuple[str, ...]
    steps: list[StepControl]  # of each problem
    systems: list[System]
    listener: Callable[[str], None] | None
    calls: int = 0

    def __call__(self, parameters: Array) -> list[SiteResponse]:
        self.calls += 1
        values = dict(zip(self.names, parameters, strict=True))
        answers = [self._simulate(k, values) for k in range(len(self.problems))]
        if self.listener is not None:
            values_text = ", ".join(f"{name} {value:.4g}" for name, value in values.items())
            self.listener(f"simulation {self.calls}: {values_text}")
        return answers

    def _simulate(self, number: int, values: Mapping[str, float]) -> SiteResponse:
        problem, (times, _) = with_parameters(self.problems[number], values), self.curves[number]
        result = simulate(problem, self.steps[number], sensitivities=True, system=self.systems[number])
        if not self.steps[number].hold_penalty and result.completed:
            penalty = result.statistics["penalty_per_mm"]
            self.steps[number] = replace(self.steps[number], penalty=penalty, hold_penalty=True)
        names = [f"{region}.{parameter}" for region, parameter in result.parameter_names]
        response, full = result.response_at(times), result.response_sensitivity_at(times)
        if self.calls == 1 and result.completed and not response.any():
            what = f"curve {number + 1}: the simulation does not answer at any of its times"
            raise ProblemError(what, remedy="displacement and force are positive into the tissue")
        absent = np.zeros(len(times))
        columns = [full[:, names.index(name)] if name in names else absent for name in self.names]
        answer = response, np.stack(columns, axis=1), result.completed, result.reason
        kinds = list_texts(result.doubts, "slipped", "folded")
        return SiteResponse(*answer, f"curve {number + 1}", result.warnings, *kinds)


def _pair_curves(curves: Sequence[Curve], problems: Sequence[Problem]) -> tuple[tuple[Array, Array], ...]:
    if len(curves) != len(problems):
        raise ProblemError(f"{len(curves)} curves for {len(problems)} problems", remedy="give one for each")
    pairs = []
    for number, (curve, problem) in enumerate(zip(curves, problems), start=1):
        try:
            times, force = (np.array(values, dtype=float) for values in curve)
        except (TypeError, ValueError):  # a table, a dictionary, or the one curve of several problems
            raise ProblemError(f"curve {number} is no pair of arrays", remedy=CURVE) from None
        end = float(problem.history.times[-1])
        if times.ndim != 1 or times.shape != force.shape or not (len(times) and (np.diff(times) > 0).all()):
            raise ProblemError(f"curve {number} has times {times.shape}, values {force.shape}", remedy=CURVE)
        if not np.isfinite(force).all():
            what = f"curve {number} has {np.count_nonzero(~np.isfinite(force))} values that are not finite"
            raise ProblemError(what, remedy="leave these points out")
        if times[0] < 0.0 or times[-1] > end * (1.0 + 1e-9):
            what = f"curve {number} lasts from {times[0]:g} to {times[-1]:g} s, the indentation to {end:g} s"
            raise ProblemError(what, remedy="count time from touch-down, and cut what lies outside")
        pairs.append((times, force))
    return tuple(pairs)


def _build_unknowns(
    problems: Sequence[Problem], start: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> Unknowns:
    for problem in problems:
        check(problem)
    names = {f"{region}.{parameter}" for problem in problems for region, parameter in problem.parameter_names}
    for name in (*start, *bounds):
        if name not in names:
            raise ProblemError(f"no parameter {name!r}", remedy=f"there are {', '.join(sorted(names))}")
    if not start or not bounds.keys() <= start.keys():
        raise ProblemError("a parameter to be fitted has no start", remedy="name each in start")
    values = np.array([float(value) for value in start.values()])
    usual = zip(start, values / DEFAULT_BOUND_FACTOR, values * DEFAULT_BOUND_FACTOR)
    low, high = np.array([bounds.get(name, ends) for name, *ends in usual], dtype=float).T
    return Unknowns(tuple(start), values, low, high)


def _to_measured(curves: Sequence[tuple[Array, Array]]) -> list[MeasuredCurve]:
    return [MeasuredCurve(f"curve {k + 1}", force) for k, (_, force) in enumerate(curves)]
