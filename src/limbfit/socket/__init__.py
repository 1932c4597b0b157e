"""The socket's shape: rectified from a limb or read from a file, its regions, its wall for printing."""

from .pressing import Area, Zone
from .reading import read_socket
from .rectify import Recipe, rectify_limb
from .shape import Socket
