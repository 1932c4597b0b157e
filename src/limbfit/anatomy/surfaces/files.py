"""Files of surfaces: STL, PLY, VTP, OBJ, in LPS or RAS, in millimetres or a stated unit."""

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import meshio
import numpy as np
import pyvista as pv
from vtkmodules.util.numpy_support import vtk_to_numpy

from ...errors import SurfaceError, add_location
from ...mesh import silence_vtk
from .triangles import Surface, from_pyvista, remove_unused_points

SUFFIXES = (".stl", ".ply", ".vtp", ".obj")
UNITS_MM: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
MAX_ITEMS = 50_000_000  # points or faces of a surface
_BLOCK = 1 << 20
_STATED = re.compile(rb"""NumberOf(?:Points|Polys|Strips|Lines|Verts|Tuples)\s*=\s*["'](\d+)["']""")
_HEAD = 4096  # bytes in which a file may state its space


def read_surface(
    path: str | Path,
    coordinates: Literal["LPS", "RAS"] | None = None,
    unit: str = "mm",
    *,
    key: str = "surfaces.coordinates",
    merge: bool = True,
) -> Surface:
    """A surface from .stl, .ply, .vtp or .obj, in LPS mm; coincident points are merged.

    Raises `SurfaceError` for a file that cannot be read, holds no triangles, or says that it is in other
    coordinates. Closedness and size are for :func:`~limbfit.anatomy.surfaces.triangles.check_closed`.

    Parameters
    ----------
    coordinates : what the file holds; by default what it says itself, as those of 3D Slicer do, else LPS.
    unit : of the file: mm, cm, m or inch.
    key : of the study that says the coordinates, for the error's text.
    merge : False keeps points and triangles as the file has them.
    """
    path = Path(path)
    with add_location(file=path):
        if not path.is_file():
            raise SurfaceError("no such surface")
        _check_suffix(path)
        poly = _read_poly(path, merge)
        surface = from_pyvista(poly.triangulate())
        if not np.all(np.isfinite(surface.points)):
            raise SurfaceError("points that are not numbers", remedy="export the surface again")
        stated = _read_stated_space(path, poly)
        if coordinates and stated and coordinates != stated:
            raise SurfaceError(
                f"the file says that it is in {stated}, the study says {coordinates}",
                remedy=f"correct {key}, or export the surface again",
            )
        sign = np.array([-1.0, -1.0, 1.0]) if (coordinates or stated) == "RAS" else np.ones(3)
        merged = Surface(surface.points * sign * UNITS_MM[unit], surface.faces)
        if merge:
            merged = _merge_points(merged)
        if not len(merged.faces):
            raise SurfaceError("the file holds no triangles", remedy="export the surface again")
        return merged


def _read_stated_space(path: Path, poly: pv.PolyData) -> str | None:
    """``LPS`` or ``RAS`` where the file says so as 3D Slicer does: SPACE in its header or field data."""
    if "SPACE" in poly.field_data:
        text = str(poly.field_data["SPACE"][0])
        return text if text in ("LPS", "RAS") else None
    with path.open("rb") as stream:
        found = re.search(rb"SPACE=(LPS|RAS)", stream.read(_HEAD))
    return found[1].decode() if found else None


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise SurfaceError(
            f"unknown kind of surface {path.suffix!r}", remedy="use one of " + " ".join(SUFFIXES)
        )


def _read_poly(path: Path, merge: bool) -> pv.PolyData:
    if path.suffix.lower() == ".vtp":
        _check_stated_counts(path)
    try:
        with silence_vtk(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if path.suffix.lower() == ".ply":
                poly = _read_ply(path)
            else:
                reader = pv.get_reader(str(path))
                if isinstance(reader, pv.STLReader):
                    reader.reader.SetMerging(merge)
                poly = reader.read()
    except Exception:  # readers raise many kinds; all mean the same to the user
        raise SurfaceError("the surface cannot be read", remedy="export the surface again") from None
    if not isinstance(poly, pv.PolyData):
        raise SurfaceError("the file holds no triangles", remedy="export the surface again")
    corners = vtk_to_numpy(poly.GetPolys().GetConnectivityArray())
    if len(corners) and not 0 <= corners.min() <= corners.max() < poly.n_points:  # VTK would take any memory
        raise SurfaceError("faces of points that are not there", remedy="export the surface again")
    return poly


def _check_stated_counts(path: Path) -> None:
    """Refuse a VTK XML file that states more than `MAX_ITEMS` points, faces or values of an array."""
    rest = b""
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            text = rest + block
            if any(int(match[1][:20]) > MAX_ITEMS for match in _STATED.finditer(text)):
                raise SurfaceError(
                    f"it states more than {MAX_ITEMS:.0e} points or faces",
                    remedy="export the surface again, with fewer triangles",
                )
            rest = text[-64:]


def _read_ply(path: Path) -> pv.PolyData:
    """By meshio: VTK's reader takes the whole process down with it when the file is cut short."""
    found = meshio.ply.read(path)  # meshio.read would print what is wrong, and end the process
    faces = [np.insert(block.data, 0, block.data.shape[1], axis=1).ravel() for block in found.cells]
    return pv.PolyData(found.points.astype(float), np.concatenate(faces))


def _merge_points(surface: Surface) -> Surface:
    """Merge points that coincide exactly (STL repeats them), and drop faces that collapse."""
    points, inverse = np.unique(surface.points, axis=0, return_inverse=True)
    faces = inverse.ravel()[surface.faces]
    a, b, c = faces.T
    return remove_unused_points(Surface(points, faces[(a != b) & (b != c) & (c != a)]))


def write_surface(path: str | Path, surface: Surface) -> None:
    """Write .stl (binary), .ply, .vtp or .obj by the suffix, in LPS mm."""
    path = Path(path)
    with silence_vtk(), add_location(file=path):
        _check_suffix(path)
        surface.to_pyvista().save(str(path), recompute_normals=False)
