"""Per-site tetrahedral meshes of a limb: skin layer and muscle, bones as voids, graded by distance.

The recipe
----------
1. A base mesh of the muscle, once per anatomy: a tetrahedral grid under the proximal cut plane, cut along the
   layer (level set of depth at the skin's thickness) and along the bones.
2. Per site, a mesher adapts the base to the site's size field.
3. Nodes of the layer and the bones are put on their smooth surfaces; the skin layer is extruded from the
   interface to the skin, each node to its nearest skin point: its thickness is uniform by construction.
4. Quadratic elements: promoted straight-sided, then curved to the smooth surfaces where they stay sound.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import igl
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..errors import MeshingError, ProblemError
from ..mesh import Mesh, boundary_faces, check, quality, to_tet10
from . import background
from .background import BONE, FAR, LAYER, PLANE, TetGrid
from .curving import curved, with_diagonals
from .engines import ENGINES, VolumeMesh, VolumeTask
from .extrusion import guarded, prism_tets, projected
from .layers import Level, LimbFields, TrimmedBone, limb_fields
from .smoothing import improved
from .surfaces import Anatomy, Surface

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

REGIONS = ("skin", "muscle")
SURFACES = (PLANE, LAYER, BONE, FAR)
GOOD_DIHEDRAL_DEG = 8.0
SMOOTHED_BELOW_DEG = 10.0
HAUSDORFF_RADIUS_MM = 250.0  # MMG takes edges of sqrt(9/2 hausdorff R) on a surface of radius R
LAYER_RATIO = 5.0  # greatest edge over thickness of the skin layer: about 13 degrees in an even prism
SHEET_RATIO = 3.0  # greatest edge over thickness where muscle is a thin sheet over bone
RIM_LAYERS = 3.0  # depth below the cut plane, in layers, over which the extrusion turns sideways
DEPTH_RATIO = 1.5  # the fine zone is an ellipsoid, shallower than wide by this ratio


@dataclass(frozen=True)
class MeshSettings:
    """How a site is meshed; lengths in mm.

    The edge length is ``edge_near_mm`` within ``near_radius_mm`` of the site and grows from there by
    ``growth`` mm per mm up to ``edge_far_mm``. ``curved`` puts mid-edge nodes on the smooth surfaces.
    With ``local_radius_mm`` only the limb within that distance of the site is meshed, and the nodes where it
    was cut off are fixed (node set ``fixed_truncation``); that stiffens the answer. ``flatness`` is how much
    flatter than by default elements may be away from the site: fewer nodes, smaller angles.
    """

    element: Literal["tet4", "tet10"] = "tet10"
    edge_near_mm: float = 3.5
    edge_far_mm: float = 12.0
    near_radius_mm: float = 16.0
    growth: float = 0.35
    skin_layer_mm: float = 3.0
    bone_clearance_mm: float = 1.5
    time_limit_s: float = 600.0
    curved: bool = True
    local_radius_mm: float | None = None
    flatness: float = 1.0
    engine: Literal["mmg"] = "mmg"

    @property
    def base_spacing_mm(self) -> float:
        """Edge of the base grid: fine enough for the layer, no finer than the far mesh needs."""
        return float(np.clip(self.edge_far_mm / 3.0, 3.0, 6.0 * np.sqrt(self.flatness)))

    @property
    def hausdorff_mm(self) -> float:
        """How far the faceted surfaces may stray from the smooth ones."""
        return float(np.clip(self.edge_far_mm**2 / HAUSDORFF_RADIUS_MM, 0.1, 2.5)) * self.flatness**2


@dataclass(frozen=True)
class BaseMesh:
    """The muscle of an anatomy as an ungraded grid, in the limb frame; shared by all its sites.

    ``size_limit`` (n,) is the edge length that layer and bones allow at the grid's points, mm.
    """

    fields: LimbFields
    grid: TetGrid
    size_limit: Array
    trimmed: Mapping[str, TrimmedBone]
    enclosed_mm3: float


@dataclass(frozen=True)
class MeshReport:
    """What a mesh is like: counts, angles (degrees), volumes (mm3), lengths (mm), time (s).

    ``volume_error`` is relative to the volume that the surfaces enclose (None with ``local_radius_mm``). The
    layer's thickness is measured from points all over the meshed interface to the meshed skin.
    """

    nodes: int
    cells: int
    region_cells: Mapping[str, int]
    min_dihedral_deg: float
    dihedral_percentiles_deg: Mapping[str, float]
    min_scaled_jacobian: float
    volume_mm3: float
    region_volumes_mm3: Mapping[str, float]
    volume_error: float | None
    layer_mean_mm: float
    layer_std_mm: float
    trimmed_bone: Mapping[str, TrimmedBone]
    seconds: float
    engine: str
    warnings: tuple[str, ...] = field(default_factory=tuple)


def base_mesh(anatomy: Anatomy, settings: MeshSettings) -> BaseMesh:
    """The part of meshing that does not depend on the site.

    Raises
    ------
    SurfaceError
        When the skin does not reach the cut plane.
    MeshingError
        When nothing is left between layer, bones and cut.
    """
    fields = limb_fields(anatomy, settings.skin_layer_mm, settings.bone_clearance_mm)
    spacing = settings.base_spacing_mm
    low = fields.skin.points.min(axis=0) - spacing
    high = fields.skin.points.max(axis=0) + spacing
    grid = background.box_grid(low, np.array([*high[:2], 0.0]), spacing)
    for level, bit in ((fields.layer, LAYER), (fields.void, BONE)):
        grid, positive = background.cut(grid, level, bit)
        grid = grid.kept(positive)
        if not len(grid.tets):
            raise MeshingError("no muscle is left under the skin layer; choose a smaller skin_layer_mm")
    trimmed = fields.trimmed()
    limit = size_limit(fields, grid, settings)
    return BaseMesh(fields, grid, limit, trimmed, enclosed_volume(anatomy, fields, trimmed))


def mesh_site(
    anatomy: Anatomy,
    position: Array,
    axis: Array,
    settings: MeshSettings,
    base: BaseMesh | None = None,
) -> tuple[Mesh, MeshReport]:
    """A conforming two-region mesh graded about an indentation site.

    Parameters
    ----------
    anatomy : closed skin and bones, LPS mm.
    position : the site (3,) on the skin, LPS mm.
    axis : unit vector (3,) into the limb.
    settings : edge lengths, layers, element.
    base : of the same anatomy and settings, from :func:`base_mesh`; made here when not given.

    Returns
    -------
    mesh : regions ``skin`` and ``muscle``; node sets ``fixed_bone`` (on bones) and ``fixed_proximal`` (on the
        cut plane) and, with ``local_radius_mm``, ``fixed_truncation``; face set ``skin`` (outward, without
        the cut plane).
    report : quality and what was trimmed.

    Raises
    ------
    MeshingError
        When the mesher fails or its mesh has inverted elements.
    """
    start = time.perf_counter()
    base = base or base_mesh(anatomy, settings)
    fields, frame = base.fields, base.fields.frame
    site, inward = frame.to_limb(np.asarray(position)), frame.rotation @ np.asarray(axis)
    grid, limit = base.grid, base.size_limit
    if settings.local_radius_mm is not None:
        grid = _near(grid, site, settings.local_radius_mm)
        limit = size_limit(fields, grid, settings)
    task = _task(grid, site_size(grid.points, limit, site, inward, settings), settings)
    muscle = _on_surfaces(ENGINES[settings.engine](task, settings.time_limit_s), fields)
    mesh, under = _with_skin_layer(muscle, fields)
    if settings.element == "tet10":
        mesh = to_tet10(mesh)
        if settings.curved:
            mesh = curved(mesh, with_diagonals(mesh, _curved_target(mesh, fields), under))
    _check_usable(mesh)
    report = _report(mesh, base, settings, time.perf_counter() - start)
    return mesh.with_points(frame.to_patient(mesh.points)), report


def _check_usable(mesh: Mesh) -> None:
    try:
        check(mesh)
    except ProblemError as error:
        raise MeshingError(
            f"the mesh cannot be used: {error.what}; choose smaller edges, or round off sharp skin"
        ) from None


def site_size(points: Array, limit: Array, site: Array, axis: Array, settings: MeshSettings) -> Array:
    """Wanted edge length (n,) at points (n, 3), at most ``limit`` (n,); everything in the limb frame."""
    offset = points - site
    axial = offset @ axis
    lateral = np.linalg.norm(offset - axial[:, None] * axis, axis=1)
    distance = np.hypot(lateral, DEPTH_RATIO * axial)
    beyond = np.maximum(distance - settings.near_radius_mm, 0.0)
    size = np.minimum(settings.edge_near_mm + settings.growth * beyond, settings.edge_far_mm)
    return np.minimum(size, limit)


def size_limit(fields: LimbFields, grid: TetGrid, settings: MeshSettings) -> Array:
    """Edge length (n,) at which layer and sheets of muscle over bone stay as thick as elements need."""
    far = settings.edge_far_mm
    under_layer = np.maximum(background.banded(fields.layer, grid.points, far, grid.spacing), 0.0)
    sheet = np.abs(background.banded(fields.void, grid.points, far, grid.spacing)) + under_layer
    thinnest = min(settings.edge_near_mm, settings.bone_clearance_mm)
    over_bone = np.maximum(SHEET_RATIO * settings.flatness * sheet, thinnest)
    return np.minimum(LAYER_RATIO * settings.flatness * settings.skin_layer_mm + under_layer, over_bone)


def _task(grid: TetGrid, size: Array, settings: MeshSettings) -> VolumeTask:
    triangles = boundary_faces(_muscle_mesh(grid.points, grid.tets))
    common = np.bitwise_and.reduce(grid.mask[triangles], axis=1)
    surfaces = np.select([common & bit > 0 for bit in SURFACES], SURFACES, BONE)
    return VolumeTask(grid.points, grid.tets, triangles, surfaces, size, settings.hausdorff_mm)


def _near(grid: TetGrid, site: Array, radius: float) -> TetGrid:
    """The connected part of a grid within a distance of a site."""

    def ball(points: Array) -> tuple[Array, Array]:
        offset = points - site
        distance = np.linalg.norm(offset, axis=1)
        return radius - distance, -offset / np.maximum(distance, 1e-12)[:, None]

    grid, inside = background.cut(grid, ball, FAR)
    grid = grid.kept(inside)
    rows = grid.tets[:, [0, 1, 2]].ravel(), grid.tets[:, [1, 2, 3]].ravel()
    links = coo_array((np.ones(len(rows[0])), rows), shape=(len(grid.points),) * 2)
    label = connected_components(links, directed=False)[1][grid.tets[:, 0]]
    return grid.kept(label == np.bincount(label).argmax())


def _on_surfaces(muscle: VolumeMesh, fields: LimbFields) -> VolumeMesh:
    """Boundary nodes put on cut plane, layer and bone, and poor elements improved, as far as they allow."""
    return _snapped(_smoothed(_snapped(muscle, fields), fields), fields)


def _snapped(muscle: VolumeMesh, fields: LimbFields) -> VolumeMesh:
    in_plane = _nodes_on(muscle, PLANE)
    target = muscle.points.copy()
    target[in_plane, 2] = 0.0
    free = np.where(in_plane, 0.0, 1.0)
    for surface, level in ((BONE, fields.void), (LAYER, fields.layer)):
        nodes = np.flatnonzero(_nodes_on(muscle, surface))
        target[nodes] = projected(level, target[nodes], free[nodes])
    points = guarded(muscle.points, target, muscle.tets, GOOD_DIHEDRAL_DEG)
    points[in_plane, 2] = 0.0
    return replace(muscle, points=points)


def _smoothed(muscle: VolumeMesh, fields: LimbFields) -> VolumeMesh:
    """Inner nodes of poor elements move freely, those on one surface along it, those on two not at all.

    Where the limb was cut off about the site, the boundary has no shape to keep.
    """
    normals = np.zeros_like(muscle.points)
    on = {surface: _nodes_on(muscle, surface) for surface in (PLANE, LAYER, BONE)}
    normals[on[PLANE], 2] = 1.0
    for surface, level in ((LAYER, fields.layer), (BONE, fields.void)):
        normals[on[surface]] = level(muscle.points[on[surface]])[1]
    movable = np.sum(list(on.values()), axis=0) < 2
    points = improved(muscle.points, muscle.tets, SMOOTHED_BELOW_DEG, normals, movable)
    return replace(muscle, points=points)


def _nodes_on(muscle: VolumeMesh, surface: int) -> NDArray[np.bool_]:
    chosen = np.zeros(len(muscle.points), dtype=bool)
    chosen[muscle.triangles[muscle.triangle_refs == surface]] = True
    return chosen


def _muscle_mesh(points: Array, tets: Ints) -> Mesh:
    return Mesh(points, tets, "tet4", np.zeros(len(tets), np.int64), ("muscle",))


def _same_faces(faces: Ints, chosen: Ints, count: int) -> NDArray[np.bool_]:
    """Which faces (m, 3) are among the chosen (k, 3), in any order of nodes; ``count`` nodes in all."""
    packed = [np.sort(part, axis=1) @ [count * count, count, 1] for part in (faces, chosen)]
    return np.isin(packed[0], packed[1])


def _with_skin_layer(muscle: VolumeMesh, fields: LimbFields) -> tuple[Mesh, Ints]:
    """The tet4 mesh of muscle and extruded skin layer with its sets, and the node under each node."""
    count = len(muscle.points)
    faces = boundary_faces(_muscle_mesh(muscle.points, muscle.tets))
    interface = faces[_same_faces(faces, muscle.triangles[muscle.triangle_refs == LAYER], count)]
    nodes = np.unique(interface)
    # Near the cut plane nodes go out sideways, or those below it could overtake those on it.
    z_freedom = np.minimum(-muscle.points[nodes, 2] / (RIM_LAYERS * fields.skin_layer_mm), 1.0)
    outer = projected(fields.depth, muscle.points[nodes], z_freedom)
    top = np.full(count, -1)
    top[nodes] = count + np.arange(len(nodes))
    skin = prism_tets(interface, top)
    mesh = Mesh(
        points=np.vstack([muscle.points, outer]),
        cells=np.vstack([skin, muscle.tets]),
        cell_type="tet4",
        regions=np.repeat([0, 1], [len(skin), len(muscle.tets)]).astype(np.int64),
        region_names=REGIONS,
    )
    return _with_sets(mesh, muscle), np.concatenate([np.arange(count), nodes])


def _with_sets(mesh: Mesh, muscle: VolumeMesh) -> Mesh:
    """Node and face sets by the surface that each boundary face lies on; skin nodes follow the muscle's."""
    faces = boundary_faces(mesh)
    on_plane = (mesh.points[faces, 2] == 0.0).all(axis=1)
    on_skin = (faces >= len(muscle.points)).all(axis=1) & ~on_plane
    on_bone = _same_faces(faces, muscle.triangles[muscle.triangle_refs == BONE], len(mesh.points)) & ~on_plane
    rest = ~(on_plane | on_skin | on_bone)
    sets = {"fixed_bone": on_bone, "fixed_proximal": on_plane}
    if rest.any():
        sets["fixed_truncation"] = rest
    node_sets = {name: np.unique(faces[chosen]) for name, chosen in sets.items()}
    return replace(mesh, node_sets=node_sets, face_sets={"skin": faces[on_skin]})


