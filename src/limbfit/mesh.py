"""Volume meshes: points, cells, regions, named sets; quality; VTU on disk.

Vocabulary
----------
points   (n, 3) float64, millimetres, LPS.
cells    (m, k) int64, in VTK order: tet4 (k=4), tet10 (k=10, mid-edge nodes 01 12 20 03 13 23), hex8 (k=8).
regions  (m,) int64, index of each cell into ``region_names``.
node_sets / face_sets  named integer arrays: node indices, and outward-oriented boundary faces
         (3, 6 or 4 nodes each, in VTK order).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os.path import relpath
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkObject, vtkPoints, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkFieldData, vtkUnstructuredGrid
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader, vtkXMLUnstructuredGridWriter

from .errors import ProblemError

CELL_NODES = {"tet4": 4, "tet10": 10, "hex8": 8}
VTK_CELL = {"tet4": 10, "tet10": 24, "hex8": 12}
TET10_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # outward for positive volume
TRI6_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


@dataclass(frozen=True)
class Mesh:
    """An immutable volume mesh; see the module docstring for the arrays."""

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    cell_type: str
    regions: NDArray[np.int64]
    region_names: tuple[str, ...]
    node_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    face_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.cell_type not in CELL_NODES:
            raise ProblemError(f"unknown cell type {self.cell_type!r}; use one of {sorted(CELL_NODES)}")
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ProblemError(f"mesh points have shape {self.points.shape}, not (n, 3)")
        if self.cells.ndim != 2 or self.cells.shape[1] != CELL_NODES[self.cell_type]:
            raise ProblemError(f"{self.cell_type} cells have shape {self.cells.shape}")
        if len(self.regions) != len(self.cells):
            raise ProblemError(f"{len(self.regions)} region indices for {len(self.cells)} cells")

    @property
    def corners(self) -> NDArray[np.int64]:
        """Corner nodes of each cell: (m, 4) for tetrahedra, (m, 8) for hexahedra."""
        return self.cells[:, : 4 if self.cell_type.startswith("tet") else 8]

    def with_points(self, points: NDArray[np.float64]) -> Mesh:
        return replace(self, points=points)


@dataclass(frozen=True)
class Quality:
    """Element quality of a mesh; angles in degrees, volumes in mm3.

    Dihedral angles are those of the straight tetrahedra (NaN for hexahedra); the scaled Jacobian is the
    smallest determinant over an element's nodes divided by its mean, 1 for every straight tetrahedron.
    """

    min_dihedral_deg: float
    dihedral_percentiles_deg: Mapping[str, float]
    max_dihedral_deg: float
    volume_mm3: float
    region_volumes_mm3: Mapping[str, float]
    min_cell_volume_mm3: float
    min_scaled_jacobian: float
    inverted: int


def quality(mesh: Mesh) -> Quality:
    """Quality of a mesh; ``inverted`` counts cells whose Jacobian is not positive at some node."""
    size = cell_volumes(mesh)
    jacobians = node_jacobians(mesh)
    scaled = jacobians.min(axis=1) / np.abs(jacobians.mean(axis=1))
    angles = (
        dihedral_angles(mesh.points, mesh.cells[:, :4])
        if mesh.cell_type != "hex8"
        else np.full((1, 6), np.nan)
    )
    smallest = angles.min(axis=1)
    marks = (0.1, 1, 5, 50)
    return Quality(
        min_dihedral_deg=float(smallest.min()),
        dihedral_percentiles_deg={f"{q:g}": float(np.percentile(smallest, q)) for q in marks},
        max_dihedral_deg=float(angles.max()),
        volume_mm3=float(size.sum()),
        region_volumes_mm3={
            name: float(size[mesh.regions == index].sum()) for index, name in enumerate(mesh.region_names)
        },
        min_cell_volume_mm3=float(size.min()),
        min_scaled_jacobian=float(scaled.min()),
        inverted=int((jacobians.min(axis=1) <= 0).sum()),
    )


def dihedral_angles(points: NDArray[np.float64], tets: NDArray[np.int64]) -> NDArray[np.float64]:
    """The six dihedral angles (m, 6) of straight tetrahedra (m, 4), in degrees."""
    corners = points[tets]
    faces = corners[:, TET_FACES]
    normals = np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    first, second = np.triu_indices(4, 1)
    cosines = np.einsum("mij,mij->mi", normals[:, first], normals[:, second])
    return np.degrees(np.arccos(np.clip(-cosines, -1.0, 1.0)))


def node_jacobians(mesh: Mesh) -> NDArray[np.float64]:
    """Jacobian determinant (m, k) of each cell at its own nodes, for unit reference cells, in mm3."""
    gradients = _shape_gradients(mesh.cell_type, _REFERENCE_NODES[mesh.cell_type])
    return _determinants(mesh, gradients)


def cell_volumes(mesh: Mesh) -> NDArray[np.float64]:
    """Volumes (m,) of the cells, curved edges included, in mm3."""
    where, weights = _QUADRATURE[mesh.cell_type]
    return _determinants(mesh, _shape_gradients(mesh.cell_type, where)) @ weights


def _determinants(mesh: Mesh, gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """det(dx/dxi) (m, q) for shape gradients (q, k, 3)."""
    return np.linalg.det(np.einsum("mki,qkj->mqij", mesh.points[mesh.cells], gradients))


def _shape_gradients(cell_type: str, where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Gradients (q, k, 3) of the shape functions at reference coordinates (q, 3)."""
    if cell_type == "hex8":
        signs = 2.0 * _REFERENCE_NODES["hex8"] - 1.0
        terms = 0.5 + signs * (where[:, None, :] - 0.5)
        return np.stack(
            [signs[:, i] * terms[..., (i + 1) % 3] * terms[..., (i + 2) % 3] for i in range(3)], axis=-1
        )
    slope = np.array([[-1.0, -1.0, -1.0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    if cell_type == "tet4":
        return np.broadcast_to(slope, (len(where), 4, 3))
    L = np.column_stack([1.0 - where.sum(axis=1), where])
    corner = (4.0 * L - 1.0)[:, :, None] * slope
    a, b = TET10_EDGES.T
    edge = 4.0 * (L[:, a, None] * slope[b] + L[:, b, None] * slope[a])
    return np.concatenate([corner, edge], axis=1)


_TET_NODES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
_REFERENCE_NODES = {
    "tet4": _TET_NODES,
    "tet10": np.vstack([_TET_NODES, _TET_NODES[TET10_EDGES].mean(axis=1)]),
    "hex8": np.array(
        [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
    ),
}


def _quadrature() -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Rules that integrate the Jacobian of each cell exactly (tet10: cubic; Keast's 5 points)."""
    keast = np.full((5, 3), 1 / 6)
    keast[0] = 0.25
    keast[1:4] += np.eye(3) / 3
    gauss = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
    grid = np.stack(np.meshgrid(gauss, gauss, gauss), axis=-1).reshape(-1, 3)
    return {
        "tet4": (np.full((1, 3), 0.25), np.array([1 / 6])),
        "tet10": (keast, np.array([-0.8, 0.45, 0.45, 0.45, 0.45]) / 6),
        "hex8": (grid, np.full(8, 1 / 8)),
    }


_QUADRATURE = _quadrature()


def check(mesh: Mesh) -> None:
    """Raise ``ProblemError`` when a mesh cannot be computed with: inverted, doubled or dangling cells."""
    if not np.isfinite(mesh.points).all():
        raise ProblemError("mesh points are not finite")
    if len(mesh.cells) == 0:
        raise ProblemError("the mesh has no cells")
    if mesh.cells.min() < 0 or mesh.cells.max() >= len(mesh.points):
        raise ProblemError("cells name nodes that do not exist")
    if len(np.unique(mesh.cells)) != len(mesh.points):
        raise ProblemError("some mesh points belong to no cell", remedy="drop unused points")
    corners = np.sort(mesh.corners, axis=1)
    corners = corners[np.lexsort(corners.T)]
    if (corners[1:] == corners[:-1]).all(axis=1).any():
        raise ProblemError("some cells are there twice")
    inverted = int((node_jacobians(mesh).min(axis=1) <= 0).sum())
    if inverted:
        raise ProblemError(f"{inverted} of {len(mesh.cells)} cells are inverted", remedy="mesh again, finer")


def boundary_faces(mesh: Mesh) -> NDArray[np.int64]:
    """Outward faces (k, 3, 6 or 4) that belong to one cell only.

    Raises
    ------
    ProblemError
        When a face belongs to more than two cells.
    """
    faces = mesh.cells[:, _CELL_FACES[mesh.cell_type]]
    faces = faces.reshape(-1, faces.shape[2])
    # Three of its corners tell a face of a conforming mesh, quadrilaterals included.
    low, middle, high = np.sort(faces[:, : _FACE_CORNERS[mesh.cell_type]], axis=1)[:, :3].T
    count = len(mesh.points)
    _, first, counts = np.unique((low * count + middle) * count + high, return_index=True, return_counts=True)
    if counts.max() > 2:
        raise ProblemError("a face of the mesh belongs to more than two cells")
    return faces[np.sort(first[counts == 1])]


_TET10_FACES = np.array([[0, 2, 1, 6, 5, 4], [0, 1, 3, 4, 8, 7], [1, 2, 3, 5, 9, 8], [0, 3, 2, 7, 9, 6]])
_HEX_FACES = np.array([[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]])
_CELL_FACES = {"tet4": TET_FACES, "tet10": _TET10_FACES, "hex8": _HEX_FACES}
_FACE_CORNERS = {"tet4": 3, "tet10": 3, "hex8": 4}


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

    def with_mid_nodes(faces: NDArray[np.int64]) -> NDArray[np.int64]:
        pairs = np.sort(faces[:, TRI6_EDGES], axis=2)
        middle = count + np.searchsorted(keys, pairs[..., 0] * count + pairs[..., 1])
        return np.hstack([faces, middle])

    boundary = with_mid_nodes(boundary_faces(mesh))
    return replace(
        mesh,
        points=np.vstack([mesh.points, mesh.points[edges].mean(axis=1)]),
        cells=np.hstack([mesh.cells, count + inverse.reshape(-1, 6)]),
        cell_type="tet10",
        node_sets={name: _promoted_set(nodes, boundary) for name, nodes in mesh.node_sets.items()},
        face_sets={name: with_mid_nodes(faces) for name, faces in mesh.face_sets.items()},
    )


def _promoted_set(nodes: NDArray[np.int64], boundary: NDArray[np.int64]) -> NDArray[np.int64]:
    inside = np.isin(boundary[:, :3], nodes).all(axis=1)
    return np.union1d(nodes, boundary[inside, 3:].ravel()).astype(np.int64)


def write_vtu(
    mesh: Mesh,
    path: str | Path,
    point_data: Mapping[str, NDArray] | None = None,
    cell_data: Mapping[str, NDArray] | None = None,
) -> None:
    """Write a mesh with named fields to a VTU file.

    ParaView shows the cell array ``region`` and a point array ``in NAME`` per node set; the exact sets are
    field data, so that :func:`read_vtu` gives back the same mesh bit by bit.
    """
    grid = vtkUnstructuredGrid()
    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(mesh.points), deep=True))
    grid.SetPoints(points)
    connectivity = numpy_to_vtkIdTypeArray(np.ascontiguousarray(mesh.cells).ravel(), deep=True)
    offsets = np.arange(len(mesh.cells) + 1) * mesh.cells.shape[1]
    cells = vtkCellArray()
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), connectivity)
    grid.SetCells(VTK_CELL[mesh.cell_type], cells)
    _add_arrays(grid.GetCellData(), {"region": mesh.regions, **(cell_data or {})})
    _add_arrays(grid.GetPointData(), _set_masks(mesh) | dict(point_data or {}))
    _add_arrays(grid.GetFieldData(), {f"{_NODE_SET}{name}": nodes for name, nodes in mesh.node_sets.items()})
    _add_arrays(grid.GetFieldData(), {f"{_FACE_SET}{name}": faces for name, faces in mesh.face_sets.items()})
    names = vtkStringArray()
    names.SetName("region_names")
    for name in mesh.region_names:
        names.InsertNextValue(name)
    grid.GetFieldData().AddArray(names)
    _write(grid, Path(path))


_NODE_SET, _FACE_SET = "node_set:", "face_set:"


def _set_masks(mesh: Mesh) -> dict[str, NDArray]:
    numbers = np.arange(len(mesh.points))
    return {f"in {name}": np.isin(numbers, nodes).astype(np.uint8) for name, nodes in mesh.node_sets.items()}


def _add_arrays(data: vtkFieldData, arrays: Mapping[str, NDArray]) -> None:
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(name)
        data.AddArray(array)


@contextmanager
def silent_vtk() -> Iterator[None]:
    """VTK's own reports stay out of the terminal: what fails is said in words by who called it."""
    shown = vtkObject.GetGlobalWarningDisplay()
    vtkObject.SetGlobalWarningDisplay(0)
    try:
        yield
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)


