"""How far a limb's surface has moved along the rays of the limb: the shape that pressures give a socket."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..anatomy.frame import Frame
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError
from .rays import LimbProfile, compute_radii, smooth

SMOOTH_MM = 5.0  # half of an edge of the limb's mesh: what is shorter is that of its faces


@dataclass(frozen=True, eq=False)
class Offsets:
    """Moves along the rays of a limb.

    Attributes
    ----------
    limb : whose rays they are.
    radial : (k, angles) mm, positive outwards, at the limb's stations and angles.
    """

    limb: LimbProfile
    radial: Array

    def moves(self, points: Array) -> Array:
        """Moves (n, 3) of points (n, 3) of the limb frame, along their rays."""
        angle, station, _ = self.limb.rays.coordinates(points)
        size = self.limb.interpolated(self.radial)(angle, station)
        return np.asarray(size[:, None] * self.limb.rays.direction(angle, station))


def compute_offsets(limb: LimbProfile, before: Surface, after: Surface, frame: Frame) -> Offsets:
    """By how much a limb's outer surface (LPS mm) moves along each ray of the limb.

    Both surfaces have the same triangles, open at the proximal cut, so that their facets cancel.

    Raises
    ------
    SurfaceError
        Where a surface does not surround the limb's middle line.
    """
    first, second = (
        compute_radii(Surface(frame.to_limb(one.points), one.faces), limb.rays, limb.stations, limb.angles)[0]
        for one in (before, after)
    )
    radial = second - first
    # Rays beside the proximal cut may pass it: no face reaches there.
    known = np.flatnonzero(~np.isnan(radial).any(axis=1))
    if len(known) < 0.9 * len(radial) or known[0] != 0 or np.any(np.diff(known) > 1):
        raise SurfaceError(
            "the moved surface does not surround the limb's middle line", remedy="lower the pressure"
        )
    radial[known[-1] + 1 :] = radial[known[-1]]
    return Offsets(limb, smooth(radial, limb.stations, float(np.median(first[known])), SMOOTH_MM))
