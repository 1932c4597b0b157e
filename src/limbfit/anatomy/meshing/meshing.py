"""Per-site tetrahedral meshes of a limb: skin layer, muscle and what is in it, bones as voids, graded.

The recipe
----------
1. A base mesh of the muscle, once per anatomy: a tetrahedral grid under the proximal cut plane, finer at thin
   bones and regions, cut along the layer (level set of depth at the skin's thickness), along the bones, and
   along the regions inside the core, whose both sides are kept.
2. Per site, a mesher adapts the base to the site's size field; it keeps the faces between regions.
3. Nodes of layer, bones and regions are put on their smooth surfaces; the skin layer is extruded from the
   interface to the skin, each node to its nearest skin point: its thickness is uniform by construction.
4. Quadratic elements: promoted straight-sided, then curved to the smooth surfaces where they stay sound;
   faces that are too coarse to follow a bone are put on it in the mean (`improving`).
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from ...arrays import Array, Mask
from ...errors import MeshingError, ProblemError
from ...mesh import Mesh, boundary_faces, check, node_jacobians, to_tet10
from ...results.limb import BoneLoss, MeshMeasures
from ..surfaces.surfaces import Anatomy
from . import background, improving, regions
from .background import BONE, LAYER, PLANE, REGION, TetGrid, compute_volumes, project_safely, project_to_level
from .engines import ENGINES, MesherError, VolumeMesh, VolumeTask
from .extrusion import build_core_mesh, extrude_layers
from .layers import BonePolicy, LayerSpec, LimbFields, build_limb_fields, evaluate_distance
from .meshreport import GOOD_DIHEDRAL_DEG, compute_enclosed_volume, measure_mesh

SURFACES = (PLANE, LAYER, BONE)
HAUSDORFF_RADIUS_MM = 250.0  # MMG takes edges of sqrt(9/2 hausdorff R) on a surface of radius R
LAYER_RATIO = 5.0  # greatest edge over thickness of the skin layer: about 13 degrees in an even prism
SHEET_RATIO = 3.0  # greatest edge over thickness where muscle is a thin sheet over bone
REGION_RATIO = 0.6  # greatest edge over thickness in a region inside the core
MAX_STRAY_SHARE = 0.5  # of the layers' thickness: a node of their inner face so far outside it is put back
NEAR_RADII = 2.0  # of the fine zone: within them elements have to be good
PROBE_SPACINGS = 1.4  # of the spacing: how far below a bone's surface the depth is measured
THIN_DEPTH_SHARE = 0.4  # of that way: a lesser depth is that below the bone's far side, two spacings off
MAX_HALVINGS = 2  # of the grid: tips and edges of a bone are thin at every spacing
DEPTH_RATIO = 1.5  # the fine zone is an ellipsoid, shallower than wide by this ratio


@dataclass(frozen=True)
class MeshSettings:
    """How a site is meshed; lengths in mm.

    The edge length is ``edge_near_mm`` within ``near_radius_mm`` of the site and grows from there by
    ``growth`` mm per mm up to ``edge_far_mm``. ``curved`` puts mid-edge nodes on the smooth surfaces.
    ``flatness`` is how much flatter than by default elements may be away from the site: fewer nodes, smaller
    angles.
    """

    element: Literal["tet4", "tet10"] = "tet10"
    edge_near_mm: float = 3.5
    edge_far_mm: float = 12.0
    near_radius_mm: float = 16.0
    growth: float = 0.35
    layers: tuple[LayerSpec, ...] = (LayerSpec("skin", 3.0),)
    core: str = "muscle"
    bone_policy: BonePolicy = "trim-bone"
    bone_clearance_mm: float = 1.5
    time_limit_s: float = 600.0
    curved: bool = True
    flatness: float = 1.0
    engine: str = "mmg"

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

    ``size_limit`` (n,) is the edge length that layer, bones and regions allow at the grid's points, mm.
    ``regions_mm3`` is the volume of each region inside the core.
    """

    fields: LimbFields
    grid: TetGrid
    size_limit: Array
    trimmed: Mapping[str, BoneLoss]
    enclosed_mm3: float
    regions_mm3: Mapping[str, float]


