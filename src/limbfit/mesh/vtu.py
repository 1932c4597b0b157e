"""Meshes with their fields as VTU, and collections of them as PVD."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os.path import relpath
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkObject, vtkPoints, vtkStringArray
from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkFieldData, vtkUnstructuredGrid
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader, vtkXMLUnstructuredGridWriter

from ..arrays import Indices
from ..errors import ProblemError, add_location
from .cells import CELLS
from .volume import Mesh, read_tissues

_NODE_SET, _FACE_SET = "node_set:", "face_set:"


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
    grid.SetCells(mesh.kind.vtk, cells)
    _add_arrays(grid.GetCellData(), {"region": mesh.regions, **(cell_data or {})})
    numbers = np.arange(len(mesh.points))
    masks = {f"in {name}": np.isin(numbers, nodes).astype(np.uint8) for name, nodes in mesh.node_sets.items()}
    _add_arrays(grid.GetPointData(), masks | dict(point_data or {}))
    _add_arrays(grid.GetFieldData(), {f"{_NODE_SET}{name}": nodes for name, nodes in mesh.node_sets.items()})
    _add_arrays(grid.GetFieldData(), {f"{_FACE_SET}{name}": faces for name, faces in mesh.face_sets.items()})
    names = vtkStringArray()
    names.SetName("region_names")
    for name in mesh.region_names:
        names.InsertNextValue(name)
    grid.GetFieldData().AddArray(names)
    path = Path(path)
    draft = path.with_name(f".{path.name}.part")  # a run that is killed leaves no half of a mesh at ``path``
    writer = vtkXMLUnstructuredGridWriter()
    writer.SetFileName(str(draft))
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    with silence_vtk():
        written = writer.Write()
    if not written:
        draft.unlink(missing_ok=True)
        raise ProblemError("cannot be written", file=path, remedy="check the folder and the free disk space")
    draft.replace(path)


def _add_arrays(data: vtkFieldData, arrays: Mapping[str, NDArray]) -> None:
    for name, values in arrays.items():
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName(name)
        data.AddArray(array)


@contextmanager
def silence_vtk() -> Iterator[None]:
    """Keep VTK's own messages out of the terminal: the caller raises an error in words."""
    shown = vtkObject.GetGlobalWarningDisplay()
    vtkObject.SetGlobalWarningDisplay(0)
    try:
        yield
    finally:
        vtkObject.SetGlobalWarningDisplay(shown)


def read_vtu(path: str | Path) -> Mesh:
    """Read a mesh written by :func:`write_vtu`, or any VTU file of one supported cell type.

    A foreign file has the regions of its cell array ``region``, names or numbers; without one it is one
    region named ``all``.
    """
    return grid_to_mesh(read_grid(Path(path)), path)


def grid_to_mesh(grid: vtkUnstructuredGrid, path: str | Path) -> Mesh:
    """Return the mesh of a grid that `read_grid` has read; ``path`` is for errors."""
    kinds = np.unique(vtk_to_numpy(grid.GetCellTypesArray()))
    named = {cell.vtk: cell.name for cell in CELLS.values()}
    if len(kinds) != 1 or int(kinds[0]) not in named:
        raise ProblemError(f"cells of VTK types {kinds.tolist()}, not of one supported type", file=path)
    cell_type = named[int(kinds[0])]
    connectivity = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).astype(np.int64)
    cells = connectivity.reshape(-1, len(CELLS[cell_type].nodes))
    regions = _read_array(grid.GetCellData(), "region")
    names = _read_array(grid.GetFieldData(), "region_names")
    tissues = ("all",) if names is None else tuple(map(str, names))
    if regions is None:
        regions = np.zeros(len(cells))
    elif names is None:
        with add_location(file=path):
            regions, tissues = read_tissues(regions, len(cells), {})
    return Mesh(
        points=vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64),
        cells=cells,
        cell_type=cell_type,
        regions=regions.astype(np.int64),
        region_names=tissues,
        node_sets=_read_sets(grid, _NODE_SET),
        face_sets=_read_sets(grid, _FACE_SET),
    )


def read_grid(path: Path) -> vtkUnstructuredGrid:
    """A VTU file as VTK's own grid, with all its fields. Raises `ProblemError` when there is no such file, or
    it holds no cells.
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


def _read_array(data: vtkFieldData, name: str) -> NDArray | None:
    """The numbers or texts of an array; None where there is none."""
    array = data.GetAbstractArray(name)
    if isinstance(array, vtkStringArray):
        return np.array([array.GetValue(i) for i in range(array.GetNumberOfValues())])
    return None if array is None else vtk_to_numpy(array)


def _read_sets(grid: vtkUnstructuredGrid, prefix: str) -> dict[str, Indices]:
    data = grid.GetFieldData()
    names = [data.GetAbstractArray(i).GetName() for i in range(data.GetNumberOfArrays())]
    chosen = [name for name in names if name and name.startswith(prefix)]
    return {name.removeprefix(prefix): vtk_to_numpy(data.GetArray(name)).astype(np.int64) for name in chosen}


def write_pvd(path: str | Path, frames: Sequence[tuple[float, Path]]) -> None:
    """Write a ParaView collection of (time in s, VTU file); the files are named relative to ``path``."""
    folder = Path(path).parent.resolve()
    names = [(float(time), quoteattr(relpath(file.resolve(), folder))) for time, file in frames]
    lines = [f'    <DataSet timestep="{time!r}" part="0" file={name}/>' for time, name in names]
    head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>'
    Path(path).write_text("\n".join([head, *lines, "  </Collection>\n</VTKFile>\n"]), encoding="utf-8")
