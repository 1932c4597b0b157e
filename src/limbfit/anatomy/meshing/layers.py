"""Implicit fields of a limb: depth below the skin, distance to the bones, the layers and trimmed bone.

A liner is one more layer, outside the skin.

Vocabulary
----------
limb frame  the proximal cut is the plane z = 0 and the limb lies at z <= 0; millimetres.
depth       distance to the *smooth* skin surface, positive inside the limb.
floor       depth of the innermost layer's inner face: of one value, or a function on the skin that a point
            takes from its nearest skin point.
layer       the level set ``depth = floor``: layers of skin and adipose tissue above it, the core below.
void        signed distance to the bones, negative inside, after the policy: bone that is shallower than
            floor + clearance is given to the core.

Both kinds of surface are prolonged straight beyond the proximal cut before distances are taken: otherwise
the flat cap would count as skin and be offset too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pyvista as pv

from ...arrays import Array
from ...errors import SurfaceError
from ...results.limb import BoneLoss, SkinLoss
from ..grid import Frame
from ..surfaces.surfaces import END_TOLERANCE_MM, Anatomy, check_cut, cut_and_cap
from ..surfaces.thickness import limit_slope, transfer_values
from ..surfaces.triangles import Surface, cross_edges, find_bodies, find_open_edges, from_pyvista

Level = tuple[Array, Array]  # a signed function at points and its gradient there

PROLONGATION_MM = 40.0
SEAM_MM = 3.0  # below the cut, where surfaces are prolonged from
NORMAL_WITHIN_MM = 1e-3  # of a surface, where its normal stands for the gradient of the distance
TRIM_SAMPLES = 60_000
MIN_LAYER_SHARE = 1 / 3  # of the layers' thickness, below which ``thin-skin`` trims bone instead

LINER_SPACING_MM = 3.0  # of the grid on which the surface is contoured
LINER_EDGE_MM = 4.0  # of its triangles

BonePolicy = Literal["trim-bone", "thin-skin"]


@dataclass(frozen=True)
class LayerSpec:
    """A layer of tissue: thickness in mm, or None where it reaches down to the segmented fat's inner face."""

    name: str
    thickness_mm: float | None
    min_thickness_mm: float = 1.0


@dataclass(frozen=True)
class LimbFields:
    """Fields of a limb in its frame; build it with :func:`build_limb_fields`.

    ``skin``, ``bones`` and ``regions`` (bodies inside the core) are prolonged beyond the cut, in limb
    coordinates. ``depths`` (layers, n) are those of the layers' inner faces at the skin's n vertices,
    outermost first, mm; (layers, 1) where uniform.
    """

    frame: Frame
    skin: Surface
    bones: Mapping[str, Surface]
    depths: Array
    bone_clearance_mm: float
    thinned: SkinLoss | None = None
    regions: Mapping[str, Surface] = field(default_factory=dict)

    @property
    def is_uniform(self) -> bool:
        return self.depths.shape[1] == 1

    @property
    def floor_range_mm(self) -> float:
        """Range of the floor: the levels of two points differ by at most their distance and this."""
        return float(np.ptp(self.depths[-1]))

    def depth(self, points: Array) -> Level:
        """Depth (n,) of points (n, 3) below the skin, positive inside, and its gradient (n, 3)."""
        distance, slope = evaluate_distance(self.skin, points)
        return -distance, -slope

    def layer_depths(self, points: Array) -> Array:
        """Depths (layers, n) of the layers' inner faces below the skin points nearest to points (n, 3)."""
        if self.is_uniform:
            return np.repeat(self.depths, len(points), axis=1)
        return transfer_values(self.skin, self.depths, points)

    def floor(self, points: Array) -> Array:
        """Depth (n,) of the innermost layer's inner face at points (n, 3)."""
        return self.layer_depths(points)[-1]

    def layer(self, points: Array) -> Level:
        """Level (n,) of the layers' inner face, positive in the core, and the gradient (n, 3) of depth.

        Along that gradient a point keeps its nearest skin point, and so its floor.
        """
        depth, slope = self.depth(points)
        return depth - self.floor(points), slope

    def void(self, points: Array) -> Level:
        """Signed function (n,) of the bones that stay at least clearance below the layers, negative inside.

        Where bone was trimmed it is the depth that is missing; the gradient (n, 3) belongs to the part that
        counts.
        """
        level, slope = self.layer(points)
        value, gradient = self.bone_clearance_mm - level, -slope
        bone, bone_slope = self._bone(points)
        own = bone > value
        return np.where(own, bone, value), np.where(own[:, None], bone_slope, gradient)

    def _bone(self, points: Array) -> Level:
        """Signed distance (n,) to the nearest bone as segmented, and its gradient."""
        value, gradient = np.full(len(points), np.inf), np.zeros((len(points), 3))
        for bone in self.bones.values():
            candidates = np.flatnonzero(compute_box_distance(bone, points) < value)
            distance, slope = evaluate_distance(bone, points[candidates])
            nearer = distance < value[candidates]
            value[candidates[nearer]], gradient[candidates[nearer]] = distance[nearer], slope[nearer]
        return value, gradient

    def measure_trimmed_bone(self, bone: Surface) -> BoneLoss:
        """What trimming took from a bone."""
        below = bone.points[bone.points[:, 2] <= 0.0]
        excess = self.bone_clearance_mm - self.layer(below)[0] if len(below) else np.zeros(0)
        shallow = below[excess > 0]
        if not len(shallow):
            return BoneLoss(volume_mm3=0.0, depth_mm=0.0)
        # A bone's shallow part spans at most its own edge length beyond its shallow vertices.
        corners = bone.triangles
        pad = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
        samples, whole = sample_box(shallow, pad, TRIM_SAMPLES)
        inside = evaluate_distance(bone, samples)[0] < 0
        cut = self.layer(samples[inside])[0] < self.bone_clearance_mm
        return BoneLoss(volume_mm3=cut.sum() * whole / len(samples), depth_mm=excess.max())


