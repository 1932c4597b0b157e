"""The pressure that a socket is meant to have on the limb: presets, tissue depth, and values of regions."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import KDTree

from ..anatomy.surfaces.surfaces import Anatomy
from ..arrays import Array
from ..errors import SurfaceError
from .areas import Zone
from .landmarks import SkinRegion
from .shape import Socket

PROMINENCES = ("tibial crest", "fibular head", "distal tibia", "distal fibula")
REACH_MM = 18.0  # beyond a region: over what its pressure, or depth, goes over into what is beside it
BRIM_MM = 20.0  # below the brim: over what the pressure comes on
FULL_DEPTH_MM = 20.0  # of tissue over bone: deeper tissue bears as much

TISSUE_DEPTH = "tissue depth"


# Shares of the stated pressure: of the limb, and of regions that have another one. Round figures for what
# concepts of sockets intend, to begin with; none is measured.
PRESETS: Mapping[str, tuple[float, Mapping[str, float]]] = {
    "hydrostatic": (1.0, {}),
    "total surface bearing": (1.0, dict.fromkeys(PROMINENCES, 0.5)),
    "patellar tendon bearing": (
        0.6,
        {"patellar tendon": 2.0, "medial proximal": 1.5, "posterior proximal": 1.5}
        | dict.fromkeys(PROMINENCES, 0.25),
    ),
}


@dataclass(frozen=True)
class Target:
    """A pressure field over the limb.

    Attributes
    ----------
    kind : ``tissue depth`` or a name of `PRESETS`.
    pressure_kPa : what shares are meant of.
    regions : pressures of regions, kPa, over those of the kind.
    """

    kind: str
    pressure_kPa: float
    regions: Mapping[str, float] = field(default_factory=dict)

    def at(self, points: Array, anatomy: Anatomy, regions: Mapping[str, SkinRegion], socket: Socket) -> Array:
        """Pressure (n,) kPa at points (n, 3) of the limb's outer surface, LPS mm; 0 beyond the brim.

        Parameters
        ----------
        regions : of the limb; those of a preset that it does not have count as the rest.
        socket : any face around the limb, for where the brim runs.

        Raises
        ------
        SurfaceError
            For a region that the limb does not have, and tissue depth of a limb without bones.
        """
        skin = anatomy.skin
        below = skin.find_nearest(points)[2]  # a liner
        if self.kind == TISSUE_DEPTH:
            found = self.pressure_kPa * _compute_depth_share(below, anatomy)
            values: dict[str, float] = {}
        else:
            limb, others = PRESETS[self.kind]
            found = np.full(len(points), self.pressure_kPa * limb)
            values = {name: share * self.pressure_kPa for name, share in others.items()}
        rest = {name: values[name] for name in values if name in regions and name not in self.regions}
        for name, value in (*rest.items(), *self.regions.items()):  # where they overlap, what is stated wins
            share = build_zone(name, anatomy, regions, 0.0).share(below)
            found = (1.0 - share) * found + share * value
        # Nothing beyond the brim; below it the pressure grows smoothly.
        t = np.clip(KDTree(socket.points[socket.brim]).query(points)[0] / BRIM_MM, 0.0, 1.0)
        return np.where(socket.find_covered(points), found * t**2 * (3.0 - 2.0 * t), 0.0)


def build_zone(name: str, anatomy: Anatomy, regions: Mapping[str, SkinRegion], depth_mm: float) -> Zone:
    """Build the zone of a region of the limb that is pressed into a face by a depth, or relieved. Raises
    `SurfaceError` where the limb has no such region.
    """
    if name not in regions:
        raise SurfaceError(f"no region is named {name!r}", remedy="the limb has " + ", ".join(regions))
    points = anatomy.skin.triangles[regions[name].faces].mean(axis=1)
    return Zone(name, points, REACH_MM, depth_mm)


def _compute_depth_share(points: Array, anatomy: Anatomy) -> Array:
    """Compute the depth (n,) of points of the skin over the nearest bone, as a share of ``FULL_DEPTH_MM``."""
    if not anatomy.bones:
        raise SurfaceError(
            "the depth of tissue is not known: the limb has no bones",
            remedy=f"choose another socket.design.pressure: {', '.join(PRESETS)}",
        )
    squared = [bone.find_nearest(points)[0] for bone in anatomy.bones.values()]
    return np.asarray(np.clip(np.sqrt(np.min(squared, axis=0)) / FULL_DEPTH_MM, 0.0, 1.0))
