"""A study's site as a mechanical problem, and what is observed in it."""

from typing import Any

from ..laws import Parameters, list_flat_names, to_parameters, to_vector
from ..renamed import find_renamed
from .neighbourhood import Extension, cut_neighbourhood
from .observing import (
    OFF_SKIN_MM,
    choose_points_around,
    find_layers_under,
    find_nearby_skin_points,
    find_nearest_points,
    find_skin_points,
    is_under,
    observe_result,
    place_waves_under,
)
from .simulating import (
    Simulation,
    SimulationJob,
    build_first_steps,
    simulate,
    simulate_fields,
    store_job_fields,
)
from .sites import (
    Direction,
    SiteModel,
    WavePlace,
    build_clamping_pins,
    build_fibre_field,
    build_materials,
    build_problem,
    build_steps,
    compute_contact_radius,
    read_indenter,
    to_vector3,
)
from .sites import clamp_problem as clamp_problem


def __getattr__(name: str) -> Any:
    return find_renamed(__name__, name, {"clamped": "clamp_problem"})
