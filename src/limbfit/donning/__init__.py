"""A limb in its socket while it is donned, held and loaded: pressure, shear, strain, and the socket's motion.

Also the reverse: a limb under a stated pressure, whose deformed surface is the shape of a socket.
"""

from .model import (
    Load,
    SocketFit,
    build_pressed_problem,
    build_socket_problem,
    build_socket_steps,
    extract_outer_surface,
    press_limb,
)
from .outcome import (
    SETTLING,
    SHEAR_LEVELS,
    DonningResult,
    LoadedState,
    SocketStep,
    Strains,
    pack,
    simulate_donning,
    unpack,
)
