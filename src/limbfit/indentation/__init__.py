"""A study's site as a mechanical problem, and what is observed in it."""

from .neighbourhood import Extension, neighbourhood
from .simulating import Simulation, SimulationJob, first_steps, job_fields, simulate, simulate_fields
from .sites import (
    KPA,
    Array,
    Parameters,
    SiteModel,
    build_problem,
    flat_names,
    materials,
    read_indenter,
    steps_of,
    to_parameters,
    to_vector,
)

__all__ = [
    "KPA",
    "Array",
    "Extension",
    "Parameters",
    "Simulation",
    "SimulationJob",
    "SiteModel",
    "build_problem",
    "first_steps",
    "flat_names",
    "job_fields",
    "materials",
    "neighbourhood",
    "read_indenter",
    "simulate",
    "simulate_fields",
    "steps_of",
    "to_parameters",
    "to_vector",
]
