"""The layers of skin and adipose tissue extruded from the core, sets of the whole mesh, curved surfaces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...mesh import Mesh, boundary_faces
from .background import BONE, LAYER
from .columns import Columns, build_columns, choose_even_steps
from .engines import VolumeMesh
from .layers import Level, LimbFields
from .projection import project_to_level
from .regions import build_region_level, find_interfaces, find_same_faces, mesh_numbers

Ints = NDArray[np.int64]

RIM_LAYERS = 3.0  # depth below the cut plane, in thicknesses, over which the extrusion turns sideways
MOST_STEPS = 8  # elements across one layer


def build_core_mesh(points: Array, tets: Ints) -> Mesh:
    """The tetrahedra under the layers as a mesh that tells no regions."""
    return Mesh(points, tets, "tet4", np.zeros(len(tets), np.int64), ("core",))


def extrude_layers(core: VolumeMesh, fields: LimbFields, regions: tuple[str, ...]) -> tuple[Mesh, Columns]:
    """The tet4 mesh of core and extruded layers with its sets, and the columns of the layers' nodes.

    ``regions`` names the layers, outermost first, the regions inside the core, and the core.
    """
    count = len(core.points)
    faces = boundary_faces(build_core_mesh(core.points, core.tets))
    interface = faces[find_same_faces(faces, core.triangles[core.triangle_refs == LAYER], count)]
    base = np.unique(interface)
    low = core.points[base]
    # Near the cut plane nodes go out sideways, or those below it could overtake those on it.
    high = project_to_level(fields.depth, low, np.minimum(-low[:, 2] / (RIM_LAYERS * fields.floor(low)), 1.0))
    depths = fields.layer_depths(high)
    across = _choose_steps(np.searchsorted(base, interface), low, depths)
    stack = build_columns(base, across, count)
    shares = (depths[-1] - np.vstack([depths[::-1], np.zeros(len(base))])) / depths[-1]
    tets, layer = stack.tets(interface)
    innermost = len(fields.depths) - 1
    numbers = mesh_numbers(core.regions, len(fields.depths), len(fields.regions))
    mesh = Mesh(
        points=np.vstack([core.points, stack.placed(low, high, shares)]),
        cells=np.vstack([tets, core.tets]),
        cell_type="tet4",
        regions=np.concatenate([innermost - layer, numbers]),
        region_names=regions,
    )
    return _mark_sets(mesh, core, stack), stack


def _choose_steps(interface: Ints, low: Array, depths: Array) -> Ints:
    """Elements (layers, b) across each layer in each column, innermost layer first."""
    ends = np.sort(np.vstack([interface[:, [0, 1]], interface[:, [1, 2]], interface[:, [2, 0]]]), axis=1)
    edges = np.unique(ends, axis=0)
    length = np.linalg.norm(low[edges[:, 0]] - low[edges[:, 1]], axis=1)
    degree = np.bincount(edges.ravel(), minlength=len(low))
    mean = np.bincount(edges.ravel(), np.repeat(length, 2), minlength=len(low)) / degree
    thickness = np.diff(np.vstack([np.zeros(len(low)), depths]), axis=0)[::-1]
    return np.array([choose_even_steps(part, mean, edges, MOST_STEPS) for part in thickness])


def _mark_sets(mesh: Mesh, core: VolumeMesh, stack: Columns) -> Mesh:
    """Node and face sets by the surface that each boundary face lies on."""
    faces = boundary_faces(mesh)
    on_plane = (mesh.points[faces, 2] == 0.0).all(axis=1)
    outermost = (faces >= stack.top[0]) & (faces <= stack.top[-1])
    on_skin = outermost.all(axis=1) & ~on_plane
    on_bone = find_same_faces(faces, core.triangles[core.triangle_refs == BONE], len(mesh.points)) & ~on_plane
    sets = {"fixed_bone": on_bone, "fixed_proximal": on_plane}
    node_sets = {name: np.unique(faces[chosen]) for name, chosen in sets.items()}
    return replace(mesh, node_sets=node_sets, face_sets={"skin": faces[on_skin]})


def compute_curved_target(mesh: Mesh, fields: LimbFields) -> Array:
    """Where the mid-edge nodes of skin, layers' inner face, bone and regions would lie on smooth surfaces."""
    target = mesh.points.copy()
    free = np.where(mesh.points[:, 2] == 0.0, 0.0, 1.0)
    for nodes, level in _smooth_mid_nodes(mesh, fields):
        target[nodes] = project_to_level(level, target[nodes], free[nodes])
    return target


def _smooth_mid_nodes(mesh: Mesh, fields: LimbFields) -> list[tuple[Ints, Callable[[Array], Level]]]:
    corners, layers = mesh.cells[:, :4].max() + 1, len(fields.depths)
    regions = [
        (_find_mid_nodes(found, corners), build_region_level(fields, number))
        for number, found in enumerate(find_interfaces(mesh, layers))
    ]
    return [
        *regions,
        (_find_mid_nodes(mesh.face_sets["skin"], corners), fields.depth),
        (_find_mid_nodes(find_inner_faces(mesh, layers - 1), corners), fields.layer),
        (_find_mid_nodes(find_bone_faces(mesh), corners), fields.void),
    ]


def _find_mid_nodes(faces: Ints, corners: int) -> Ints:
    nodes = np.unique(faces)
    return nodes[nodes >= corners]


def find_bone_faces(mesh: Mesh) -> Ints:
    """Outward faces on bone of a mesh in the limb frame."""
    faces = boundary_faces(mesh)
    on_plane = (mesh.points[faces[:, :3], 2] == 0.0).all(axis=1)
    return faces[~on_plane & np.isin(faces[:, :3], mesh.node_sets["fixed_bone"]).all(axis=1)]


def find_inner_faces(mesh: Mesh, layer: int) -> Ints:
    """Faces between a layer (counted from the skin) and what lies under it, outward from the latter."""
    under = mesh.regions > layer
    above = np.unique(mesh.corners[mesh.regions == layer])
    part = replace(mesh, cells=mesh.cells[under], regions=mesh.regions[under], node_sets={}, face_sets={})
    faces = boundary_faces(part)
    outer = boundary_faces(mesh)
    return faces[
        np.isin(faces[:, :3], above).all(axis=1)
        & ~find_same_faces(faces[:, :3], outer[:, :3], len(mesh.points))
    ]
