"""The bodies of a limb in one surface, told apart by size and place, and one of them out of a file."""

from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from ...arrays import Indices
from ...errors import InputError, SurfaceError
from .files import read_parts
from .slices import Sense
from .triangles import (
    Surface,
    find_bodies,
    find_half_edges,
    number_components,
    remove_unused_points,
    stack_surfaces,
)

SMALLEST_FACES = 100  # of a body; what is smaller is left over from a segmentation


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