def build_base_mesh(anatomy: Anatomy, settings: MeshSettings, fat_depth_mm: Array | None = None) -> BaseMesh:
    """The part of meshing that does not depend on the site.

    Raises `SurfaceError` when the skin does not reach the cut plane, the fat's depth is needed and not given,
    or a region cannot be meshed; `MeshingError` when nothing is left between layer, bones and cut.

    Parameters
    ----------
    anatomy, settings : as for :func:`mesh_site`.
    fat_depth_mm : (n,) depth of the fat's inner face at the vertices of the anatomy's skin, for a layer
        without a thickness of its own (:func:`limbfit.anatomy.surfaces.thickness.measure_fat_depth`).
    """
    fields = build_limb_fields(
        anatomy, settings.layers, settings.bone_clearance_mm, settings.bone_policy, fat_depth_mm
    )
    spacing = settings.base_spacing_mm
    low = fields.skin.points.min(axis=0) - spacing
    high = fields.skin.points.max(axis=0) + spacing
    regions.check_regions(fields, settings.edge_near_mm)
    grid = background.build_box_grid(low, np.array([*high[:2], 0.0]), spacing)
    grid = refine_at_bones(regions.refine_at_regions(grid, fields), fields)
    for level, bit in ((fields.layer, LAYER), (fields.void, BONE)):
        grid, positive = background.cut(grid, level, bit, fields.floor_range_mm)
        grid = grid.select(positive)
        if not len(grid.tets):
            raise MeshingError(f"no {settings.core} is left under the layers; choose thinner layers")
    grid = regions.cut_at_regions(grid, fields)
    trimmed = {name: fields.measure_trimmed_bone(bone) for name, bone in fields.bones.items()}
    limit = compute_size_limit(fields, grid, settings)
    enclosed = compute_enclosed_volume(anatomy, fields, trimmed)
    return BaseMesh(fields, grid, limit, trimmed, enclosed, regions.compute_region_volumes(fields))


def refine_at_bones(grid: TetGrid, fields: LimbFields) -> TetGrid:
    """A box's grid, halved about bone that is thinner than two of its cells.

    A grid is cut only where an edge has one end in a bone and one outside. Of a round bone as thin as its
    spacing that keeps a quarter, in beads; of one twice as thick nine tenths.
    """
    for halving in range(MAX_HALVINGS):
        spacing = grid.spacing / 2**halving
        thin = find_thin_bone(fields, spacing)
        if not len(thin):
            break
        grid = background.refine_grid(
            grid, partial(_has_neighbour, KDTree(thin), background.LONGEST_EDGE * spacing), 0.5 * spacing
        )
    return grid


def find_thin_bone(fields: LimbFields, spacing: float) -> Array:
    """Vertices (k, 3) of bones, in the limb frame, where they are thinner than about two spacings (mm)."""
    found = [np.zeros((0, 3))]
    for bone in fields.bones.values():
        probe = PROBE_SPACINGS * spacing
        depth = -evaluate_distance(bone, bone.points - probe * bone.vertex_normals)[0]
        below = bone.points[:, 2] < 0.0
        found.append(bone.points[below & (depth < THIN_DEPTH_SHARE * PROBE_SPACINGS * spacing)])
    return np.vstack(found)


def _has_neighbour(places: KDTree, distance_mm: float, points: Array) -> Mask:
    return np.isfinite(places.query(points, distance_upper_bound=distance_mm)[0])


def mesh_site(
    anatomy: Anatomy, position: Array, axis: Array, settings: MeshSettings, base: BaseMesh | None = None
) -> tuple[Mesh, MeshMeasures]:
    """A conforming mesh graded about an indentation site.

    Raises `MeshingError` when the mesher fails, or its mesh has inverted elements that cannot be mended:
    where and why.

    Parameters
    ----------
    anatomy : closed skin and bones, LPS mm.
    position : the site (3,) on the skin, LPS mm.
    axis : unit vector (3,) into the limb.
    settings : edge lengths, layers, element.
    base : of the same anatomy and settings, from :func:`build_base_mesh`; made here when not given.

    Returns
    -------
    mesh : regions named as the layers, the anatomy's regions and the core; node sets ``fixed_bone`` (on
        bones) and ``fixed_proximal`` (on the cut plane); face set ``skin`` (outward, without the cut plane).
    measures : its quality and what was trimmed.
    """
    base = base or build_base_mesh(anatomy, settings)
    frame = base.fields.frame
    site, inward = frame.to_limb(np.asarray(position)), frame.rotation @ np.asarray(axis)
    size = compute_site_size(base.grid.points, base.size_limit, site, inward, settings)
    return _mesh_base(base, size, settings, (site, NEAR_RADII * settings.near_radius_mm))


