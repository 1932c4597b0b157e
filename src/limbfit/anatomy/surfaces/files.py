"""Files of surfaces: STL, PLY, VTP, OBJ, 3MF, AOP, in LPS or RAS, in millimetres or a stated unit."""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import meshio
import numpy as np
import pyvista as pv
from vtkmodules.util.numpy_support import vtk_to_numpy

from ...errors import SurfaceError, add_location
from ...extensions import import_extra
from ...mesh import silence_vtk
from .slices import Sense, read_slices
from .triangles import Surface, from_pyvista, remove_unused_points, stack_surfaces

SUFFIXES = (".stl", ".ply", ".vtp", ".obj", ".3mf", ".aop")
UNITS_MM: Mapping[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
MAX_ITEMS = 50_000_000  # points or faces of a surface
_BLOCK = 1 << 20
_STATED = re.compile(rb"""NumberOf(?:Points|Polys|Strips|Lines|Verts|Tuples)\s*=\s*["'](\d+)["']""")
_HEAD = 4096  # bytes in which a file may state its space and unit
_STATED_WORDS = (("SPACE", "LPS|RAS"), ("UNIT", "|".join(UNITS_MM)))
_UNITS_3MF = {"millimeter": "mm", "millimeters": "mm", "centimeter": "cm", "meter": "m"}


def read_surface(
    path: str | Path,
    coordinates: Literal["LPS", "RAS"] | None = None,
    unit: str | None = "mm",
    *,
    key: str = "surfaces.coordinates",
    merge: bool = True,
) -> Surface:
    """A surface from .stl, .ply, .vtp, .obj, .3mf or .aop, in LPS mm; coincident points are merged.

    Raises `SurfaceError` for a file that cannot be read, holds no triangles, or says that it is in other
    coordinates or another unit. Closedness and size are for
    :func:`~limbfit.anatomy.surfaces.triangles.check_closed`.

    Parameters
    ----------
    coordinates : what the file holds; by default what it says itself, as those of 3D Slicer do, else LPS.
    unit : of the file: mm, cm, m or inch; None: what it says itself.
    key : of the study that says the coordinates, for the error's text.
    merge : False keeps points and triangles as the file has them.
    """
    return stack_surfaces(list(read_parts(path, coordinates, unit, key=key, merge=merge).values()))


def read_parts(
    path: str | Path,
    coordinates: Literal["LPS", "RAS"] | None = None,
    unit: str | None = None,
    *,
    spokes: Sense | None = None,
    key: str = "--space",
    merge: bool = True,
) -> dict[str, Surface]:
    """The objects of a .3mf file by their names, else the one surface of a file; as `read_surface`.

    ``spokes``: the sense in which an AOP file counts them; by default what it says.
    """
    path = Path(path)
    with add_location(file=path):
        if not path.is_file():
            raise SurfaceError("no such surface")
        _check_suffix(path, SUFFIXES)
        parts, space, stated = _read_content(path, merge, spokes)
        if any(not np.all(np.isfinite(part.points)) for part in parts.values()):
            raise SurfaceError("points that are not numbers", remedy="export the surface again")
        if coordinates and space and coordinates != space:
            raise SurfaceError(
                f"the file says that it is in {space}, the study says {coordinates}",
                remedy=f"correct {key}, or export the surface again",
            )
        if (stated or unit) not in UNITS_MM or unit not in (None, stated or unit):
            what = f"the file says that its unit is {stated}" if stated else "the file does not say its unit"
            raise SurfaceError(what, remedy=f"state the unit, one of {', '.join(UNITS_MM)}, as it is")
        sign = np.array([-1.0, -1.0, 1.0]) if (coordinates or space) == "RAS" else np.ones(3)
        scale = sign * UNITS_MM[str(stated or unit)]
        scaled = {name: Surface(part.points * scale, part.faces) for name, part in parts.items()}
        if merge:
            scaled = {name: _merge_points(part) for name, part in scaled.items()}
        if not any(len(part.faces) for part in scaled.values()):
            raise SurfaceError("the file holds no triangles", remedy="export the surface again")
        return scaled


def _read_content(
    path: Path, merge: bool, spokes: Sense | None
) -> tuple[dict[str, Surface], str | None, str | None]:
    """The surfaces of a file by their names, and the space and the unit that it states."""
    if path.suffix.lower() == ".3mf":
        return _read_3mf(path)
    if path.suffix.lower() == ".aop":
        surface, is_placed = read_slices(path.read_text(encoding="latin-1"), spokes)
        return {"": surface}, "LPS" if is_placed else None, "mm"
    poly = _read_poly(path, merge)
    space, unit = (_read_stated(path, poly, *words) for words in _STATED_WORDS)
    return {"": from_pyvista(poly.triangulate())}, space, unit


def _import_3mf() -> Any:
    """Import trimesh, and that by which it reads and writes 3MF."""
    return [import_extra(module, "fabrication") for module in ("lxml", "networkx", "trimesh")][-1]


def _read_3mf(path: Path) -> tuple[dict[str, Surface], None, str | None]:
    parts, unit, trimesh = dict[str, Surface](), None, _import_3mf()
    try:
        scene = trimesh.load_scene(path)
        for name in scene.graph.nodes_geometry:
            turn, of = scene.graph[name]
            mesh = scene.geometry[of]
            parts[name] = Surface(mesh.vertices @ turn[:3, :3].T + turn[:3, 3], mesh.faces)
            unit = _UNITS_3MF.get(mesh.units, mesh.units)
    except Exception:  # of a zip file, XML or the scene: all mean the same to the user
        parts = {}
    if not parts:
        raise SurfaceError("the file holds no mesh that can be read", remedy="export the surface again")
    return parts, None, unit


def _read_stated(path: Path, poly: pv.PolyData, word: str, values: str) -> str | None:
    """What the file says of itself as 3D Slicer does, such as SPACE=LPS: in its header or field data."""
    if word in poly.field_data:
        found = re.fullmatch(values, str(poly.field_data[word][0]))
        return found[0] if found else None
    with path.open("rb") as stream:
        stated = re.search(rf"{word}=({values})\b".encode(), stream.read(_HEAD))
    return stated[1].decode() if stated else None


def _check_suffix(path: Path, suffixes: Sequence[str]) -> None:
    if path.suffix.lower() not in suffixes:
        raise SurfaceError(
            f"unknown kind of surface {path.suffix!r}", remedy="use one of " + " ".join(suffixes)
        )


def _read_poly(path: Path, merge: bool) -> pv.PolyData:
    if path.suffix.lower() == ".vtp":
        _check_stated_counts(path)
    try:
        with silence_vtk(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if path.suffix.lower() == ".ply":
                # By meshio: VTK's reader takes the whole process down with it when the file is cut short.
                found = meshio.ply.read(path)  # meshio.read would print what is wrong, and end the process
                blocks = [np.insert(b.data, 0, b.data.shape[1], axis=1).ravel() for b in found.cells]
                poly = pv.PolyData(found.points.astype(float), np.concatenate(blocks))
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


def _merge_points(surface: Surface) -> Surface:
    """Merge points that coincide exactly (STL repeats them), and drop faces that collapse."""
    points, inverse = np.unique(surface.points, axis=0, return_inverse=True)
    faces = inverse.ravel()[surface.faces]
    a, b, c = faces.T
    return remove_unused_points(Surface(points, faces[(a != b) & (b != c) & (c != a)]))


def write_surface(path: str | Path, surface: Surface) -> None:
    """Write .stl (binary), .ply, .vtp, .obj or .3mf by the suffix, in LPS mm; the file says so."""
    path = Path(path)
    kind = path.suffix.lower()
    with silence_vtk(), add_location(file=path):
        _check_suffix(path, SUFFIXES[:-1])
        if kind == ".3mf":
            trimesh = _import_3mf()
            mesh = trimesh.Trimesh(surface.points, surface.faces, process=False)
            trimesh.Scene({path.stem: mesh}).export(path)  # in millimetres, as it says
            return
        poly = surface.to_pyvista()
        if kind == ".vtp":
            poly.field_data["SPACE"], poly.field_data["UNIT"] = ["LPS"], ["mm"]
        poly.save(str(path), recompute_normals=False)
        if kind != ".vtp":
            _state_in_header(path, kind)


def _state_in_header(path: Path, kind: str) -> None:
    """Say unit and space in the header that VTK wrote."""
    words = b"limbfit UNIT=mm SPACE=LPS"
    content = path.read_bytes()
    if kind == ".stl":
        content = words.ljust(80) + content[80:]
    elif kind == ".ply":
        content = content.replace(b"comment VTK generated PLY File", b"comment " + words, 1)
    else:
        content = b"# " + words + b"\n" + content
    path.write_bytes(content)