def _curved_target(mesh: Mesh, fields: LimbFields) -> Array:
    """Where the mid-edge nodes of skin, interface and bone would lie on the smooth surfaces."""
    target = mesh.points.copy()
    free = np.where(mesh.points[:, 2] == 0.0, 0.0, 1.0)
    for nodes, level in _smooth_mid_nodes(mesh, fields):
        target[nodes] = projected(level, target[nodes], free[nodes])
    return target


def _smooth_mid_nodes(mesh: Mesh, fields: LimbFields) -> list[tuple[Ints, Callable[[Array], Level]]]:
    corners = mesh.cells[:, :4].max() + 1
    faces = boundary_faces(mesh)
    on_plane = (mesh.points[faces[:, :3], 2] == 0.0).all(axis=1)
    bone = faces[~on_plane & np.isin(faces[:, :3], mesh.node_sets["fixed_bone"]).all(axis=1)]
    return [
        (_mid_nodes(mesh.face_sets["skin"], corners), fields.depth),
        (_mid_nodes(_interface_faces(mesh), corners), fields.layer),
        (_mid_nodes(bone, corners), fields.void),
    ]


def _mid_nodes(faces: Ints, corners: int) -> Ints:
    nodes = np.unique(faces)
    return nodes[nodes >= corners]


