"""The socket's shape: rectified from a limb or read from a file, its regions, its wall for printing."""

from .reading import read_socket
from .rectify import Area, Recipe, rectified
from .shape import Socket, circumference

__all__ = ["Area", "Recipe", "Socket", "circumference", "read_socket", "rectified"]
