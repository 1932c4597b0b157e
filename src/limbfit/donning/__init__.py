"""A limb in its socket: donned, held, loaded; pressure and shear on it, and where the socket goes.

Or the other way round: under a stated pressure, whose shape is a socket's.
"""

from .model import Fit, Load, socket_problem, socket_steps
from .outcome import SETTLING, WHOLE, Donned, Held, Patch, Row, don
from .pressing import outer_surface, press, pressed_problem

__all__ = [
    "SETTLING",
    "WHOLE",
    "Donned",
    "Fit",
    "Held",
    "Load",
    "Patch",
    "Row",
    "don",
    "outer_surface",
    "press",
    "pressed_problem",
    "socket_problem",
    "socket_steps",
]
