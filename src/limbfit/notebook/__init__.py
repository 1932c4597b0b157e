"""One's own problems from a script or a notebook: solved, drawn and fitted in a few lines."""

from .fitting import Fit, calibrate
from .solution import Solution, solve

__all__ = ["Fit", "Solution", "calibrate", "solve"]