def _write(grid: vtkUnstructuredGrid, path: Path) -> None:
    draft = path.with_name(f".{path.name}.part")  # a run that is killed leaves no half of a mesh at ``path``
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(draft))
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    with silent_vtk():
        written = writer.Write()
    if not written:
        draft.unlink(missing_ok=True)
        raise ProblemError("cannot be written", file=path, remedy="check the folder and the free disk space")
    draft.replace(path)


def read_vtu(path: str | Path) -> Mesh:
    """Read a mesh written by :func:`write_vtu`, or any VTU file of one supported cell type.

    A foreign file without regions becomes one region named ``all``.
    """
    grid = read_grid(Path(path))
    kinds = np.unique(vtk_to_numpy(grid.GetCellTypesArray()))
    named = {number: name for name, number in VTK_CELL.items()}
    if len(kinds) != 1 or int(kinds[0]) not in named:
        raise ProblemError(f"cells of VTK types {kinds.tolist()}, not of one supported type", file=path)
    cell_type = named[int(kinds[0])]
    connectivity = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).astype(np.int64)
    cells = connectivity.reshape(-1, CELL_NODES[cell_type])
    region = grid.GetCellData().GetArray("region")
    names = grid.GetFieldData().GetAbstractArray("region_names")
    return Mesh(
        points=vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64),
        cells=cells,
        cell_type=cell_type,
        regions=np.zeros(len(cells), np.int64) if region is None else vtk_to_numpy(region).astype(np.int64),
        region_names=("all",)
        if names is None
        else tuple(names.GetValue(i) for i in range(names.GetNumberOfValues())),
        node_sets=_stored_sets(grid, _NODE_SET),
        face_sets=_stored_sets(grid, _FACE_SET),
    )


