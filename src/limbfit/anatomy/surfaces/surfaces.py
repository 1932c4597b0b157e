"""The limb as closed surfaces: skin with a flat proximal cap, bones, and regions of soft tissue.

Bones that reach the proximal cut stick out of the skin's cap by a few millimetres, so that the void they
leave in the soft tissue is open there.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike
from scipy.ndimage import label as connected

from ...arrays import Array, Indices, Mask
from ...errors import InputError, LabelError, SurfaceError, add_location
from ...results.limb import SurfaceMeasures, SurfacesResult
from ..grid import Frame, LabelMap, ProximalEnd, build_limb_frame, find_proximal_end
from ..morphology import find_box
from .extraction import extract_fine_surface, extract_surface, remesh
from .files import read_surface, write_surface
from .triangles import Surface, check_closed, find_bodies, find_half_edges, from_pyvista

ON_CUT_MM = 0.1  # nearer to the proximal cut, a point lies on it: flat ends of files are flat to half of that
END_TOLERANCE_MM = 0.5  # a surface that ends this close to the cut is meant to be cut there
_CUT_INSIDE_MM = 2.0  # of the image's proximal end
_STICK_OUT_MM = 6.0  # of the bones beyond the cut
_SKIN_TOLERANCE_MM = 0.05  # how far a bone may lie outside the skin: rounding of files
_END_SHARE = 0.15  # of the skin's length
_OVERLAP_MM = 3.0  # of a region with a bone, or with the air: voxels and smoothing come to that
_JOIN_MM = 1e-3
# Passes of remeshing before and after the cap is cut: the rim gets better triangles from even ones, and its
# shortest edges need more passes than a smooth surface.
_PASSES_BEFORE, _PASSES_AFTER = 3, 15
_STUMP_MM3 = 200.0  # what is left of a bone distal of the cut, below which it is dropped


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Closed surfaces of a limb, LPS mm.

    Attributes
    ----------
    skin : closed, flat where the limb was cut proximally.
    bones : closed, by name; they may stick out of the skin beyond the cut plane, nowhere else.
    cut_point, cut_normal : (3,) the plane of the proximal cut; the unit normal points out, proximally.
    regions : closed, by name: bodies of soft tissue that are no layer, as a tendon or a scar; as for bones.
    """

    skin: Surface
    bones: Mapping[str, Surface]
    cut_point: Array
    cut_normal: Array
    regions: Mapping[str, Surface] = field(default_factory=dict)

    def __post_init__(self) -> None:
        point, normal = normalise_plane(self.cut_point, self.cut_normal)
        object.__setattr__(self, "cut_normal", normal)
        object.__setattr__(self, "cut_point", point)

    def height(self, points: ArrayLike) -> Array:
        """(...) distance of points beyond the cut plane, mm; negative inside the limb."""
        return (np.asarray(points, dtype=float) - self.cut_point) @ self.cut_normal

    @cached_property
    def frame(self) -> Frame:
        """Axes of the limb at its proximal cut."""
        return build_limb_frame(self.cut_point, self.cut_normal)

    @cached_property
    def open_skin(self) -> Surface:
        """The skin up to the cut: without the flat cap that closes it there, or what goes on beyond it."""
        below = self.height(self.skin.points) < -ON_CUT_MM
        return Surface(self.skin.points, self.skin.faces[below[self.skin.faces].any(axis=1)])


