"""The layers of skin and adipose tissue extruded from the core as columns of nodes, and sets of the mesh.

The columns are filled with tetrahedra that conform whatever the columns' steps.

Vocabulary
----------
column   the nodes above one base node: at each layer's outer face, and between where the layer is thick.
step     from one node of a column to the next.
height   of a node above the base, counted in layers: 1.5 is halfway through the second layer from below.

Between three neighbouring columns the front rises one step at a time and leaves a tetrahedron behind each.
Which column is next follows from one order of all nodes, so two prisms that share a side split it alike.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array, Indices
from ...mesh import Mesh, boundary_faces
from ..surfaces.triangles import find_half_edges
from .background import BONE, LAYER, project_to_level
from .engines import VolumeMesh
from .layers import LimbFields
from .regions import find_same_faces, mesh_numbers

RIM_LAYERS = 3.0  # depth below the cut plane, in thicknesses, over which the extrusion turns sideways
MAX_STEPS = 8  # elements across one layer
MAX_ASPECT_RATIO = 1.3  # step over edge length


def build_core_mesh(points: Array, tets: Indices) -> Mesh:
    """The tetrahedra under the layers as a mesh of one region."""
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
    tets, layer = stack.build_tets(interface)
    innermost = len(fields.depths) - 1
    numbers = mesh_numbers(core.regions, len(fields.depths), len(fields.regions))
    mesh = Mesh(
        points=np.vstack([core.points, stack.place_nodes(low, high, shares)]),
        cells=np.vstack([tets, core.tets]),
        cell_type="tet4",
        regions=np.concatenate([innermost - layer, numbers]),
        region_names=regions,
    )
    return _mark_sets(mesh, core, stack), stack


def _choose_steps(interface: Indices, low: Array, depths: Array) -> Indices:
    """Elements (layers, b) across each layer in each column, innermost layer first."""
    edges = np.unique(np.sort(find_half_edges(interface), axis=1), axis=0)
    length = np.linalg.norm(low[edges[:, 0]] - low[edges[:, 1]], axis=1)
    degree = np.bincount(edges.ravel(), minlength=len(low))
    mean = np.bincount(edges.ravel(), np.repeat(length, 2), minlength=len(low)) / degree
    thickness = np.diff(np.vstack([np.zeros(len(low)), depths]), axis=0)[::-1]
    return np.array([choose_even_steps(part, mean, edges, MAX_STEPS) for part in thickness])


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


def find_bone_faces(mesh: Mesh) -> Indices:
    """Outward faces on bone of a mesh in the limb frame."""
    faces = boundary_faces(mesh)
    on_plane = (mesh.points[faces[:, :3], 2] == 0.0).all(axis=1)
    return faces[~on_plane & np.isin(faces[:, :3], mesh.node_sets["fixed_bone"]).all(axis=1)]


def find_inner_faces(mesh: Mesh, layer: int) -> Indices:
    """Faces between a layer (counted from the skin) and what lies under it, outward from the latter."""
    above = np.unique(mesh.corners[mesh.regions == layer])
    faces = boundary_faces(mesh, mesh.regions > layer)
    outer = boundary_faces(mesh)
    return faces[
        np.isin(faces[:, :3], above).all(axis=1)
        & ~find_same_faces(faces[:, :3], outer[:, :3], len(mesh.points))
    ]


@dataclass(frozen=True)
class Columns:
    """Nodes over base nodes.

    Attributes
    ----------
    base : (b,) numbers of the base nodes.
    top : (b,) numbers of the columns' outermost nodes.
    owner : (k,) index into ``base`` of each new node; the outermost ones come first, in order of ``base``.
    height : (k,) of the new nodes.
    steps : (layers, b) of each layer in each column.
    """

    base: Indices
    top: Indices
    owner: Indices
    height: Array
    steps: Indices

    def place_nodes(self, low: Array, high: Array, floors: Array) -> Array:
        """Points (k, 3) of the new nodes on the lines from ``low`` to ``high`` (b, 3).

        ``floors`` (layers + 1, b) are the distances of the layers' faces from the base, zero first, as
        shares of the column.
        """
        layer = np.minimum(self.height.astype(np.int64), len(self.steps) - 1)
        below, above = floors[layer, self.owner], floors[layer + 1, self.owner]
        share = below + (self.height - layer) * (above - below)
        return low[self.owner] + share[:, None] * (high - low)[self.owner]

    def build_tets(self, triangles: Indices) -> tuple[Indices, Indices]:
        """Tetrahedra (m, 4) over outward triangles (t, 3) of base nodes, and the layer (m,) of each."""
        nodes, height = self._stack_nodes()
        column = np.searchsorted(self.base, triangles)
        total = self.steps.sum(axis=0)[column]
        at = np.zeros_like(column)
        done, layers = [], []
        while True:
            last = at == total
            going = ~last.all(axis=1)
            if not going.any():
                break
            column, total, at, last = column[going], total[going], at[going], last[going]
            following = np.where(last, at, at + 1)
            rank = np.where(last, np.inf, height[column, following])
            # Of nodes as high as each other the one over the greatest base node comes first.
            lowest = rank == rank.min(axis=1, keepdims=True)
            side = np.where(lowest, column, -1).argmax(axis=1)
            row = np.arange(len(column))
            fresh = nodes[column[row, side], following[row, side]]
            done.append(np.column_stack([nodes[column, at], fresh]))
            layers.append(np.ceil(rank[row, side]).astype(np.int64) - 1)
            at[row, side] += 1
        return np.concatenate(done), np.concatenate(layers)

    def _stack_nodes(self) -> tuple[Indices, Array]:
        """Node numbers and heights (b, most steps + 1) of each column from its base up."""
        total = self.steps.sum(axis=0)
        nodes = np.full((len(self.base), total.max() + 1), -1, dtype=np.int64)
        height = np.full(nodes.shape, np.inf)
        nodes[:, 0], height[:, 0] = self.base, 0.0
        order = np.lexsort([self.height, self.owner])
        owner = self.owner[order]
        place = np.arange(len(order)) - np.searchsorted(owner, owner) + 1
        nodes[owner, place] = self.top[0] + order
        height[owner, place] = self.height[order]
        return nodes, height


def build_columns(base: Indices, steps: Indices, first: int) -> Columns:
    """Columns of ``steps`` (layers, b) over sorted base nodes (b,); new nodes are numbered from ``first``."""
    count, layers = len(base), len(steps)
    owner, height = [np.arange(count)], [np.full(count, float(layers))]
    for layer, number in enumerate(steps):
        for step in range(1, int(number.max()) + 1):
            chosen = number >= step
            if layer == layers - 1:
                chosen &= number > step
            owner.append(np.flatnonzero(chosen))
            height.append(layer + step / number[chosen])
    return Columns(
        base, first + np.arange(count), np.concatenate(owner), np.concatenate(height), steps.astype(np.int64)
    )


def choose_even_steps(thickness: Array, edge: Array, edges: Indices, most: int) -> Indices:
    """Steps (b,) with which a layer (b,) mm thick has no elements much taller than their edges (b,) are long.

    Neighbours along ``edges`` (e, 2) differ by one at most.
    """
    steps = np.clip(np.ceil(thickness / (MAX_ASPECT_RATIO * edge)), 1, most).astype(np.int64)
    for _ in range(most):
        allowed = np.full(len(steps), most, dtype=np.int64)
        np.minimum.at(allowed, edges[:, 0], steps[edges[:, 1]] + 1)
        np.minimum.at(allowed, edges[:, 1], steps[edges[:, 0]] + 1)
        steps = np.minimum(steps, allowed)
    return steps