def build_limb_fields(
    anatomy: Anatomy,
    layers: tuple[LayerSpec, ...],
    bone_clearance_mm: float,
    policy: BonePolicy = "trim-bone",
    fat_depth_mm: Array | None = None,
) -> LimbFields:
    """The fields of an anatomy.

    Raises `SurfaceError` when the skin does not reach the cut plane, or the fat's depth is needed and not
    given.

    Parameters
    ----------
    anatomy : closed skin and bones.
    layers : outermost first.
    bone_clearance_mm : least distance of bone below the layers.
    policy : what gives way where bone is shallower, the bone or the layers.
    fat_depth_mm : (n,) depth of the fat's inner face at the vertices of the anatomy's skin, for a layer
        without a thickness of its own.
    """
    check_cut(anatomy)
    frame = anatomy.frame
    skin = Surface(frame.to_limb(anatomy.skin.points), anatomy.skin.faces)
    bones, regions = (_prolong_bodies(bodies, frame) for bodies in (anatomy.bones, anatomy.regions))
    prolonged = prolong_surface(skin)
    depths = _compute_layer_depths(layers, skin, prolonged, fat_depth_mm)
    fields = LimbFields(frame, prolonged, bones, depths, bone_clearance_mm, regions=regions)
    return _thin_layers(fields) if policy == "thin-skin" else fields


def _prolong_bodies(bodies: Mapping[str, Surface], frame: Frame) -> dict[str, Surface]:
    """Bodies inside the skin in the limb frame, those that end at the cut prolonged beyond it."""
    found = {name: Surface(frame.to_limb(body.points), body.faces) for name, body in bodies.items()}
    ends_at_cut = {
        name: -END_TOLERANCE_MM < body.points[:, 2].max() < SEAM_MM for name, body in found.items()
    }
    return {name: prolong_surface(body) if ends_at_cut[name] else body for name, body in found.items()}


def _compute_layer_depths(
    layers: tuple[LayerSpec, ...], skin: Surface, prolonged: Surface, fat_depth_mm: Array | None
) -> Array:
    """Depths (layers, n) of the layers' inner faces at the vertices of the prolonged skin, or (layers, 1)."""
    fat = np.zeros(1)
    if any(layer.thickness_mm is None for layer in layers):
        if fat_depth_mm is None:
            raise SurfaceError("a layer follows the fat, but fat_depth_mm is not given")
        inside = np.minimum(prolonged.points, [np.inf, np.inf, -SEAM_MM])
        fat = transfer_values(skin, fat_depth_mm[None], inside)[0]
    depth, depths = np.zeros_like(fat), []
    for layer in layers:
        if layer.thickness_mm is None:
            depth = np.maximum(fat, depth + layer.min_thickness_mm)
        else:
            depth = depth + layer.thickness_mm
        depths.append(depth)
    return np.array(depths)


def _thin_layers(fields: LimbFields) -> LimbFields:
    """Layers thinned in proportion where bone comes nearer to the skin than they and the clearance do."""
    skin = fields.skin
    depths = np.repeat(fields.depths, len(skin.points), axis=1) if fields.is_uniform else fields.depths
    whole = depths[-1]
    room = np.maximum(fields._bone(skin.points)[0] - fields.bone_clearance_mm, MIN_LAYER_SHARE * whole)
    left = np.minimum(whole, limit_slope(skin, np.minimum(whole, room)))
    if (left == whole).all():
        return replace(fields, thinned=SkinLoss(volume_mm3=0.0, thinnest_mm=whole.min()))
    below = skin.points[:, 2] <= 0.0
    lost = np.where(below, whole - left, 0.0)[skin.faces].mean(axis=1)
    thinned = SkinLoss(volume_mm3=lost @ skin.face_areas, thinnest_mm=left[below].min())
    return replace(fields, depths=depths * (left / whole), thinned=thinned)