def build_anatomy(
    labels: LabelMap,
    edge_mm: float = 3.0,
    proximal_cut: tuple[ArrayLike, ArrayLike] | None = None,
    proximal: Array | None = None,
) -> Anatomy:
    """Smooth closed surfaces of a label map.

    Raises `LabelError` for a map without a limb, a limb that the image's side cuts off, or a bone or region
    that a cut leaves in several pieces; `SurfaceError` for a cut that misses the limb.

    Parameters
    ----------
    labels : the limb and its bones; the limb ends at one border of the image or within it.
    edge_mm : edge length of the triangles.
    proximal_cut : point and proximal normal (LPS mm) of the cut; by default 2 mm inside the limb's proximal
        end, across the image axis along which it is longest.
    proximal : (3,) LPS, where proximal is, if there is no such cut: of a short stump its shape does not say.
    """
    labels = labels.align_with_lps()
    if proximal_cut is None:
        end = find_proximal_end(labels.limb, labels, normal=proximal)
        index = (np.array(labels.size) - 1) / 2  # a little inside the outer face of the last layer
        index[end.axis] = end.layer + end.side * (0.5 - _CUT_INSIDE_MM / labels.spacing[end.axis])
        point, normal = labels.index_to_point(index), end.direction(labels)
    else:
        point, normal = normalise_plane(*proximal_cut)
        end = find_proximal_end(labels.limb, labels, normal=normal)
    own_point = np.round(labels.direction.T @ (point - labels.origin), 4)
    own_normal = np.round(labels.direction.T @ normal, 6)
    built = _build_anatomy(
        labels.move_to_own_frame(), end, edge_mm, own_point, own_normal / np.linalg.norm(own_normal)
    )

    def to_patient(body: Surface) -> Surface:
        return Surface(body.points @ labels.direction.T + labels.origin, body.faces)

    return Anatomy(
        to_patient(built.skin),
        {name: to_patient(bone) for name, bone in built.bones.items()},
        labels.direction @ built.cut_point + labels.origin,
        labels.direction @ built.cut_normal,
        {name: to_patient(region) for name, region in built.regions.items()},
    )


def _build_anatomy(
    labels: LabelMap, end: ProximalEnd, edge_mm: float, point: Array, normal: Array
) -> Anatomy:
    extended = _extend_labels(labels, end, _STICK_OUT_MM + _CUT_INSIDE_MM + 2 * edge_mm)
    heights = extended.compute_heights(point, normal)
    distal = heights < 0
    _check_sides(extended.limb & distal, end)
    skin = cut_and_cap(extract_fine_surface(extended, None, edge_mm), point, normal, edge_mm)
    reach = extended.with_array(np.where(heights > _STICK_OUT_MM, 0, extended.array))
    bones = {}
    for name in labels.bone_names:
        if (extended.mask(name) & distal).sum() * labels.voxel_mm3 >= _STUMP_MM3:
            _check_pieces(reach, name, distal)
            bones[name] = extract_surface(reach, name, edge_mm)
    regions = {}
    for label, name in labels.regions.items():
        if not (extended.mask(label) & distal).any():
            raise LabelError(
                f"nothing of {label!r} is left in the limb",
                place=f"geometry.regions.{name}",
                remedy="leave the region out or move the cut",
            )
        _check_pieces(reach, label, distal)
        regions[name] = extract_surface(reach, label, edge_mm)
    return Anatomy(skin, bones, point, normal, regions)


def _check_pieces(labels: LabelMap, name: str, distal: Mask) -> None:
    """Refuse a label of which a cut leaves notable pieces, as condyles: all but one would be lost."""
    mask = labels.mask(name)
    box = find_box(mask)  # in a fine image a bone fills little of it
    volumes = np.bincount(connected(mask[box])[0][distal[box]])[1:] * labels.voxel_mm3
    if (volumes >= _STUMP_MM3).sum() > 1:
        raise LabelError(
            f"{name!r} is cut into pieces of {' and '.join(f'{v / 1000:.2g}' for v in volumes)} cm3",
            remedy="give each piece a label of its own (segmentation.labels), or move the cut",
        )


def _extend_labels(labels: LabelMap, end: ProximalEnd, length_mm: float) -> LabelMap:
    """The map with the layer at the end repeated outward, as if the limb went on."""
    count = int(np.ceil(length_mm / labels.spacing[end.axis]))
    keep = slice(end.layer, None) if end.side < 0 else slice(None, end.layer + 1)
    kept = labels.array[tuple(keep if n == 2 - end.axis else slice(None) for n in range(3))]
    pad = [(0, 0)] * 3
    pad[2 - end.axis] = (count, 0) if end.side < 0 else (0, count)
    start = np.zeros(3)
    start[end.axis] = end.layer - count if end.side < 0 else 0
    return replace(labels, array=np.pad(kept, pad, mode="edge"), origin=labels.index_to_point(start))


