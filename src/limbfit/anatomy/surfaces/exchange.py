"""Shapes of limbs and sockets outside a study: told apart in a file, written in another format, or compared.

Two shapes are compared by signed distances, and by circumferences along an axis, after a rigid registration.
"""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from ...arrays import Array, Indices
from ...errors import InputError, SurfaceError, add_location
from ...results.shapes import Circumference, ShapeComparison
from .files import read_parts, read_surface, write_surface
from .mending import find_flat_ends, repair_surface
from .slices import TOLERANCE_MM, Sense, format_slices
from .triangles import (
    Surface,
    close_by_fans,
    cross_edges,
    find_bodies,
    find_half_edges,
    find_open_edges,
    number_components,
    open_loops,
    remove_unused_points,
    stack_surfaces,
)

Direction = Literal["x", "-x", "y", "-y", "z", "-z"]
_DIRECTIONS = {sign + "xyz"[k]: float(sign + "1") * np.eye(3)[k] for k in range(3) for sign in ("", "-")}
SMALLEST_FACES = 100  # of a body; what is smaller is left over from a segmentation
STEP_MM = 20.0  # between circumferences
ROLLS = 8  # of the starts of a registration, around the long axis
_FIRST_ROUNDS, _ROUNDS = (15, 300), (500, 4000)  # and points: of each start, of the best one
_MEAN_MM = 1e-4  # a registration ends where the mean distance changes less


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


def name_bodies(surface: Surface, file: Path) -> dict[str, Indices]:
    """Tell the bodies of a surface apart, by size and place; z is proximal.

    The skin is the largest. Of one bone it is the femur (a thigh), of two tibia and fibula; of four the femur
    is the larger, and the patella the smaller of the two that are higher.

    Raises
    ------
    InputError
        For another number of bodies.
    """
    pieces = number_components(find_half_edges(surface.faces), len(surface.points))[surface.faces[:, 0]]
    bodies = [surface.faces[pieces == one] for one in np.unique(pieces)]
    bodies = [one for one in bodies if len(one) >= SMALLEST_FACES]
    bodies.sort(key=lambda one: -float(np.prod(np.ptp(surface.points[one].reshape(-1, 3), axis=0))))
    skin, *bones = bodies or [np.zeros((0, 3), dtype=np.int64)]
    bones.sort(key=lambda one: float(surface.points[one][..., 2].mean()))
    match len(bones):
        case 1:
            return {"skin": skin, "femur": bones[0]}
        case 2:
            fibula, tibia = sorted(bones, key=len)
            return {"skin": skin, "tibia": tibia, "fibula": fibula}
        case 4:
            (fibula, tibia), (patella, femur) = sorted(bones[:2], key=len), sorted(bones[2:], key=len)
            return {"skin": skin, "femur": femur, "patella": patella, "tibia": tibia, "fibula": fibula}
    raise InputError(
        f"{len(bodies)} bodies, which cannot be told apart",
        file=file,
        remedy="give each limb as a folder with a file for each body: skin.stl, tibia.stl, ...",
    )


def read_body(
    path: str | Path,
    body: str | None = None,
    *,
    unit: str | None = None,
    space: Literal["LPS", "RAS"] | None = None,
    spokes: Sense | None = None,
) -> Surface:
    """A body of a file in LPS mm, all of them where none is named; the others as for `read_parts`.

    ``body``: the name of an object in the file, one of `name_bodies`, or the number from the largest box on.
    Raises `SurfaceError` for a body that is not there, and as `read_parts`.
    """
    parts = read_parts(path, space, unit, spokes=spokes)
    whole = stack_surfaces(list(parts.values()))
    if body is None or body in parts:
        return parts.get(body or "", whole)
    pieces = sorted(find_bodies(whole), key=lambda piece: -float(np.prod(np.ptp(piece.points, axis=0))))
    known = {str(number): piece for number, piece in enumerate(pieces, 1)} | parts
    with suppress(InputError):
        named = name_bodies(whole, Path(path))
        known |= {name: remove_unused_points(Surface(whole.points, faces)) for name, faces in named.items()}
    if body not in known:
        there = ", ".join(filter(None, known))
        raise SurfaceError(f"no body is called {body!r}", file=path, remedy=f"there are {there}")
    return known[body]


def orient_outside(surface: Surface) -> Surface:
    """Look outward; with an open end, away from what it surrounds. Raises `SurfaceError` for several bodies,
    open ends or holes.
    """
    if (count := len(find_bodies(surface))) > 1:
        raise SurfaceError(f"{count} bodies in one file", remedy="choose one by --body: 1 is the largest")
    if (count := len(open_loops(surface))) > 1:
        raise SurfaceError(f"not closed: {count} open ends or holes", remedy="close all but the proximal end")
    return surface if close_by_fans(surface).volume > 0.0 else surface.flipped_surface


