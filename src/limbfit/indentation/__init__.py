"""A study's site as a mechanical problem, and what is observed in it."""

from ..laws import Parameters, flat_names, to_parameters, to_vector
from .clamps import clamped, clamping_pins
from .fibres import Direction, fibre_field
from .layers import compressions, layers_under
from .neighbourhood import Extension, neighbourhood
from .simulating import Simulation, SimulationJob, first_steps, job_fields, simulate, simulate_fields
from .sites import (
    Array,
    SiteModel,
    build_problem,
    contact_radius,
    materials,
    read_indenter,
    steps_of,
)

__all__ = [
    "Array",
    "Direction",
    "Extension",
    "Parameters",
    "Simulation",
    "SimulationJob",
    "SiteModel",
    "build_problem",
    "clamped",
    "clamping_pins",
    "compressions",
    "contact_radius",
    "fibre_field",
    "first_steps",
    "flat_names",
    "job_fields",
    "layers_under",
    "materials",
    "neighbourhood",
    "read_indenter",
    "simulate",
    "simulate_fields",
    "steps_of",
    "to_parameters",
    "to_vector",
]