def _interface_faces(mesh: Mesh) -> Ints:
    """Faces between muscle and skin, outward from the muscle."""
    muscle = mesh.regions == REGIONS.index("muscle")
    skin_nodes = np.unique(mesh.corners[~muscle])
    part = replace(mesh, cells=mesh.cells[muscle], regions=mesh.regions[muscle], node_sets={}, face_sets={})
    faces = boundary_faces(part)
    outer = boundary_faces(mesh)
    return faces[
        np.isin(faces[:, :3], skin_nodes).all(axis=1)
        & ~_same_faces(faces[:, :3], outer[:, :3], len(mesh.points))
    ]


def _report(mesh: Mesh, base: BaseMesh, settings: MeshSettings, seconds: float) -> MeshReport:
    found = quality(mesh)
    mean, std = _layer_thickness(mesh)
    whole = settings.local_radius_mm is None
    volume_error = found.volume_mm3 / base.enclosed_mm3 - 1.0 if whole else None
    shape = {name: int((mesh.regions == i).sum()) for i, name in enumerate(mesh.region_names)}
    return MeshReport(
        nodes=len(mesh.points),
        cells=len(mesh.cells),
        region_cells=shape,
        min_dihedral_deg=found.min_dihedral_deg,
        dihedral_percentiles_deg=found.dihedral_percentiles_deg,
        min_scaled_jacobian=found.min_scaled_jacobian,
        volume_mm3=found.volume_mm3,
        region_volumes_mm3=found.region_volumes_mm3,
        volume_error=volume_error,
        layer_mean_mm=mean,
        layer_std_mm=std,
        trimmed_bone=base.trimmed,
        seconds=seconds,
        engine=settings.engine,
        warnings=_warnings(found.min_dihedral_deg, volume_error or 0.0),
    )


