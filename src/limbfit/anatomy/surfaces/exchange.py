"""Shapes of limbs and sockets outside a study: written in another format, or compared."""

from pathlib import Path
from typing import Any, Literal

import numpy as np

from ...errors import InputError, add_location
from ...results.shapes import ShapeComparison
from .bodies import read_body
from .comparison import compare_surfaces, find_axis, measure_distances, orient_outside, register_surface
from .files import read_surface, write_surface
from .mending import repair_surface
from .slices import TOLERANCE_MM, format_slices

Direction = Literal["x", "-x", "y", "-y", "z", "-z"]
_DIRECTIONS = {sign + "xyz"[k]: float(sign + "1") * np.eye(3)[k] for k in range(3) for sign in ("", "-")}


def convert_shape(
    source: str | Path,
    target: str | Path,
    *,
    proximal: Direction = "z",
    close: bool = False,
    tolerance_mm: float = TOLERANCE_MM,
    **reading: Any,
) -> dict[str, Any]:
    """Write a surface in another format, in mm and LPS. Returns ``triangles``, ``size_mm``, ``notes``, and
    ``deviation_mm``: how far what was written is from it at most.

    Raises `InputError` for files, units and bodies that are not there, and what slices cannot hold.

    Parameters
    ----------
    source, target : files of .stl, .ply, .obj, .vtp, .3mf or .aop.
    proximal : x, -x, y, -y, z or -z: about the direction towards the body, which slices lie across.
    close : cap its open end, and fill small holes.
    tolerance_mm : by which the slices of an AOP file may deviate.
    reading : ``body`` of a file of several (all of them), by its name, or its number from the largest on;
        ``unit`` (mm, cm, m, inch), ``space`` (LPS, RAS), and ``spokes`` of AOP (clockwise, counter-clockwise,
        seen from the proximal end) where the file does not say them.
    """
    target, up = Path(target), _DIRECTIONS[proximal]
    if target.exists() and target.samefile(source):
        raise InputError("is the file that is read", file=target, remedy="give the new file another name")
    surface, notes = read_body(source, **reading), tuple[str, ...]()
    target.parent.mkdir(parents=True, exist_ok=True)
    with add_location(file=source):
        if close:
            mended = repair_surface(surface, "surface")
            surface, notes = mended.surface, mended.notes
        if target.suffix.lower() == ".aop":
            surface = orient_outside(surface)
            text, deviation = format_slices(surface, find_axis(surface, up), tolerance_mm=tolerance_mm)
            target.write_text(text, encoding="ascii")
        else:
            write_surface(target, surface)
            deviation = float(np.sqrt(read_surface(target).find_nearest(surface.points)[0].max()))
    size = np.ptp(surface.points, axis=0).tolist()
    facts = {"triangles": len(surface.faces), "size_mm": size, "notes": list(notes)}
    return facts | {"deviation_mm": deviation}


def compare_shapes(
    first: str | Path,
    second: str | Path,
    *,
    register: bool = False,
    proximal: Direction = "z",
    map_file: str | Path | None = None,
    **reading: Any,
) -> ShapeComparison:
    """Compare two shapes: distances, volumes, and circumferences every 20 mm along the axis of the first.

    Raises `InputError` as `convert_shape`, for several bodies of which none is chosen, and for holes.

    Parameters
    ----------
    register : move the second rigidly onto the first.
    map_file : a .vtp for the signed distances at the first; positive where the second is outside.
    proximal, reading : as for `convert_shape`, for both files.
    """
    up, shapes, target = _DIRECTIONS[proximal], [], Path(map_file or "none.vtp")
    if target.suffix != ".vtp":
        raise InputError("is no .vtp file", file=target, remedy="give the map a name that ends in .vtp")
    for file in (first, second):
        with add_location(file=file):
            shapes.append(orient_outside(read_body(file, **reading)))
    here, there = shapes[0], register_surface(shapes[1], shapes[0]) if register else shapes[1]
    with add_location(file=second):
        found = compare_surfaces(here, there, find_axis(here, up))
    if map_file is not None:
        mesh = here.to_pyvista()
        mesh.point_data["distance_mm"] = measure_distances(here, there)[0]
        target.parent.mkdir(parents=True, exist_ok=True)
        mesh.save(target)
    return found