def mesh_limb(
    anatomy: Anatomy, settings: MeshSettings, fine_to_mm: float, fat_depth_mm: Array | None = None
) -> tuple[Mesh, MeshMeasures]:
    """A mesh of the whole limb, as for :func:`mesh_site`, that is fine all around it.

    Edges are of ``edge_near_mm`` under the layers and grow with the depth below them, and nearer to the
    proximal cut than ``fine_to_mm``.
    """
    base = build_base_mesh(anatomy, settings, fat_depth_mm)
    points = base.grid.points
    beyond = np.maximum(points[:, 2] + fine_to_mm, 0.0) + np.maximum(base.fields.layer(points)[0], 0.0)
    return _mesh_base(base, _grade_size(beyond, base.size_limit, settings), settings)


def _mesh_base(
    base: BaseMesh, size: Array, settings: MeshSettings, near: tuple[Array, float] | None = None
) -> tuple[Mesh, MeshMeasures]:
    """The mesh of a base in patient space, graded by the edge length (n,) at its grid's points; ``near``: as
    for `measure_mesh`."""
    start = time.perf_counter()
    fields = base.fields
    task = _build_task(base.grid, size, settings)
    try:
        core = ENGINES[settings.engine](task, settings.time_limit_s)
    except MesherError as error:  # as a rule where its input is flattest
        where = improving.describe_narrowest_gap(task.points, task.tets, fields)
        raise MeshingError(f"{error}; its input is flattest {where}") from None
    core = _snap_nodes(core, fields)
    names = (*(layer.name for layer in settings.layers), *fields.regions, settings.core)
    mesh, stack = extrude_layers(core, fields, names)
    mesh = improving.smooth_elements(mesh, fields, stack)
    mesh, repairs = improving.repair_mesh(mesh, fields, stack)
    if settings.element == "tet10" and not improving.find_inverted_cells(mesh).any():
        mesh = to_tet10(mesh)
        if settings.curved:
            straight = node_jacobians(mesh).min(axis=1)
            target = improving.curve_diagonals(mesh, improving.compute_curved_target(mesh, fields), stack)
            mesh = improving.curve_mesh(mesh, target, straight)
            mesh = improving.balance_bone_faces(mesh, fields, straight)
    _check_usable(mesh, fields)
    measures = measure_mesh(
        mesh,
        fields,
        base.trimmed,
        base.enclosed_mm3,
        base.regions_mm3,
        near,
        seconds=time.perf_counter() - start,
        engine=settings.engine,
        element=settings.element,
        repairs=repairs,
    )
    return mesh.with_points(fields.frame.to_patient(mesh.points)), measures


def _check_usable(mesh: Mesh, fields: LimbFields) -> None:
    if improving.find_inverted_cells(mesh).any():
        where = improving.describe_unrepaired(mesh, fields)
        raise MeshingError(f"{where}; smooth the surface there, or choose smaller edges")
    try:
        check(mesh)
    except ProblemError as error:
        raise MeshingError(f"the mesh cannot be used: {error.what}; choose other edges") from None


def compute_site_size(points: Array, limit: Array, site: Array, axis: Array, settings: MeshSettings) -> Array:
    """Wanted edge length (n,) at points (n, 3), at most ``limit`` (n,); everything in the limb frame."""
    offset = points - site
    axial = offset @ axis
    lateral = np.linalg.norm(offset - axial[:, None] * axis, axis=1)
    distance = np.hypot(lateral, DEPTH_RATIO * axial)
    return _grade_size(np.maximum(distance - settings.near_radius_mm, 0.0), limit, settings)


def _grade_size(beyond: Array, limit: Array, settings: MeshSettings) -> Array:
    """Edge length (n,) at distances (n,) beyond where it is shortest, at most ``limit`` (n,)."""
    size = np.minimum(settings.edge_near_mm + settings.growth * beyond, settings.edge_far_mm)
    return np.minimum(size, limit)


