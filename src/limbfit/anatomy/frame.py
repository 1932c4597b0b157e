"""The limb frame: the proximal cut is the plane z = 0 and the limb lies at z <= 0; millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array


@dataclass(frozen=True)
class Frame:
    """The rigid map between patient space and the limb frame."""

    rotation: Array
    origin: Array

    def to_limb(self, points: Array) -> Array:
        """Patient space (..., 3) to the limb frame."""
        return (np.asarray(points, dtype=float) - self.origin) @ self.rotation.T

    def to_patient(self, points: Array) -> Array:
        """The limb frame (..., 3) to patient space."""
        return points @ self.rotation + self.origin


def build_limb_frame(cut_point: Array, cut_normal: Array) -> Frame:
    """The frame whose z axis is the proximal normal and whose origin is ``cut_point``."""
    z = np.asarray(cut_normal, dtype=float) / np.linalg.norm(cut_normal)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return Frame(np.array([x, np.cross(z, x), z]), np.asarray(cut_point, dtype=float))
