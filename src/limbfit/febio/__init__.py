"""FEBio beside limbfit: its inputs read as problems, problems written as its inputs, its runs and logs."""

from .abaqus import write_inp
from .optimisation import ParameterRange, check_optimisable, turn_to_indenter_frame, write_optimisation
from .penalty import FacePenalties, compute_mean_penalty
from .preparation import compute_end_time
from .problem import build_step_control, to_problem
from .program import (
    TIME_TOLERANCE,
    FebioLog,
    FebioRun,
    RunVerdict,
    build_result,
    compute_axial_force,
    find_febio,
    judge_run,
    read_log,
    run_febio,
)
from .reading.model import FebModel, read_feb
from .running import FebRun, run_feb
from .writing import FebSettings, build_contact, describe_differences, write_feb

__all__ = [
    "TIME_TOLERANCE",
    "FacePenalties",
    "FebModel",
    "FebRun",
    "FebSettings",
    "FebioLog",
    "FebioRun",
    "ParameterRange",
    "RunVerdict",
    "build_contact",
    "build_result",
    "build_step_control",
    "check_optimisable",
    "compute_axial_force",
    "compute_end_time",
    "compute_mean_penalty",
    "describe_differences",
    "find_febio",
    "judge_run",
    "read_feb",
    "read_log",
    "run_feb",
    "run_febio",
    "to_problem",
    "turn_to_indenter_frame",
    "write_feb",
    "write_inp",
    "write_optimisation",
]