def evaluate_distance(surface: Surface, points: Array) -> Level:
    """Signed distance (n,) of points (n, 3) to a closed outward surface, negative inside, and gradient."""
    distance, face, nearest = surface.find_signed(points)
    close = np.abs(distance) < NORMAL_WITHIN_MM
    gradient = (points - nearest) / np.where(close, 1.0, distance)[:, None]
    normal = cross_edges(surface.triangles[face[close]])
    gradient[close] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return distance, gradient


def prolong_surface(surface: Surface) -> Surface:
    """The surface below z = -SEAM_MM with its section there drawn out along z, far beyond the cut.

    Cutting below the plane makes it immaterial how exactly the surface's own cap lies on the plane and
    whether its rim is rounded.
    """
    clipped = surface.to_pyvista().clip_closed_surface(normal=(0, 0, -1), origin=(0, 0, -SEAM_MM))
    body = from_pyvista(clipped.triangulate().clean())
    cap = (np.abs(body.points[:, 2] + SEAM_MM) < 1e-6)[body.faces].all(axis=1)
    moved = np.unique(body.faces[cap])
    top = np.full(len(body.points), -1)
    top[moved] = len(body.points) + np.arange(len(moved))
    points = np.vstack([body.points, body.points[moved] + [0.0, 0.0, PROLONGATION_MM]])
    a, b = find_open_edges(body.faces[cap]).T
    walls = np.vstack([np.stack([a, b, top[b]], axis=1), np.stack([a, top[b], top[a]], axis=1)])
    return Surface(points, np.vstack([body.faces[~cap], top[body.faces[cap]], walls]))


def compute_box_distance(surface: Surface, points: Array) -> Array:
    """Distance (n,) to the surface's bounding box, a lower bound of that to the surface; -inf inside."""
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    outside = np.maximum(np.maximum(low - points, points - high), 0.0)
    distance = np.linalg.norm(outside, axis=1)
    return np.where(distance > 0, distance, -np.inf)


def sample_box(points: Array, pad_mm: float, count: int) -> tuple[Array, float]:
    """About ``count`` cell centres (k, 3) of a grid over the box of points (n, 3) below the cut, wider by
    ``pad_mm``, and the box's volume, mm3; none where all of it is beyond the cut."""
    low, high = points.min(axis=0) - pad_mm, points.max(axis=0) + pad_mm
    high[2] = min(high[2], 0.0)
    if high[2] <= low[2]:
        return np.zeros((0, 3)), 0.0
    whole = float(np.prod(high - low))
    counts = np.maximum(1, np.round((high - low) / (whole / count) ** (1 / 3))).astype(int)
    axes = [lo + (np.arange(n) + 0.5) * (hi - lo) / n for lo, hi, n in zip(low, high, counts)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), whole


def build_liner_surface(
    anatomy: Anatomy, thickness_mm: float, fat_depth_mm: Array | None = None
) -> tuple[Anatomy, Array | None]:
    """The anatomy whose outer surface is a liner's, everywhere ``thickness_mm`` outside the skin.

    Meshed as the outermost layer, the liner leaves the skin where it was. ``fat_depth_mm`` (n,) is the depth
    of the fat's inner face below the vertices of the skin; also return it below those of the outer surface.
    """
    frame = anatomy.frame
    skin = Surface(frame.to_limb(anatomy.skin.points), anatomy.skin.faces)
    long = prolong_surface(skin)
    liner = cut_and_cap(
        _extract_offset_surface(long, thickness_mm), np.zeros(3), np.array([0.0, 0.0, 1.0]), LINER_EDGE_MM
    )
    below = np.flatnonzero(liner.points[:, 2] < -LINER_EDGE_MM / 10)
    points = liner.points.copy()
    points[below] = _project_to_offset(long, points[below], thickness_mm)
    liner = replace(liner, points=points)
    depth = None
    if fat_depth_mm is not None:
        depth = transfer_values(skin, fat_depth_mm[None], liner.points)[0] + thickness_mm
    return replace(anatomy, skin=Surface(frame.to_patient(liner.points), liner.faces)), depth


def _extract_offset_surface(surface: Surface, distance_mm: float) -> Surface:
    """A level of the distance outside a closed surface; where that is concave it keeps clear of itself."""
    pad = distance_mm + 2.0 * LINER_SPACING_MM
    low, high = surface.points.min(axis=0) - pad, surface.points.max(axis=0) + pad
    size = np.ceil((high - low) / LINER_SPACING_MM).astype(int) + 1
    grid = pv.ImageData(dimensions=size, spacing=[LINER_SPACING_MM] * 3, origin=low)
    grid.point_data["distance"] = evaluate_distance(surface, np.asarray(grid.points))[0]
    found = grid.contour([distance_mm], scalars="distance", method="flying_edges", compute_normals=False)
    outer = find_bodies(from_pyvista(found.clean()))[0].outward_surface
    return Surface(_project_to_offset(surface, outer.points, distance_mm), outer.faces)


def _project_to_offset(surface: Surface, points: Array, distance_mm: float) -> Array:
    """Points (n, 3) near a surface's offset, put on it."""
    distance, slope = evaluate_distance(surface, points)
    return np.asarray(points + (distance_mm - distance)[:, None] * slope)
