"""A study's site as a mechanical problem, and what is observed in it."""

from typing import Any

from ..laws import Parameters, list_flat_names, to_parameters, to_vector
from ..renamed import find_renamed
from .cell_fields import Direction, build_fibre_field
from .clamps import build_clamping_pins
from .clamps import clamp_problem as clamp_problem
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
    SiteModel,
    build_materials,
    build_problem,
    build_steps,
    compute_contact_radius,
    read_indenter,
)
from .waves import WavePlace, to_vector3


def __getattr__(name: str) -> Any:
    return find_renamed(__name__, name, {"clamped": "clamp_problem"})