def read_grid(path: Path) -> vtkUnstructuredGrid:
    """A VTU file as VTK's own grid, with all its fields.

    Raises
    ------
    ProblemError
        When there is no such file, or it holds no cells.
    """
    if not path.is_file():
        raise ProblemError("no such mesh", file=path)
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    grid = reader.GetOutput()
    if grid is None or grid.GetNumberOfCells() == 0:
        raise ProblemError("not a VTU file with cells", file=path)
    return grid


def _stored_sets(grid: vtkUnstructuredGrid, prefix: str) -> dict[str, NDArray[np.int64]]:
    data = grid.GetFieldData()
    names = [data.GetAbstractArray(i).GetName() for i in range(data.GetNumberOfArrays())]
    chosen = [name for name in names if name and name.startswith(prefix)]
    return {name.removeprefix(prefix): vtk_to_numpy(data.GetArray(name)).astype(np.int64) for name in chosen}


def write_pvd(path: str | Path, frames: Sequence[tuple[float, Path]]) -> None:
    """Write a ParaView collection of (time in s, VTU file); the files are named relative to ``path``."""
    folder = Path(path).parent.resolve()
    lines = [
        f'    <DataSet timestep="{float(time)!r}" part="0" file={quoteattr(relpath(file, folder))}/>'
        for time, file in ((time, Path(file).resolve()) for time, file in frames)
    ]
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>'
    Path(path).write_text("\n".join([head, *lines, "  </Collection>\n</VTKFile>\n"]), encoding="utf-8")
