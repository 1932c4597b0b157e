"""A limb in its socket: donned, held, loaded; pressure and shear on it, and where the socket goes.

Or the other way round: under a stated pressure, whose shape is a socket's.
"""

from .model import Load, SocketFit, build_socket_problem, build_socket_steps
from .outcome import (
    RARE_SHARE,
    SETTLING,
    SHEAR_LEVELS,
    WHOLE,
    DonningCheckpoint,
    DonningResult,
    LoadedState,
    Patch,
    SocketStep,
    Strains,
    TissueStrain,
    pack,
    simulate_donning,
    unpack,
)
from .pressing import build_pressed_problem, extract_outer_surface, press_limb

__all__ = [
    "RARE_SHARE",
    "SETTLING",
    "SHEAR_LEVELS",
    "WHOLE",
    "DonningCheckpoint",
    "DonningResult",
    "Load",
    "LoadedState",
    "Patch",
    "SocketFit",
    "SocketStep",
    "Strains",
    "TissueStrain",
    "build_pressed_problem",
    "build_socket_problem",
    "build_socket_steps",
    "extract_outer_surface",
    "pack",
    "press_limb",
    "simulate_donning",
    "unpack",
]
