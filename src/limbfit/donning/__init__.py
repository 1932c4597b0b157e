"""A limb in its socket: donned, held, loaded; pressure and shear on it, and where the socket goes.

Or the other way round: under a stated pressure, whose shape is a socket's.
"""

from .model import Load, SocketFit, build_socket_problem, build_socket_steps
from .outcome import (
    RARE,
    SETTLING,
    SHEAR_LEVELS,
    WHOLE,
    Donned,
    DonnedPart,
    Held,
    Patch,
    SocketStep,
    Strains,
    TissueStrain,
    don,
    pack,
    unpack,
)
from .pressing import build_pressed_problem, extract_outer_surface, press

__all__ = [
    "RARE",
    "SETTLING",
    "SHEAR_LEVELS",
    "WHOLE",
    "Donned",
    "DonnedPart",
    "Held",
    "Load",
    "Patch",
    "SocketFit",
    "SocketStep",
    "Strains",
    "TissueStrain",
    "build_pressed_problem",
    "build_socket_problem",
    "build_socket_steps",
    "don",
    "extract_outer_surface",
    "pack",
    "press",
    "unpack",
]