def normalise_plane(point: ArrayLike, normal: ArrayLike) -> tuple[Array, Array]:
    """A point (3,) and the unit normal (3,) of a plane. Raises `SurfaceError` for a normal of no length."""
    vector = np.asarray(normal, dtype=float)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise SurfaceError("the normal of the plane is zero", remedy="give a proximal direction")
    return np.asarray(point, dtype=float), vector / length


def _check_sides(limb: Mask, end: ProximalEnd) -> None:
    """Refuse a limb, distal of the cut, that a side of the image cuts off."""
    sides = [limb.take(index, axis=2 - axis) for axis in {0, 1, 2} - {end.axis} for index in (0, -1)]
    if any(side.sum() > 20 for side in sides):
        raise LabelError(
            "the limb runs out of the side of the image",
            remedy="take an image that holds the whole limb, or move the proximal cut",
        )


def cut_and_cap(surface: Surface, point: Array, normal: Array, edge_mm: float) -> Surface:
    """Cut off what is proximal of the plane, close the rest by a flat cap with a sharp rim, and remesh it."""
    heights = (surface.points - point) @ normal
    if heights.min() >= 0 or heights.max() <= 0:
        raise SurfaceError("the proximal cut misses the limb", remedy="move its point into the limb (LPS mm)")
    even = remesh(surface, edge_mm, passes=_PASSES_BEFORE)
    cut = even.to_pyvista().clip_closed_surface(normal=-normal, origin=point, tolerance=1e-6)
    joined = pv.PolyData(cut).triangulate().clean(tolerance=_JOIN_MM, absolute=True).triangulate()
    whole = find_bodies(from_pyvista(joined))[0]
    return remesh(whole, edge_mm, _find_rim(whole, point, normal), _PASSES_AFTER)


def _find_rim(surface: Surface, point: Array, normal: Array) -> Indices:
    """(n, 2) edges between the flat cap and the rest."""
    on_plane = np.abs((surface.points - point) @ normal) < _JOIN_MM
    in_cap = np.tile(on_plane[surface.faces].all(axis=1), 3)
    count = len(surface.points)
    keys = np.sort(find_half_edges(surface.faces), axis=1) @ [count, 1]
    return np.stack(np.divmod(np.intersect1d(keys[in_cap], keys[~in_cap]), count), axis=1)


def check_anatomy(anatomy: Anatomy, files: Mapping[str, Path] | None = None) -> None:
    """Refuse an anatomy that cannot be meshed. Raises `SurfaceError` for a surface that :func:`check_closed`
    refuses, a skin that ends below the cut, a bone or region outside the skin (beyond the cut is allowed), or
    a region that reaches into a bone.
    """
    files = files or {}
    check_closed(anatomy.skin, "skin", files.get("skin"))
    check_cut(anatomy)
    for name, bone in anatomy.bones.items():
        check_closed(bone, name, files.get(name))
        with add_location(file=files.get(name)):
            _check_inside(anatomy, name)
    for name, region in anatomy.regions.items():
        check_closed(region, name, files.get(name), smallest_mm=0.0)
        with add_location(file=files.get(name), place=f"geometry.regions.{name}"):
            _check_region(anatomy, region)


def check_cut(anatomy: Anatomy) -> None:
    """Refuse a proximal cut that the skin does not reach. Raises `SurfaceError`."""
    top = float(anatomy.height(anatomy.skin.points).max())
    if top < -END_TOLERANCE_MM:
        raise SurfaceError(
            f"the skin ends {-top:.1f} mm below the proximal cut plane",
            place="geometry.proximal_cut",
            remedy="move the plane or check its normal",
        )


