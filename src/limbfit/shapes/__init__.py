"""Indenter shapes by name: what a study may ask for in ``indenter.shape``.

One class says everything of a shape.  Your own is registered by `register_shape`; see
docs/extending.md.
"""

from ..errors import InputError
from ..extensions import Registry
from .shape import SHARP_EDGE as SHARP_EDGE
from .shape import Cylinder, Sphere, Square, Stl
from .shape import Facets as Facets
from .shape import Measure as Measure
from .shape import Revolution as Revolution
from .shape import Shape as Shape
from .shape import Size as Size
from .shape import revolved as revolved
from .shape import steps as steps
from .triangles import RigidSurface as RigidSurface

BUILTIN_SHAPES: tuple[type[Shape], ...] = (Square, Sphere, Cylinder, Stl)
SHAPES: Registry[type[Shape]] = Registry("indenter shape", {shape.name: shape for shape in BUILTIN_SHAPES})
# Keys of a study's [indenter], which measures cannot have.
RESERVED_KEYS = ("shape", "file", "width_mm", "edge_radius_mm", "friction")


def register_shape(shape: type[Shape]) -> None:
    """Make a shape known by its name, in the file that a study names in ``study.extensions``.

    Raises
    ------
    InputError
        Where the name is taken, or a measure is not within its bounds or has the name of another key.
    """
    for measure in shape.measures:
        if measure.key in RESERVED_KEYS:
            raise InputError(f"{measure.key} is a key of every shape", place=shape.name, remedy="rename it")
        if not measure.lower <= measure.value <= measure.upper:
            raise InputError(f"{measure.key} needs lower <= value <= upper", place=shape.name)
    SHAPES.add(shape.name, shape)
