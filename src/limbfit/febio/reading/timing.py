"""Time in a FEBio input: load curves, the steps of the analysis, and the automatic time stepper.

A load controller is a curve through points, or an expression of the time.

Source: FEBio User Manual 4.0, sections 3.3 and 3.14; ``PointCurve::value`` for what lies between and beyond
points.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ...arrays import Array, Indices
from .tree import XmlNode

INTERPOLATIONS = ("LINEAR", "STEP", "SMOOTH", "SMOOTH STEP")
EXTENSIONS = ("CONSTANT", "EXTRAPOLATE", "REPEAT", "REPEAT OFFSET")
MAX_EXPRESSION_LENGTH = 400  # characters of an expression
_OPERATORS: dict[type, Callable[[Array, Array], Array]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: np.power,
}
_FUNCTIONS: dict[str, Callable[[Array], Array]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan,
    "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "exp": np.exp, "ln": np.log, "sqrt": np.sqrt,
    "abs": np.abs,
}  # fmt: skip
MAX_STEPS = 20_000


@dataclass(frozen=True)
class LoadCurve:
    """A value over time: ``points (n, 2)``, time (s) and value, with what lies between and beyond them.

    ``formula`` takes their place if it is given: it returns the value at times (k,).
    """

    points: Array
    interpolate: str
    line: int
    extend: str = "CONSTANT"
    formula: Callable[[Array], Array] | None = field(default=None, compare=False)

    def at(self, times: float | Array) -> Array:
        """Return values at times (s), of their shape."""
        t = np.asarray(times, dtype=float)
        if self.formula is not None:
            return np.broadcast_to(self.formula(t), t.shape)
        x, y = self.points.T
        if len(x) == 1:
            return np.full(t.shape, y[0])
        offset = np.zeros(t.shape)
        if self.extend.startswith("REPEAT"):
            # FEBio keeps the last point itself, and begins anew after it
            span = x[-1] - x[0]
            rounds = np.where(t < x[0], np.floor((t - x[0]) / span), np.ceil((t - x[0]) / span) - 1.0)
            rounds = np.where((t >= x[0]) & (t <= x[-1]), 0.0, rounds)
            t = t - rounds * span
            offset = rounds * (y[-1] - y[0]) * (self.extend == "REPEAT OFFSET")
        inside = self._interpolate(np.clip(t, x[0], x[-1]))
        if self.extend == "EXTRAPOLATE":
            inside = inside + self._extrapolate(t)
        return np.asarray(inside + offset)

    def shift(self, seconds: float) -> LoadCurve:
        """Return the curve with its time beginning so many seconds later."""
        given = self.formula
        if given is not None:
            return replace(self, formula=lambda t: given(t + seconds))
        return replace(self, points=self.points - [seconds, 0.0])

    @property
    def corners(self) -> Array | None:
        """Times (n,) between which the value is linear; None if there are none such."""
        if self.formula is None and self.interpolate == "LINEAR" and not self.extend.startswith("REPEAT"):
            return np.asarray(self.points[:, 0])
        return None

    def _interpolate(self, t: Array) -> Array:
        x, y = self.points.T
        if self.interpolate == "LINEAR" or (self.interpolate == "SMOOTH" and len(x) == 2):
            return np.asarray(np.interp(t, x, y))
        n = np.clip(np.searchsorted(x, t), 1, len(x) - 1)  # the interval's end
        w = (t - x[n - 1]) / (x[n] - x[n - 1])
        if self.interpolate == "STEP":
            return np.where(t <= x[0], y[0], y[n])
        if self.interpolate == "SMOOTH STEP":
            return np.asarray(y[n - 1] + (y[n] - y[n - 1]) * w**3 * (10.0 - 15.0 * w + 6.0 * w**2))
        before = self._parabola(t, np.maximum(n - 2, 0))
        after = self._parabola(t, np.minimum(n - 1, len(x) - 3))
        return np.asarray(before + (after - before) * w)

    def _parabola(self, t: Array, start: Indices) -> Array:
        """Return the parabola through three points from ``start`` on, at ``t``."""
        a, b, c = (self.points[start + i, 0] for i in range(3))
        f, g, h = (self.points[start + i, 1] for i in range(3))
        return np.asarray(
            f * (c - t) * (b - t) / ((c - a) * (b - a))
            + g * (c - t) * (t - a) / ((c - b) * (b - a))
            + h * (t - b) * (t - a) / ((c - b) * (c - a))
        )

    def _extrapolate(self, t: Array) -> Array:
        """Return what the last slope adds before the first and after the last point."""
        x = self.points[:, 0]
        if self.interpolate in ("STEP", "SMOOTH STEP"):
            return np.zeros(t.shape)
        straight, tiny = self.interpolate == "LINEAR", 0.001 * (x[-1] - x[0])
        ends = np.array([x[0], x[1] if straight else x[0] + tiny, x[-2] if straight else x[-1] - tiny, x[-1]])
        a, b, c, d = self._interpolate(ends)
        low, high = (b - a) / (ends[1] - ends[0]), (d - c) / (ends[3] - ends[2])
        return np.asarray(low * np.minimum(t - x[0], 0.0) + high * np.maximum(t - x[-1], 0.0))


def read_curves(section: XmlNode | None) -> dict[int, LoadCurve]:
    """Read the load curves by number.

    Raises `ProblemError` for controllers, interpolations and extensions that limbfit does not have.
    """
    curves: dict[int, LoadCurve] = {}
    for node in section or ():
        number = node.identity()
        if number in curves:
            raise node.error(f"load controller {number} is there twice")
        kind = node.attribute("type")
        if kind == "math":
            formula = _read_formula(node.child("math"))
            curves[number] = LoadCurve(np.zeros((0, 2)), "MATH", node.line, formula=formula)
        elif kind == "loadcurve":
            curves[number] = _read_curve(node)
        else:
            raise node.error(f"load controllers of type {kind!r} are not supported, only loadcurve and math")
    return curves


def read_curve_number(value: XmlNode, curves: Mapping[int, LoadCurve]) -> int:
    """Read the number of a value's load curve, which must exist; 0 if it has none."""
    number = value.attributes.get("lc", "")
    if number and not (number.isdecimal() and int(number) in curves):
        raise value.error(f"there is no load curve {number!r}")
    return int(number or 0)


