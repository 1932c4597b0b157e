"""A FitSocket that is a program: pins, sensors, a limb, faults, and the device's end of the line protocol.

No hardware was at hand.  What is here behaves as the documents say a device must, with speeds, noise and play
that such devices plausibly have; it is no model of a particular one.
"""

from .fitsocket import FAULT_KINDS, Fault, VirtualFitSocket, read_faults
from .parts import Surrogate, VirtualLimb, fit_surrogate
from .server import Endpoint, serve
