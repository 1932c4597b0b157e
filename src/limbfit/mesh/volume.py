"""Volume meshes and their quality; a mesh is made of arrays, or of another library's mesh.

Vocabulary
----------
points   (n, 3) float64, millimetres, LPS.
cells    (m, k) int64, in VTK order: tet4 (k=4), tet10 (k=10, mid-edge nodes 01 12 20 03 13 23), hex8 (k=8).
regions  (m,) int64, index of each cell into ``region_names``.
node_sets / face_sets  named integer arrays: node indices, and outward-oriented boundary faces
         (3, 6 or 4 nodes each, in VTK order).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from .cells import CELLS, TET10_EDGES, TET_FACES, TRI6_EDGES, CellType

_VTK_NAMES = {cell.vtk: cell.name for cell in CELLS.values()} | {
    1: "", 2: "", 3: "", 4: "", 5: "", 6: "", 7: "", 8: "", 9: "", 21: "", 22: "", 23: "", 28: "",
    11: "voxels", 13: "wedges", 14: "pyramids", 25: "quadratic hexahedra", 29: "quadratic hexahedra",
}  # fmt: skip
_MESHIO_NAMES = {cell.meshio: cell.name for cell in CELLS.values()} | dict.fromkeys(
    ("vertex", "line", "line3", "triangle", "triangle6", "quad", "quad8", "quad9"), ""
)
_MESHIO_REGIONS = ("gmsh:physical", "medit:ref", "region")


@dataclass(frozen=True, repr=False)
class Mesh:
    """An immutable volume mesh; see the module docstring for the arrays."""

    points: Array
    cells: Indices
    cell_type: str
    regions: Indices
    region_names: tuple[str, ...]
    node_sets: Mapping[str, Indices] = field(default_factory=dict)
    face_sets: Mapping[str, Indices] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.cell_type not in CELLS:
            raise ProblemError(f"unknown cell type {self.cell_type!r}; use one of {sorted(CELLS)}")
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ProblemError(f"mesh points have shape {self.points.shape}, not (n, 3)")
        if self.cells.ndim != 2 or self.cells.shape[1] != len(self.kind.nodes):
            raise ProblemError(f"{self.cell_type} cells have shape {self.cells.shape}")
        if len(self.regions) != len(self.cells):
            raise ProblemError(f"{len(self.regions)} region indices for {len(self.cells)} cells")

    def __repr__(self) -> str:
        numbers = np.bincount(self.regions, minlength=len(self.region_names))
        tissues = ", ".join(f"{name} {count}" for name, count in zip(self.region_names, numbers))
        return (
            f"<Mesh: {self.cell_type} ({tissues}), {len(self.points)} nodes, {_format_extent(self.points)}>"
        )

    @property
    def kind(self) -> CellType:
        """What is known of its cells."""
        return CELLS[self.cell_type]

    @property
    def corners(self) -> Indices:
        """Corner nodes of each cell: (m, 4) for tetrahedra, (m, 8) for hexahedra."""
        return self.cells[:, : self.kind.corners]

    @property
    def held(self) -> Indices:
        """Nodes (k,) that do not move: those of all sets whose names begin with ``fixed_``."""
        sets = [nodes for name, nodes in self.node_sets.items() if name.startswith("fixed_")]
        return np.unique(np.concatenate(sets)) if sets else np.empty(0, dtype=np.int64)

    def with_points(self, points: Array) -> Mesh:
        return replace(self, points=points)

    @classmethod
    def from_arrays(
        cls,
        points: ArrayLike,
        cells: ArrayLike,
        regions: ArrayLike | None = None,
        names: Mapping[int, str] | None = None,
    ) -> Mesh:
        """A mesh from arrays: points (n, 3) in mm, cells (m, 4), (m, 10) or (m, 8) in VTK's order.

        Points of no cell are dropped, and cells whose corners run the other way round are turned.

        Parameters
        ----------
        regions : (m,) the tissue of each cell, as names or as numbers; none: all are ``tissue``.
        names : the tissue of each number; by default ``region 1`` for number 1.  Numbers of one name are one
            tissue.

        Raises
        ------
        ProblemError
            For cells that are not solved, not finite or flat, and regions that do not fit them.
        """
        points, cells = np.asarray(points, dtype=float), np.asarray(cells)
        width = cells.shape[1] if cells.ndim == 2 else 0
        kinds = {len(cell.nodes): cell.name for cell in CELLS.values()}
        if width not in kinds or not len(cells):
            *some, last = (f"(m, {n})" for n in kinds)
            raise ProblemError(
                f"cells have shape {cells.shape}, not {', '.join(some)} or {last}",
                remedy="give tetrahedra or linear hexahedra",
            )
        if cells.min() < 0 or cells.max() >= len(points):
            raise ProblemError("cells name nodes that do not exist", remedy="count nodes from 0")
        numbers, tissues = read_tissues(regions, len(cells), names or {})
        used, inverse = np.unique(cells, return_inverse=True)
        mesh = cls(points[used], inverse.reshape(cells.shape), kinds[width], numbers, tissues)
        turned = cell_volumes(mesh) < 0.0
        mesh.cells[turned] = mesh.cells[turned][:, mesh.kind.turned]
        check(mesh)
        return mesh

    @classmethod
    def from_pyvista(cls, grid: Any, region: str = "") -> Mesh:
        """The tetrahedra or hexahedra of a ``pyvista.UnstructuredGrid``.

        ``region``: the cell array of tissues. Cells of fewer dimensions, as surfaces and edges, are left out.
        See `from_arrays`.
        """
        blocks = [(_VTK_NAMES.get(int(k), f"VTK type {k}"), v) for k, v in grid.cells_dict.items()]
        tissues = _read_cell_array(grid.cell_data, region) if region else None
        kind, cells = _select_one_kind(blocks)
        if tissues is not None:
            tissues = np.asarray(tissues)[np.asarray(grid.celltypes) == CELLS[kind].vtk]
        return cls.from_arrays(grid.points, cells, tissues)

    @classmethod
    def from_meshio(cls, mesh: Any, region: str = "") -> Mesh:
        """The tetrahedra or hexahedra of a ``meshio.Mesh``; ``region``: the cell data of tissues.

        By default Gmsh's physical groups, with their names, or Medit's references, where there are any.
        Cells of fewer dimensions are left out. See `from_arrays`.
        """
        kind, cells = _select_one_kind([(_MESHIO_NAMES.get(b.type, b.type), b.data) for b in mesh.cells])
        groups = [name for name in _MESHIO_REGIONS if name in mesh.cell_data]
        data = None
        if region or groups:
            data = _read_cell_array(mesh.cell_data, region or groups[0])
        chosen = [k for k, block in enumerate(mesh.cells) if _MESHIO_NAMES.get(block.type) == kind]
        tissues = None if data is None else np.concatenate([np.asarray(data[k]) for k in chosen])
        names = {int(number): name for name, (number, dim) in mesh.field_data.items() if dim == 3}
        return cls.from_arrays(mesh.points, cells, tissues, names)

    def nodes_where(self, where: Callable[[Array], Mask]) -> Indices:
        """Numbers (k,) of the nodes at which ``where(points)`` holds: ``lambda p: p[:, 2] < -19.9``."""
        found = np.flatnonzero(self._evaluate(where))
        if not len(found):
            raise ProblemError("no node is there", remedy=f"the mesh spans {_format_extent(self.points)}")
        return found

    def faces_where(self, where: Callable[[Array], Mask]) -> Indices:
        """Outward boundary faces (k, 3, 6 or 4) at all of whose nodes ``where(points)`` holds."""
        faces = boundary_faces(self)
        found = faces[self._evaluate(where)[faces].all(axis=1)]
        if not len(found):
            raise ProblemError(
                "no boundary face is there", remedy=f"the mesh spans {_format_extent(self.points)}"
            )
        return found

    def _evaluate(self, where: Callable[[Array], Mask]) -> Mask:
        """(n,) whether a condition holds at each node. Raises `ProblemError` where it says something else."""
        found = np.asarray(where(self.points))
        if found.shape != (len(self.points),) or found.dtype != bool:
            what = f"a condition gives {found.dtype} {found.shape}, not true or false for each node"
            raise ProblemError(what, remedy="compare a coordinate, as in lambda p: p[:, 2] > -0.1")
        return found


def node_jacobians(mesh: Mesh) -> Array:
    """Jacobian determinant (m, k) of each cell at its own nodes, for unit reference cells, in mm3."""
    return _compute_determinants(mesh, mesh.kind.nodes) * mesh.kind.side**3


def cell_volumes(mesh: Mesh) -> Array:
    """Volumes (m,) of the cells, curved edges included, in mm3."""
    return _compute_determinants(mesh, mesh.kind.points) @ mesh.kind.weights


def _compute_determinants(mesh: Mesh, where: Array) -> Array:
    """det(dx/dxi) (m, q) at local coordinates (q, 3)."""
    _, gradients = mesh.kind.shape(where)
    return np.linalg.det(np.einsum("mki,qkj->mqij", mesh.points[mesh.cells], gradients))


def check(mesh: Mesh, measure: Callable[[Mesh], Array] | None = None) -> None:
    """Raise ``ProblemError`` when a mesh cannot be computed with: inverted, doubled or dangling cells.

    ``measure``: what must be positive of upright cells, (m, k); by default `node_jacobians`.
    """
    if not np.isfinite(mesh.points).all():
        raise ProblemError("the mesh has points that are not finite")
    if len(mesh.cells) == 0:
        raise ProblemError("the mesh has no cells")
    if mesh.cells.min() < 0 or mesh.cells.max() >= len(mesh.points):
        raise ProblemError("cells name nodes that do not exist")
    unused = len(mesh.points) - len(np.unique(mesh.cells))
    if unused:
        raise ProblemError(f"{unused} nodes belong to no cell", remedy="drop them from the mesh")
    corners = np.sort(mesh.corners, axis=1)
    corners = corners[np.lexsort(corners.T)]
    doubled = int((corners[1:] == corners[:-1]).all(axis=1).sum())
    if doubled:
        raise ProblemError(f"{doubled} cells are there twice")
    bad = np.flatnonzero(~((measure or node_jacobians)(mesh) > 0).all(axis=1))
    if len(bad):
        what = f"{len(bad)} of {len(mesh.cells)} cells are inverted or flat, the first is cell {bad[0]}"
        raise ProblemError(what, remedy="mesh again, finer")


def boundary_faces(mesh: Mesh, chosen: Mask | None = None) -> Indices:
    """Outward faces (k, 3, 6 or 4) that belong to one cell only, of all cells or of the ``chosen`` (m,).
    Raises `ProblemError` when a face belongs to more than two cells.
    """
    faces = (mesh.cells if chosen is None else mesh.cells[chosen])[:, mesh.kind.faces]
    faces = faces.reshape(-1, faces.shape[2])
    if not len(faces):
        return faces
    # Three of its corners identify a face of a conforming mesh, quadrilaterals included.
    low, middle, high = np.sort(faces[:, : mesh.kind.face_corners], axis=1)[:, :3].T
    count = len(mesh.points)
    _, first, counts = np.unique((low * count + middle) * count + high, return_index=True, return_counts=True)
    if counts.max() > 2:
        raise ProblemError("a face of the mesh belongs to more than two cells")
    return faces[np.sort(first[counts == 1])]


def to_tet10(mesh: Mesh) -> Mesh:
    """A straight-sided tet10 mesh from a tet4 mesh; the corner nodes keep their numbers.

    A mid-edge node joins a node set when it lies on a boundary face whose three corners are in the set.
    """
    if mesh.cell_type != "tet4":
        raise ProblemError(f"only tet4 meshes can be promoted to tet10, not {mesh.cell_type}")
    count = len(mesh.points)
    ends = np.sort(mesh.cells[:, TET10_EDGES], axis=2)
    keys, inverse = np.unique(ends[..., 0] * count + ends[..., 1], return_inverse=True)
    edges = np.stack(np.divmod(keys, count), axis=1)

    def with_mid_nodes(faces: Indices) -> Indices:
        pairs = np.sort(faces[:, TRI6_EDGES], axis=2)
        middle = count + np.searchsorted(keys, pairs[..., 0] * count + pairs[..., 1])
        return np.hstack([faces, middle])

    boundary = with_mid_nodes(boundary_faces(mesh))

    def promote_set(nodes: Indices) -> Indices:
        inside = np.isin(boundary[:, :3], nodes).all(axis=1)
        return np.union1d(nodes, boundary[inside, 3:].ravel()).astype(np.int64)

    return replace(
        mesh,
        points=np.vstack([mesh.points, mesh.points[edges].mean(axis=1)]),
        cells=np.hstack([mesh.cells, count + inverse.reshape(-1, 6)]),
        cell_type="tet10",
        node_sets={name: promote_set(nodes) for name, nodes in mesh.node_sets.items()},
        face_sets={name: with_mid_nodes(faces) for name, faces in mesh.face_sets.items()},
    )


def _select_one_kind(blocks: Iterable[tuple[str, Any]]) -> tuple[str, Indices]:
    """The one supported kind of volume cells among named blocks, and its cells; surfaces are named ``""``."""
    solid: dict[str, list[Any]] = {}
    for name, cells in blocks:
        if name and len(cells):
            solid.setdefault(name, []).append(np.asarray(cells))
    if not solid:
        raise ProblemError("the mesh has no volume cells", remedy="mesh the inside, not the surface alone")
    if len(solid) > 1 or not solid.keys() <= CELLS.keys():
        raise ProblemError(
            f"the mesh has {' and '.join(sorted(solid))}, not one kind of tetrahedra or linear hexahedra",
            remedy="make tetrahedra of it, in pyvista by grid.triangulate()",
        )
    ((kind, cells),) = solid.items()
    return kind, np.concatenate(cells).astype(np.int64)


def _read_cell_array(data: Mapping[str, Any], name: str) -> Any:
    if name not in data:
        known = ", ".join(map(str, data)) or "none"
        raise ProblemError(f"no cell data {name!r}", remedy=f"there is {known}")
    return data[name]


def read_tissues(
    regions: ArrayLike | None, count: int, names: Mapping[int, str]
) -> tuple[Indices, tuple[str, ...]]:
    """The number of each cell's tissue (m,) and the tissues, in the order of their names or numbers. Raises
    `ProblemError` for regions that are neither, or not one for each of ``count`` cells.
    """
    if regions is None:
        return np.zeros(count, dtype=np.int64), ("tissue",)
    values = np.asarray(regions)
    if values.dtype == object:  # names, as a column of pandas has them
        values = np.asarray(values.tolist())
    if values.shape != (count,):
        raise ProblemError(f"regions have shape {values.shape}, not one for each of {count} cells")
    kinds, numbers = np.unique(values, return_inverse=True)
    if values.dtype.kind in "US":
        return numbers.astype(np.int64), tuple(map(str, kinds))
    if not np.array_equal(kinds, np.round(kinds)):
        raise ProblemError("regions are neither names nor whole numbers")
    named = [names.get(int(k), f"region {int(k)}") for k in kinds]
    tissues = tuple(dict.fromkeys(named))  # numbers of one name are one tissue
    return np.array([tissues.index(name) for name in named])[numbers], tissues


def _format_extent(points: Array) -> str:
    low, high = points.min(axis=0), points.max(axis=0)
    return ", ".join(f"{axis} {a:g} to {b:g} mm" for axis, a, b in zip("xyz", low, high))


@dataclass(frozen=True)
class MeshQuality:
    """Element quality of a mesh; angles in degrees, volumes in mm3.

    Dihedral angles are those of the straight tetrahedra (NaN for hexahedra); the scaled Jacobian is the
    smallest determinant over an element's nodes divided by its mean, 1 for every straight tetrahedron.
    """

    min_dihedral_deg: float
    dihedral_percentiles_deg: Mapping[str, float]
    volume_mm3: float
    region_volumes_mm3: Mapping[str, float]
    min_scaled_jacobian: float
    inverted: int


def measure_quality(mesh: Mesh) -> MeshQuality:
    """Quality of a mesh; ``inverted`` counts cells whose Jacobian is not positive at some node."""
    size = cell_volumes(mesh)
    jacobians = node_jacobians(mesh)
    scaled = jacobians.min(axis=1) / np.abs(jacobians.mean(axis=1))
    angles = (
        compute_dihedral_angles(mesh.points, mesh.cells[:, :4])
        if mesh.kind.is_tetrahedron
        else np.full((1, 6), np.nan)
    )
    smallest = angles.min(axis=1)
    marks = (0.1, 1, 5, 50)
    return MeshQuality(
        min_dihedral_deg=float(smallest.min()),
        dihedral_percentiles_deg={f"{q:g}": float(np.percentile(smallest, q)) for q in marks},
        volume_mm3=float(size.sum()),
        region_volumes_mm3={
            name: float(size[mesh.regions == index].sum()) for index, name in enumerate(mesh.region_names)
        },
        min_scaled_jacobian=float(scaled.min()),
        inverted=int((jacobians.min(axis=1) <= 0).sum()),
    )


def compute_dihedral_angles(points: Array, tets: Indices) -> Array:
    """The six dihedral angles (m, 6) of straight tetrahedra (m, 4), in degrees."""
    corners = points[tets]
    faces = corners[:, TET_FACES]
    normals = np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    first, second = np.triu_indices(4, 1)
    cosines = np.einsum("mij,mij->mi", normals[:, first], normals[:, second])
    return np.degrees(np.arccos(np.clip(-cosines, -1.0, 1.0)))
