"""A limb in its socket: donned, held, loaded; pressure and shear on it, and where the socket goes."""

from .model import Fit, Load, socket_problem, socket_steps
from .outcome import SETTLING, WHOLE, Donned, Held, Patch, Row, don

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
    "socket_problem",
    "socket_steps",
]