def _check_region(anatomy: Anatomy, region: Surface) -> None:
    """Refuse a region that lies beyond the cut, outside the skin or in a bone by more than voxels explain."""
    points = region.points[anatomy.height(region.points) < 0.0]
    if not len(points):
        raise SurfaceError(
            "the region lies wholly beyond the proximal cut", remedy="leave it out or move the cut"
        )
    outside = float(anatomy.skin.signed_distance(points).max())
    if outside > _OVERLAP_MM:
        raise SurfaceError(
            f"the region lies outside the limb by up to {outside:.1f} mm",
            remedy="check that it is in the same coordinates (LPS or RAS) and unit as the skin",
        )
    for bone, body in anatomy.bones.items():
        deep = max(-body.signed_distance(points).min(), -region.signed_distance(body.points).min())
        if deep > _OVERLAP_MM:
            raise SurfaceError(
                f"the region and the bone {bone} overlap by up to {deep:.1f} mm",
                remedy="let the region end at the bone's surface",
            )


def _check_inside(anatomy: Anatomy, name: str) -> None:
    points = anatomy.bones[name].points
    inner = points[anatomy.height(points) < -_SKIN_TOLERANCE_MM]
    if len(inner) == 0:
        raise SurfaceError(
            f"{name} lies wholly beyond the proximal cut", remedy="leave it out or move the cut"
        )
    distance = anatomy.skin.signed_distance(inner)
    outside = distance > _SKIN_TOLERANCE_MM
    if outside.any():
        what = (
            f"{name} lies outside the skin: {int(outside.sum())} of its {len(points)} points, by up to "
            f"{distance.max():.1f} mm"
        )
        remedy = "check that skin and bone are in the same coordinates (LPS or RAS, mm)"
        if _is_at_one_end(anatomy.skin, inner[outside]):
            what += ", all at one end of the limb"
            remedy = f"if the bone is cut there, say where: geometry.proximal_cut; else {remedy}"
        raise SurfaceError(what, remedy=remedy)


def _is_at_one_end(skin: Surface, points: Array) -> bool:
    """True for points near one end of the skin, or beyond it, along its longest axis."""
    middle = skin.points.mean(axis=0)
    axis = np.linalg.svd(skin.points - middle, full_matrices=False)[2][0]
    along, here = (skin.points - middle) @ axis, (points - middle) @ axis
    margin = _END_SHARE * np.ptp(along)
    return bool(here.min() > along.max() - margin or here.max() < along.min() + margin)


def save_anatomy(folder: str | Path, anatomy: Anatomy, notes: Sequence[str] = ()) -> None:
    """Write skin.stl, bone-<name>.stl, region-<name>.stl and surfaces.json (cut, volumes, areas, notes)."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    bones = {f"bone-{name}": bone for name, bone in anatomy.bones.items()}
    regions = {f"region-{name}": region for name, region in anatomy.regions.items()}
    for name, surface in {"skin": anatomy.skin, **bones, **regions}.items():
        write_surface(folder / f"{name}.stl", surface)
    summary = SurfacesResult(
        coordinates="LPS",
        unit="mm",
        cut_point=anatomy.cut_point.tolist(),
        cut_normal=anatomy.cut_normal.tolist(),
        skin=_measure_surface(anatomy.skin),
        bones={name: _measure_surface(bone) for name, bone in anatomy.bones.items()},
        regions={name: _measure_surface(region) for name, region in anatomy.regions.items()},
        notes=notes,
    )
    (folder / "surfaces.json").write_text(json.dumps(summary.to_plain(), indent=2) + "\n", encoding="utf-8")


def _measure_surface(surface: Surface) -> SurfaceMeasures:
    return SurfaceMeasures(
        faces=len(surface.faces), volume_mm3=round(surface.volume, 1), area_mm2=round(surface.area, 1)
    )


def load_anatomy(folder: str | Path) -> Anatomy:
    """What :func:`save_anatomy` wrote."""
    folder = Path(folder)
    remedy = "run the surfaces stage again"
    try:
        summary = SurfacesResult.read_file(folder / "surfaces.json", remedy)
    except (OSError, InputError):
        raise SurfaceError("surfaces.json is missing or unreadable", file=folder, remedy=remedy) from None
    skin = read_surface(folder / "skin.stl")
    bones = {name: read_surface(folder / f"bone-{name}.stl") for name in summary.bones}
    regions = {name: read_surface(folder / f"region-{name}.stl") for name in summary.regions}
    return Anatomy(skin, bones, np.array(summary.cut_point), np.array(summary.cut_normal), regions)
