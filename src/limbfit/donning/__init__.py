"""A limb in its socket while it is donned, held and loaded: pressure, shear, strain, and the socket's motion.

Also the reverse: a limb under a stated pressure, whose deformed surface is the shape of a socket.
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