def _warnings(dihedral: float, volume_error: float) -> tuple[str, ...]:
    found = []
    if dihedral < GOOD_DIHEDRAL_DEG:
        found.append(f"smallest dihedral angle {dihedral:.1f} degrees; choose smaller edges")
    if abs(volume_error) > 0.01:
        found.append(f"volume differs by {100 * volume_error:.1f} % from the surfaces'; choose smaller edges")
    return tuple(found)


def _layer_thickness(mesh: Mesh) -> tuple[float, float]:
    """Mean and standard deviation of the distance from the meshed interface to the meshed skin, mm."""
    skin, interface = _facets(mesh.face_sets["skin"]), _facets(_interface_faces(mesh))
    samples = mesh.points[interface].mean(axis=1)
    squared = igl.point_mesh_squared_distance(samples, mesh.points, skin)[0]
    distance = np.sqrt(squared)
    return float(distance.mean()), float(distance.std())


def _facets(faces: Ints) -> Ints:
    """Flat triangles of 3-node faces (themselves) or 6-node faces (four each)."""
    if faces.shape[1] == 3:
        return faces
    return faces[:, [0, 3, 5, 3, 1, 4, 5, 4, 2, 3, 4, 5]].reshape(-1, 3)


def enclosed_volume(anatomy: Anatomy, fields: LimbFields, trimmed: Mapping[str, TrimmedBone]) -> float:
    """Volume (mm3) below the cut that the skin encloses, less the bones as trimmed."""
    parts = [
        Surface(fields.frame.to_limb(part.points), part.faces)
        for part in (anatomy.skin, *anatomy.bones.values())
    ]
    skin, *bones = [volume_below_cut(part) for part in parts]
    return skin - sum(bones) + sum(part.volume_mm3 for part in trimmed.values())


def volume_below_cut(surface: Surface) -> float:
    """Volume (mm3) of a closed surface below z = 0, by the divergence theorem with (0, 0, min(z, 0))."""
    corners = surface.points[surface.faces]
    normal_z = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2.0
    low, middle, high = np.sort(corners[..., 2], axis=1).T
    return float(normal_z @ _mean_negative_part(low, middle, high))


def _mean_negative_part(low: Array, middle: Array, high: Array) -> Array:
    """Mean of min(z, 0) over triangles whose corners have sorted heights low, middle, high."""
    with np.errstate(divide="ignore", invalid="ignore"):
        tip_below = low**3 / ((low - middle) * (low - high)) / 3.0
        tip_above = high**3 / ((high - low) * (high - middle)) / 3.0
    mean = (low + middle + high) / 3.0
    return np.select([low >= 0, high <= 0, middle >= 0], [0.0 * mean, mean, tip_below], mean - tip_above)
