"""A socket's inner face: an open triangle surface around a limb, what is measured on it, and bones inside."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..anatomy.grid import Frame
from ..anatomy.surfaces.triangles import Surface, close_by_fans, open_loops
from ..arrays import Array, Indices, Mask
from ..errors import SurfaceError

BONE_ROUGHNESS_MM = 0.5  # by which a bone may reach through the face: roughness


@dataclass(frozen=True, eq=False)
class Socket:
    """The inner face of a socket in LPS mm, in its final shape and clear of the limb.

    Attributes
    ----------
    points : (n, 3) the final shape.
    faces : (m, 3) counter-clockwise seen from the tissue.
    clear : (n, 3) the same points where the face is clear of the limb.
    brim : the proximal edge, one ordered closed line of points (k,).
    open_distal : whether the distal end is open too.
    notes : what was done to the file that it came from, in words.
    """

    points: Array
    faces: Indices
    clear: Array
    brim: Indices
    open_distal: bool = False
    notes: tuple[str, ...] = ()

    @property
    def surface(self) -> Surface:
        """The face as a surface whose normals point at the tissue."""
        return Surface(self.points, self.faces)

    @cached_property
    def closed_surface(self) -> Surface:
        """The space inside as a closed surface, outward; each opening is closed by a fan."""
        return close_by_fans(self.surface.flipped_surface)

    @property
    def volume_mm3(self) -> float:
        """The volume up to the brim."""
        return self.closed_surface.volume

    def find_covered(self, points: Array) -> Mask:
        """True (n,) for points (n, 3) that the face reaches: what of it is nearest is at no open edge."""
        nearest = self.surface.find_nearest(points)[1]
        edges = np.concatenate(open_loops(self.surface))
        return np.asarray(~np.isin(self.faces[nearest], edges).any(axis=1))

    def offset(self, limb: Surface) -> Array:
        """(n,) how deep each point lies inside a closed limb surface, mm; negative outside."""
        return -limb.signed_distance(self.points)


def cut_section(surface: Surface, point: ArrayLike, normal: ArrayLike) -> Array:
    """(k, 2, 3) segments in which a plane cuts a surface, all with the surface's outside on one side."""
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    height = (surface.points - np.asarray(point, dtype=float)) @ normal
    height[height == 0.0] = 1e-12  # a point in the plane belongs to one side
    above = height[surface.faces] > 0.0
    faces, above = surface.faces[above.any(axis=1) & ~above.all(axis=1)], above[above.any(1) & ~above.all(1)]
    # The corner that is alone on its side comes first.
    alone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(faces))
    a, b, c = (faces[rows, (alone + turn) % 3] for turn in range(3))

    def find_crossings(start: Indices, end: Indices) -> Array:
        share = height[start] / (height[start] - height[end])
        return surface.points[start] + share[:, None] * (surface.points[end] - surface.points[start])

    first, second = find_crossings(a, b), find_crossings(a, c)
    turned = (height[a] > 0.0)[:, None]
    return np.stack([np.where(turned, first, second), np.where(turned, second, first)], axis=1)


def measure_section(surface: Surface, z: float) -> Array:
    """Centre (x, y) and area of what a surface encloses at a height."""
    segments = cut_section(surface, (0.0, 0.0, z), (0.0, 0.0, 1.0))
    a, b = segments[:, 0, :2], segments[:, 1, :2]
    twice = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = twice.sum() / 2
    return np.append((twice[:, None] * (a + b)).sum(axis=0) / (6 * area), abs(area))


def refuse_bones(
    face: Surface,
    brim: Indices,
    frame: Frame,
    bones: Mapping[str, Surface],
    *,
    remedy: str,
    spare_mm: float = 0.0,
) -> None:
    """Refuse a face that a bone reaches through, below the brim and above an open end.

    Raises `SurfaceError` with the bone, how far it reaches through, and the remedy.

    Parameters
    ----------
    face, brim : of a `Socket`, LPS mm.
    frame : of the limb.
    bones : closed surfaces, LPS mm.
    spare_mm : how far a bone may do so besides roughness: a liner that the face was drawn without.
    """
    face = Surface(frame.to_limb(face.points), face.faces)
    closed = close_by_fans(face.flipped_surface)
    lowest = float(face.points[brim, 2].min())
    ends = [face.points[loop, 2].max() for loop in open_loops(face) if loop[0] not in brim]
    for name, bone in bones.items():
        local = frame.to_limb(bone.points)
        height = local[:, 2]
        below = local[(height < lowest - BONE_ROUGHNESS_MM) & (height > max(ends, default=-np.inf))]
        if not len(below):
            continue
        out = float(closed.signed_distance(below).max()) - spare_mm
        if out > BONE_ROUGHNESS_MM:
            raise SurfaceError(f"the socket cuts {out:.1f} mm into the bone {name}", remedy=remedy)
