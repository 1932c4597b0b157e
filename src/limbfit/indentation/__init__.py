"""A study's site as a mechanical problem, and what is observed in it."""

from ..laws import Parameters, flat_names, to_parameters, to_vector
from .clamps import clamped, clamping_pins
from .fibres import Direction, fibre_field
from .neighbourhood import Extension, neighbourhood
from .observing import (
    OFF_SKIN_MM,
    is_under,
    layers_under,
    observed,
    points_around,
    skin_beside,
    waves_under,
)
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
from .skin_points import nearest_points, skin_points
from .waves import WavePlace, as_vector

__all__ = [
    "OFF_SKIN_MM",
    "Array",
    "Direction",
    "Extension",
    "Parameters",
    "Simulation",
    "SimulationJob",
    "SiteModel",
    "WavePlace",
    "as_vector",
    "build_problem",
    "clamped",
    "clamping_pins",
    "contact_radius",
    "fibre_field",
    "first_steps",
    "flat_names",
    "is_under",
    "job_fields",
    "layers_under",
    "materials",
    "nearest_points",
    "neighbourhood",
    "observed",
    "points_around",
    "read_indenter",
    "simulate",
    "simulate_fields",
    "skin_beside",
    "skin_points",
    "steps_of",
    "to_parameters",
    "to_vector",
    "waves_under",
]
