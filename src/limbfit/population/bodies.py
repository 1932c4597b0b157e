"""Limbs as named bodies with the same triangles in each: read, told apart, and brought into correspondence.

A limb is a file that holds all its bodies, or a folder with a file for each, named for it (``skin.stl``,
``tibia.ply``).  Limbs are in correspondence where their triangles join the same points, in the same order.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..anatomy.surfaces.exchange import name_bodies
from ..anatomy.surfaces.extraction import remesh
from ..anatomy.surfaces.files import SUFFIXES, read_surface
from ..anatomy.surfaces.triangles import Surface, stack_surfaces
from ..arrays import Array, Indices
from ..errors import InputError
from ..extensions import import_extra

ALL = ""  # the name of all bodies together, before they are told apart
TEMPLATE_EDGE_MM = 6.0  # of the limb that is bent onto the others
SAME_POINT_MM = 0.01  # where corners of a file without shared points are one point
# Steps of Amberg et al.: stiffness, weight of landmarks (there are none), weight of normals, iterations.
_STEPS = [(0.02, 0.0, 0.5, 10), (0.01, 0.0, 0.5, 10), (0.002, 0.0, 0.5, 10)]


@dataclass(frozen=True, eq=False)
class LimbBodies:
    """The bodies of a limb: points (n, 3) LPS mm, and of each body, by name, its faces (m, 3) of them."""

    points: Array
    faces: dict[str, Indices]

    def extract(self, name: str) -> Surface:
        """A body by itself; its points are in the order of the limb's."""
        used, local = np.unique(self.faces[name], return_inverse=True)
        return Surface(self.points[used], local.reshape(-1, 3))


def read_bodies(paths: Sequence[Path], unit: str = "mm") -> list[LimbBodies]:
    """Read limbs that are in correspondence.

    Raises `InputError` for limbs whose bodies or triangles differ, and as `read_surface` and `name_bodies`.
    """
    first, *others = [_read_limb(path, unit) for path in paths]
    rounded = np.round(first.points, 6)  # points that coincide are one
    _, where, index = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    merged, index = first.points[where], index.ravel()
    faces = {name: index[own] for name, own in first.faces.items()}
    if ALL in faces:
        faces = name_bodies(Surface(merged, faces[ALL]), paths[0])
    limbs, remedy = [LimbBodies(merged, faces)], "give limbs in correspondence, or add --register"
    for path, limb in zip(paths[1:], others, strict=True):
        alike = [np.array_equal(limb.faces.get(name, ()), own) for name, own in first.faces.items()]
        if len(limb.faces) != len(alike) or not all(alike):
            raise InputError(f"its triangles are not those of {paths[0]}", file=path, remedy=remedy)
        moved = np.zeros_like(merged)
        moved[index] = limb.points
        apart = np.linalg.norm(moved[index] - limb.points, axis=1)
        if apart.max() > SAME_POINT_MM:
            what = f"points that {paths[0]} joins are {apart.max():.2g} mm apart"
            raise InputError(what, file=path, remedy=remedy)
        limbs.append(LimbBodies(moved, faces))
    return limbs


def _read_limb(path: Path, unit: str) -> LimbBodies:
    """Points as the files hold them; the bodies of a folder by the names of its files, else `ALL` as one."""
    if not path.is_dir():
        return _stack_bodies({ALL: read_surface(path, unit=unit, merge=False)})
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError("no surfaces are there", file=path, remedy="give files such as skin.stl, tibia.stl")
    names = [file.stem.removeprefix("bone-") for file in files]
    if "skin" not in names:
        raise InputError("no file is named skin", file=path, remedy="name each file for its body")
    read = [read_surface(file, unit=unit, merge=False) for file in files]
    return _stack_bodies(dict(zip(names, read, strict=True)))


def _stack_bodies(bodies: Mapping[str, Surface]) -> LimbBodies:
    stacked, ends = stack_surfaces(list(bodies.values())), np.cumsum([len(b.faces) for b in bodies.values()])
    return LimbBodies(stacked.points, dict(zip(bodies, np.split(stacked.faces, ends[:-1]), strict=True)))


def register_limbs(paths: Sequence[Path], unit: str = "mm") -> tuple[list[LimbBodies], list[Array]]:
    """Bring limbs into correspondence: the first one, remeshed, is bent onto each of the others.

    The bending is that of Amberg, Romdhani and Vetter (CVPR 2007), by trimesh, body by body. How well each
    limb was met are the distances (n,) of its points from the bent template, mm. Raises `InputError` for
    limbs with other bodies than the first, and as `read_bodies`.
    """
    registration = import_extra("trimesh.registration", "population")
    mesh = import_extra("trimesh", "population").Trimesh
    limbs = [read_bodies([path], unit)[0] for path in paths]
    even = {name: remesh(limbs[0].extract(name), TEMPLATE_EDGE_MM) for name in limbs[0].faces}
    template = _stack_bodies(even)
    found, distances = [], []
    for path, limb in zip(paths, limbs, strict=True):
        odd = sorted(limb.faces.keys() ^ template.faces.keys())
        if odd:
            what = f"only one of it and {paths[0]} has a {odd[0]}"
            raise InputError(what, file=path, remedy="leave it out")
        points, far = template.points.copy(), []
        for name, faces in template.faces.items():
            source, target = template.extract(name), limb.extract(name)
            # It begins stretched along the axes, so that it fills the box of the target.
            share = (source.points - source.points.min(axis=0)) / np.ptp(source.points, axis=0)
            filling = target.points.min(axis=0) + share * np.ptp(target.points, axis=0)
            bent = registration.nricp_amberg(
                mesh(filling, source.faces, process=False),
                mesh(target.points, target.faces, process=False),
                steps=_STEPS,
            )
            points[np.unique(faces)] = bent
            far.append(np.sqrt(Surface(bent, source.faces).find_nearest(target.points)[0]))
        found.append(LimbBodies(points, template.faces))
        distances.append(np.concatenate(far))
    return found, distances
