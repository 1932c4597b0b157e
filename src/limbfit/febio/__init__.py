"""FEBio beside limbfit: its inputs as problems, problems as its inputs, its logs as arrays."""

from .logs import Log, read_log
from .model import FebModel, read_feb
from .problem import step_control, to_problem
from .running import FebRun, run_feb

__all__ = [
    "FebModel",
    "FebRun",
    "Log",
    "read_feb",
    "read_log",
    "run_feb",
    "step_control",
    "to_problem",
]