def find_axis(surface: Surface, proximal: Array) -> Array:
    """The unit normal of an open or flat end, or the long axis: whichever is nearest to ``proximal`` (3,)."""
    longest = _find_principal_axes(surface)[:, 2]
    open_end = cross_edges(close_by_fans(surface).triangles[len(surface.faces) :]).sum(axis=0)
    ends = [normal for _, normal in find_flat_ends(surface)]
    ends += [open_end / np.linalg.norm(open_end)] if open_end.any() else []
    return max((*ends, longest, -longest), key=lambda axis: float(axis @ proximal))


def _find_principal_axes(surface: Surface) -> Array:
    """Columns: the principal axes of a surface, the longest last, right-handed."""
    axes = np.linalg.eigh(np.cov(surface.triangles.mean(axis=1).T, aweights=surface.face_areas))[1]
    return np.asarray(axes * [np.linalg.det(axes), 1.0, 1.0])


def register_surface(moving: Surface, fixed: Surface) -> Surface:
    """Move a surface rigidly onto another one by iterative closest points (VTK, by pyvista).

    It starts as it lies, and with both long axes on each other, upright and upside down, in 8 rolls.
    """
    from_middle, target = moving.points - moving.points.mean(axis=0), fixed.points.mean(axis=0)
    ours, theirs = _find_principal_axes(moving), _find_principal_axes(fixed)
    angles = [(360.0 * k / ROLLS, flip) for k in range(ROLLS) for flip in (0.0, 180.0)]
    turns = theirs @ Rotation.from_euler("zx", angles, degrees=True).as_matrix() @ ours.T
    starts = [moving.points, *(from_middle @ turn.T + target for turn in turns)]

    def match(points: Array, rounds: int, most: int) -> Array:
        settings = {"max_landmarks": most, "max_iterations": rounds, "max_mean_distance": _MEAN_MM}
        placed: Any = replace(moving, points=points).to_pyvista()
        return np.asarray(
            placed.align(fixed.to_pyvista(), start_by_matching_centroids=False, **settings).points
        )

    found = [match(start, *_FIRST_ROUNDS) for start in starts]
    nearest = min(found, key=lambda points: float(fixed.find_nearest(points)[0].mean()))
    return replace(moving, points=match(nearest, *_ROUNDS))


def measure_distances(here: Surface, there: Surface) -> tuple[Array, Array]:
    """Signed distance (n,) of another surface at the points of an outward one, mm, positive where it lies
    outside, and the area (n,) of these points, mm2.

    NaN and 0 where what is nearest is an open edge or a fan across the opening: no surface lies opposite.
    """
    closed = close_by_fans(there)
    squared, face, foot = closed.find_nearest(here.points)
    side = np.where(np.einsum("ij,ij->i", foot - here.points, here.vertex_normals) < 0.0, -1.0, 1.0)
    is_open = np.isin(closed.faces[face], find_open_edges(there.faces)).any(axis=1)
    return np.where(is_open, np.nan, side * np.sqrt(squared)), np.where(is_open, 0.0, here.vertex_areas)


def compare_surfaces(first: Surface, second: Surface, axis: Array) -> ShapeComparison:
    """Distances, measures, and circumferences of two outward surfaces, LPS mm, along a proximal axis (3,)."""
    one, another = measure_distances(first, second), measure_distances(second, first)
    distance, area = np.append(one[0], -another[0]), np.append(one[1], another[1])
    distance, area = distance[area > 0.0], area[area > 0.0]
    if not area.any():
        raise SurfaceError("the two shapes do not face each other", remedy="add --register")
    return ShapeComparison(
        axis=axis,  # type: ignore[arg-type]
        max_mm=np.abs(distance).max(),
        rms_mm=np.sqrt(np.average(distance**2, weights=area)),
        mean_mm=np.average(distance, weights=area),
        compared_percent=100.0 * area.sum() / (first.area + second.area),
        lengths_mm=(np.ptp(first.points @ axis), np.ptp(second.points @ axis)),
        volumes_cm3=(close_by_fans(first).volume / 1000.0, close_by_fans(second).volume / 1000.0),
        circumferences=list_circumferences(first, second, axis),
    )


def list_circumferences(first: Surface, second: Surface, axis: Array) -> list[Circumference]:
    """Lengths of a tape around sections of two surfaces, every 20 mm over the distal end of the first.

    A tape spans hollows: it has the length of a section's convex hull. None: the section is open, or is none.
    """
    height = first.points @ axis
    rows = []
    for level in np.arange(height.min() + STEP_MM, height.max(), STEP_MM):
        around = [_measure_circumference(one, axis, float(level)) for one in (first, second)]
        rows.append(Circumference(height_mm=level - height.min(), first_mm=around[0], second_mm=around[1]))
    return rows


def _measure_circumference(surface: Surface, axis: Array, level: float) -> float | None:
    section = np.asarray(surface.to_pyvista().slice(normal=axis, origin=level * axis).points)
    ends = [surface.points[loop] @ axis for loop in open_loops(surface)]
    if len(section) < 3 or any(end.min() <= level <= end.max() for end in ends):
        return None
    return float(ConvexHull(section @ np.linalg.svd(axis[None])[2][1:].T).area)
