"""How a simulation steps, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..problem import History, ProblemError
from .newton import NewtonControl
from .schedule import grade_steps, insert_turning_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepControl:
    """How a simulation steps; the defaults need no change.

    Parameters
    ----------
    load_steps, unload_steps : steps of an indentation on the way in and on the way out, before any is cut.
    times : (k,) s, instead of the two numbers: exactly these steps (rest at 0 left out).
    stress : how the elastic stress runs in a step: ``quadratic``, through the step before it, or ``linear``,
        as FEBio has it (second order in the step instead of third).
    tolerance : residual over reactions at equilibrium.
    max_iterations, most_iterations : of Newton's method in a step, and in all.
    max_cuts : how often a step may be cut, to 0.3 of it each time.
    penetration : largest penetration over the largest displacement; the penalty is raised beyond it.
    penalty : contact stiffness over the mean instantaneous shear modulus, 1/mm; None: 2000 / width.
    hold_penalty : it is never raised, so that forces of neighbouring parameters do not jump; a deeper
        penetration is a doubt of the result.
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
        for name in ("tolerance", "penetration"):
            if not getattr(self, name) > 0.0:
                raise ProblemError(f"{name} = {getattr(self, name)} is not positive")
        if self.stress not in ("quadratic", "linear"):
            raise ProblemError(f"unknown stress {self.stress!r}", remedy="use 'quadratic' or 'linear'")
        times = np.asarray(self.times if self.times is not None else (1.0,), dtype=float)
        if not (len(times) and np.isfinite(times).all() and (np.diff([0.0, *times]) > 0.0).all()):
            raise ProblemError("the times of the steps do not grow from 0")

    @property
    def newton(self) -> NewtonControl:
        return NewtonControl(tolerance=self.tolerance, max_iterations=self.max_iterations)


def schedule_steps(history: History, control: StepControl, turns: Sequence[float] | Array = ()) -> Array:
    """Times (k,) of the steps, s, before any is cut: those stated, or as `grade_steps` places them.

    The ``turns (k,)`` of further bodies are among those placed.
    """
    if control.times is None:
        return insert_turning_points(
            grade_steps(history, control.load_steps, control.unload_steps), np.asarray(turns, dtype=float)
        )
    if control.times[-1] > history.times[-1] * (1.0 + 1e-9):
        raise ProblemError(
            f"a step at {control.times[-1]} s lies beyond the history's end at {history.times[-1]} s"
        )
    return np.asarray(control.times, dtype=float)
