"""A limb in its socket while it is donned, held and loaded: pressure, shear, strain, and the socket's motion.

Also the reverse: a limb under a stated pressure, whose deformed surface is the shape of a socket.
"""

from .model import Load, SocketFit, build_socket_problem, build_socket_steps
from .outcome import (
    SETTLING,
    SHEAR_LEVELS,
    DonningResult,
    LoadedState,
    Patch,
    SocketStep,
    Strains,
    pack,
    simulate_donning,
    unpack,
)
from .pressing import build_pressed_problem, extract_outer_surface, press_limb
