"""The round end of a rod: a cylinder whose rounding is half its width."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from .cylinder import Cylinder
from .facets import Facets, revolved
from .shape import Size

STEEPEST_DEG = 75.0  # of a face; what is steeper touches no skin


@dataclass(frozen=True)
class Sphere(Cylinder):
    """A sphere in front, a rod behind it."""

    name: ClassVar[str] = "sphere"
    words: ClassVar[str] = "spherical indenter"
    has_edge: ClassVar = False
    variants: ClassVar = {"sphere": 0.0}

    @classmethod
    def of(cls, size: Size) -> Self:
        """See `Shape.of`; it has no edge to round."""
        return replace(super().of(size), radius=size.width / 2)

    def facets(self) -> Facets:
        """A disk, bent."""
        points, faces = revolved(self.radius * np.radians(STEEPEST_DEG), np.zeros(0), self.outline)
        return Facets(points, faces, rounding=self.radius)
