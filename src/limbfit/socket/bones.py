"""A socket's face must leave the bones inside."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..anatomy.frame import Frame
from ..anatomy.surfaces.surfaces import compute_signed_distance
from ..anatomy.surfaces.triangles import Surface
from ..errors import SurfaceError
from .shape import close_by_fans

INTO_BONE_MM = 0.5  # by which a bone may reach through the face: roughness


def refuse_bones(
    points: NDArray[np.float64],
    faces: NDArray[np.int64],
    brim: NDArray[np.int64],
    frame: Frame,
    bones: Mapping[str, Surface],
    *,
    remedy: str,
    spare_mm: float = 0.0,
) -> None:
    """Refuse a face that a bone reaches through, below the brim.

    Parameters
    ----------
    points, faces, brim : of a `Socket`, LPS mm.
    frame : of the limb.
    bones : closed surfaces, LPS mm.
    spare_mm : how far a bone may do so besides roughness: a liner that the face was drawn without.

    Raises
    ------
    SurfaceError
        With the bone, how far it reaches through, and the remedy.
    """
    face = Surface(frame.to_limb(points), faces)
    closed = close_by_fans(face.flipped)
    lowest = float(face.points[brim, 2].min())
    for name, bone in bones.items():
        local = frame.to_limb(bone.points)
        below = local[local[:, 2] < lowest - INTO_BONE_MM]
        if not len(below):
            continue
        out = float(compute_signed_distance(closed, below).max()) - spare_mm
        if out > INTO_BONE_MM:
            raise SurfaceError(f"the socket cuts {out:.1f} mm into the bone {name}", remedy=remedy)
