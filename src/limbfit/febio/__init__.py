"""FEBio 4 beside limbfit: its inputs as problems, its logs as arrays."""

from .logs import Log, read_log
from .model import FebModel, Motion, Part, read_feb
from .problem import to_problem

__all__ = ["FebModel", "Log", "Motion", "Part", "read_feb", "read_log", "to_problem"]
