"""FEBio beside limbfit: its inputs as problems, problems as its inputs, its runs and logs as results."""

from .abaqus import write_inp
from .beginning import end_of_file
from .logs import Log, read_log
from .optimising import Range, check_fitted, in_indenter_frame, write_optimisation
from .penalty import FaceWise, mean_penalty
from .problem import step_control, to_problem
from .program import FebioRun, axial_force, find_febio, result_of_log, run_febio
from .reading.model import FebModel, read_feb
from .running import FebRun, run_feb
from .verdict import SLACK, RunVerdict, judge
from .writing import FebSettings, contact_of, differences, write_feb

__all__ = [
    "SLACK",
    "FaceWise",
    "FebModel",
    "FebRun",
    "FebSettings",
    "FebioRun",
    "Log",
    "Range",
    "RunVerdict",
    "axial_force",
    "check_fitted",
    "contact_of",
    "differences",
    "end_of_file",
    "find_febio",
    "in_indenter_frame",
    "judge",
    "mean_penalty",
    "read_feb",
    "read_log",
    "result_of_log",
    "run_feb",
    "run_febio",
    "step_control",
    "to_problem",
    "write_feb",
    "write_inp",
    "write_optimisation",
]