def compute_size_limit(fields: LimbFields, grid: TetGrid, settings: MeshSettings) -> Array:
    """Edge length (n,) at which layers, sheets of core over bone and regions keep their shape."""

    def evaluate(level: background.Field) -> Array:
        far, slack = settings.edge_far_mm, fields.floor_range_mm
        return background.compute_in_band(level, grid.points, far, grid.spacing, slack)

    under_layers = np.maximum(evaluate(fields.layer), 0.0)
    sheet = np.abs(evaluate(fields.void)) + under_layers
    smallest = min(settings.edge_near_mm, settings.bone_clearance_mm)
    over_bone = np.maximum(SHEET_RATIO * settings.flatness * sheet, smallest)
    depths = fields.layer_depths(grid.points)
    thinnest = np.diff(depths, axis=0, prepend=0.0).min(axis=0)
    limit = np.minimum(LAYER_RATIO * settings.flatness * thinnest + under_layers, over_bone)
    for number, surface in enumerate(fields.regions.values()):
        away = evaluate(regions.build_region_level(fields, number))
        edge = max(REGION_RATIO * regions.measure_thickness(surface), settings.edge_near_mm)
        limit = np.minimum(limit, edge + np.maximum(away, 0.0))
    return limit


def _build_task(grid: TetGrid, size: Array, settings: MeshSettings) -> VolumeTask:
    triangles = boundary_faces(build_core_mesh(grid.points, grid.tets))
    common = np.bitwise_and.reduce(grid.mask[triangles], axis=1)
    surfaces = np.select([common & bit > 0 for bit in SURFACES], SURFACES, BONE)
    count = int(grid.regions.max())
    numbers = regions.mesh_numbers(grid.regions, 0, count)
    inner = regions.find_interfaces(
        Mesh(grid.points, grid.tets, "tet4", numbers, tuple(map(str, range(count + 1)))), 0
    )
    refs = [np.full(len(faces), REGION << number) for number, faces in enumerate(inner)]
    return VolumeTask(
        grid.points,
        grid.tets,
        grid.regions,
        np.vstack([triangles, *inner]),
        np.concatenate([surfaces, *refs]),
        size,
        settings.hausdorff_mm,
    )


def _snap_nodes(core: VolumeMesh, fields: LimbFields) -> VolumeMesh:
    """Nodes of surfaces put on cut plane, regions, layer and bone as far as their elements allow."""
    in_plane = _find_nodes_on(core, PLANE)
    target = core.points.copy()
    target[in_plane, 2] = 0.0
    free = np.where(in_plane, 0.0, 1.0)
    numbers = range(len(fields.regions))
    inner = [(REGION << number, regions.build_region_level(fields, number)) for number in numbers]
    for surface, level in (*inner, (BONE, fields.void), (LAYER, fields.layer)):
        nodes = np.flatnonzero(_find_nodes_on(core, surface))
        target[nodes] = project_to_level(level, target[nodes], free[nodes])
    points = project_safely(core.points, target, core.tets, GOOD_DIHEDRAL_DEG)
    points[in_plane, 2] = 0.0
    return replace(core, points=_recover_interface(points, target, core, fields))


def _recover_interface(points: Array, target: Array, core: VolumeMesh, fields: LimbFields) -> Array:
    """Points (n, 3) with nodes that a mesher left far outside the layers' inner face put on it all the same.

    Bending its triangles over a ridge, MMG may put a node almost on the skin; inner nodes make room for it.
    """
    layer = np.flatnonzero(_find_nodes_on(core, LAYER))
    stray = layer[fields.layer(points[layer])[0] < -MAX_STRAY_SHARE * fields.floor(points[layer])]
    if not len(stray):
        return points
    inner = np.ones(len(points), dtype=bool)
    inner[core.triangles] = False
    moved = points.copy()
    moved[stray] = target[stray]
    moved = improving.untangle_cells(moved, core.tets, np.zeros_like(moved), inner)
    return moved if (compute_volumes(moved, core.tets) > 0.0).all() else points


def _find_nodes_on(core: VolumeMesh, surface: int) -> Mask:
    chosen = np.zeros(len(core.points), dtype=bool)
    chosen[core.triangles[core.triangle_refs == surface]] = True
    return chosen