def _read_curve(node: XmlNode) -> LoadCurve:
    points = np.array([point.numbers(2) for point in node.child("points")]).reshape(-1, 2)
    if not len(points) or (np.diff(points[:, 0]) <= 0).any():
        raise node.error("a load curve needs points that go forward in time")
    chosen = {}
    for tag, known in (("interpolate", INTERPOLATIONS), ("extend", EXTENSIONS)):
        chosen[tag] = node.string(tag, known[0]).upper()
        if chosen[tag] not in known:
            raise node.child(tag).error(f"{chosen[tag]!r} is not supported", "use " + ", ".join(known))
    return LoadCurve(points, chosen["interpolate"], node.line, chosen["extend"])


def _read_formula(node: XmlNode) -> Callable[[Array], Array]:
    """Read an element's expression of the time ``t``; only arithmetic is read, nothing is run."""
    text = node.text.strip()
    wrong = f"{text[:40]!r} is no expression of t that limbfit reads"
    remedy = "use numbers, t, pi, + - * / ^ and " + ", ".join(_FUNCTIONS)
    if len(text) > MAX_EXPRESSION_LENGTH or "**" in text:
        raise node.error(wrong, remedy)
    try:
        tree = ast.parse(text.replace("^", "**"), mode="eval").body
        with np.errstate(all="ignore"):
            _evaluate(tree, np.zeros(1))
    except (SyntaxError, ValueError, TypeError, RecursionError, MemoryError):
        raise node.error(wrong, remedy) from None

    def value(t: Array) -> Array:
        with np.errstate(all="ignore"):
            found = np.asarray(_evaluate(tree, t), dtype=float)
        if not np.isfinite(found).all():
            raise node.error(f"{text[:40]!r} is not finite at a time of the analysis")
        return found

    return value


def _evaluate(tree: ast.expr, t: Array) -> Array:
    match tree:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return np.asarray(float(number))
        case ast.Name(id="t"):
            return t
        case ast.Name(id="pi"):
            return np.asarray(np.pi)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_evaluate(operand, t)
        case ast.BinOp(op=ast.Pow(), right=ast.BinOp(op=ast.Pow())):
            raise ValueError("a power of a power is read from the left by some, from the right by others")
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](_evaluate(left, t), _evaluate(right, t))
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            return _FUNCTIONS[name](_evaluate(argument, t))
    raise ValueError("not known")


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
    steps = list(root.find("Step") or ())
    for child in (child for step in steps for child in step):
        if child.tag not in ("Control", "Rigid"):
            raise child.error("only <Control> and <Rigid> may change from step to step")
    controls = [step.child("Control") for step in steps] or [root.child("Control")]
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
    must = 0 if most is None else read_curve_number(most, curves)
    return ControlPhase(
        int(steps),
        size,
        min_step_s=stepper.number("dtmin", 0.0),
        max_step_s=size if most is None or must else most.scalar(),
        must_curve=must or None,
        tolerance=tolerance,
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
