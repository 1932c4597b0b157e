"""Closed triangle surfaces: the type, the search for nearest points, and whether one may bound a body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pyvista as pv
from igl.predicates import find_self_intersections
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from vtkmodules.vtkCommonCore import vtkIdList, vtkPoints
from vtkmodules.vtkCommonDataModel import vtkStaticCellLocator

from ...arrays import Array, Indices
from ...errors import SurfaceError, add_location
from ..grid import format_place

# Diagonals of the bounding box: a limb and a bone from a file are larger; in inches or centimetres they are
# not. What is left of a bone after a virtual amputation may be small.
_SMALLEST_MM = {"skin": 60.0, "tibia": 30.0, "fibula": 30.0, "femur": 30.0}
_SMALLEST_OTHER_MM = 15.0
_LARGEST_MM = 3000.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles in LPS mm: ``points`` (n, 3), ``faces`` (m, 3), counter-clockwise seen from outside.

    Neither may be changed in place: the trees for nearest points and distances would not follow.
    """

    points: Array
    faces: Indices

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.asarray(self.points, dtype=np.float64))
        object.__setattr__(self, "faces", np.asarray(self.faces, dtype=np.int64))

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the trees, which cannot be sent to another process."""
        return {"points": self.points, "faces": self.faces}

    @cached_property
    def _contiguous_arrays(self) -> tuple[Array, Indices]:
        """Points and faces as libigl takes them."""
        return np.ascontiguousarray(self.points), np.ascontiguousarray(self.faces)

    @cached_property
    def _boxes(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(*self._contiguous_arrays)
        return tree

    @cached_property
    def _windings(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(*self._contiguous_arrays)
        return tree

    def find_nearest(self, points: ArrayLike) -> tuple[Array, Indices, Array]:
        """Squared distance (k,) of points (k, 3), mm^2, the nearest face (k,), and where on it (k, 3)."""
        query = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(query):
            return np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        squared, face, foot = self._boxes.squared_distance(*self._contiguous_arrays, query)
        return squared, face, foot

    def find_signed(self, points: ArrayLike) -> tuple[Array, Indices, Array]:
        """As `find_nearest`, with the distance (k,) to a closed outward surface, mm, negative inside.

        Inside is where the fast winding number says so (Barill et al. 2018, ACM Trans Graph 37, 43), which
        small holes and crossing faces do not mislead.
        """
        squared, face, foot = self.find_nearest(points)
        if not len(face):
            return squared, face, foot
        query = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
        inside = self._windings.winding_number(query) > 0.5
        return np.where(inside, -1.0, 1.0) * np.sqrt(squared), face, foot

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance (k,) of points (k, 3) to a closed outward surface, mm, negative inside."""
        return self.find_signed(points)[0]

    def find_ray_hits(self, starts: Array, directions: Array) -> list[Array]:
        """Distances, ascending, at which rays from points (n, 3) along unit vectors (n, 3) meet it, mm."""
        locator = vtkStaticCellLocator()
        locator.SetDataSet(self.to_pyvista())
        locator.BuildLocator()
        far = 2.0 * float(np.linalg.norm(np.ptp(np.vstack([self.points, starts]), axis=0)))
        hits, cells = vtkPoints(), vtkIdList()
        hits.SetDataTypeToDouble()
        found = []
        for start, direction in zip(starts, directions):
            locator.IntersectWithLine(start, start + far * direction, 1e-6, hits, cells)
            met = [(np.array(hits.GetPoint(i)) - start) @ direction for i in range(hits.GetNumberOfPoints())]
            found.append(np.sort(np.array(met)))
        return found

    @cached_property
    def self_intersections(self) -> Indices:
        """(p, 2) pairs of faces without a common point of which an edge of one pierces the other."""
        _, pairs, coplanar = find_self_intersections(*self._contiguous_arrays)
        pairs = np.sort(pairs[~coplanar.astype(bool).ravel()], axis=1)
        first, second = self.faces[pairs[:, 0]], self.faces[pairs[:, 1]]
        apart = ~(first[:, :, None] == second[:, None, :]).any(axis=(1, 2))
        return np.unique(pairs[apart], axis=0)

    @property
    def triangles(self) -> Array:
        """(m, 3, 3) corner points of each face."""
        return self.points[self.faces]

    @property
    def face_areas(self) -> Array:
        """(m,) mm2."""
        return np.linalg.norm(cross_edges(self.triangles), axis=1) / 2

    @property
    def face_normals(self) -> Array:
        """(m, 3) unit outward normals; zero for a degenerate face."""
        return _normalise_rows(cross_edges(self.triangles))

    @property
    def vertex_areas(self) -> Array:
        """(n,) a third of the faces around each vertex, mm2."""
        areas = np.bincount(self.faces.ravel(), np.repeat(self.face_areas / 3, 3), len(self.points))
        return np.asarray(areas, dtype=np.float64)

    @property
    def area(self) -> float:
        """mm2."""
        return float(self.face_areas.sum())

    @property
    def volume(self) -> float:
        """Enclosed volume in mm3 by the divergence theorem; negative if the faces look inward."""
        triangles = self.triangles - self.points.mean(axis=0)
        return float(np.linalg.det(triangles).sum() / 6)

    @property
    def vertex_normals(self) -> Array:
        """(n, 3) unit normals, the faces around a vertex weighted by area."""
        normals, vectors = np.zeros_like(self.points), cross_edges(self.triangles)
        for corner in range(3):
            np.add.at(normals, self.faces[:, corner], vectors)
        return _normalise_rows(normals)

    @property
    def flipped_surface(self) -> Surface:
        """The same surface seen from the other side."""
        return replace(self, faces=self.faces[:, ::-1])

    @property
    def outward_surface(self) -> Surface:
        """The same closed surface with its faces looking outward."""
        return self if self.volume > 0.0 else self.flipped_surface

    def to_pyvista(self) -> pv.PolyData:
        faces: Any = self.faces  # pyvista's stubs know no int64
        return pv.PolyData.from_regular_faces(self.points, faces)


def cross_edges(triangles: Array) -> Array:
    """Vectors (m, 3) along the normals of triangles (m, 3, 3), twice as long as their areas."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.cross(b - a, c - a)


def _normalise_rows(vectors: Array) -> Array:
    """Unit vectors (n, 3); those of no length stay zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def from_pyvista(poly: pv.PolyData) -> Surface:
    """A surface from triangulated poly-data; points that no face uses are dropped."""
    faces = np.asarray(poly.regular_faces, dtype=np.int64).reshape(-1, 3)
    return remove_unused_points(Surface(np.asarray(poly.points), faces))


def remove_unused_points(surface: Surface) -> Surface:
    """Return the surface without the points that no face uses."""
    used, inverse = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.points[used], inverse.reshape(surface.faces.shape))


def stack_surfaces(parts: Sequence[Surface]) -> Surface:
    """Surfaces side by side in one."""
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts)]
    return Surface(np.concatenate([part.points for part in parts]), np.concatenate(faces))


def find_bodies(surface: Surface) -> list[Surface]:
    """The connected bodies of a surface, the one with most faces first."""
    pieces = number_components(find_half_edges(surface.faces), len(surface.points))
    labels = pieces[surface.faces[:, 0]]
    values, counts = np.unique(labels, return_counts=True)
    order = values[np.argsort(-counts)]
    return [remove_unused_points(replace(surface, faces=surface.faces[labels == value])) for value in order]


def find_half_edges(faces: Indices) -> Indices:
    """(3 m, 2) directed edges of the faces."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def find_open_edges(faces: Indices) -> Indices:
    """(k, 2) directed edges of the faces (m, 3) that no other face shares."""
    edges = find_half_edges(faces)
    _, inverse, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    return edges[counts[inverse.ravel()] == 1]


def open_loops(surface: Surface) -> list[Indices]:
    """Points of each loop in the order of its faces' edges; loops that touch in a point are taken apart."""
    following: dict[int, list[int]] = {}
    for start, end in find_open_edges(surface.faces).tolist():
        following.setdefault(start, []).append(end)
    loops = []
    while following:
        way = [next(iter(following))]
        while following.get(way[-1]):
            here = following[way[-1]].pop()
            if not following[way[-1]]:
                del following[way[-1]]
            if here in way:
                at = way.index(here)
                loops.append(np.array(way[at:]))
                way = way[: at + 1]
            else:
                way.append(here)
        following.pop(way[-1], None)
    return loops


def close_by_fans(surface: Surface) -> Surface:
    """An open surface with each of its openings closed by a fan around the opening's middle."""
    points, faces = [surface.points], [surface.faces]
    for count, loop in enumerate(open_loops(surface)):
        middle = np.full(len(loop), len(surface.points) + count)
        points.append(surface.points[loop].mean(axis=0)[None])
        faces.append(np.column_stack([np.roll(loop, -1), loop, middle]))
    return Surface(np.vstack(points), np.vstack(faces))


def has_turned_faces(faces: Indices) -> bool:
    """True if two faces (m, 3) run along an edge in the same direction."""
    edges = find_half_edges(faces)
    return len(np.unique(edges, axis=0)) < len(edges)


def number_components(edges: Indices, count: int) -> Indices:
    """The number (count,) of the connected piece that each of the nodes belongs to, by the edges (k, 2)."""
    graph = coo_array((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def check_closed(
    surface: Surface, name: str = "skin", file: str | Path | None = None, *, smallest_mm: float | None = None
) -> None:
    """Refuse a surface that does not bound a body.

    Raises `SurfaceError` for one that is open, non-manifold, inconsistently or inwardly oriented, in several
    bodies, of a size that only another unit explains, or crossing itself.

    Parameters
    ----------
    surface : LPS mm.
    name : ``skin`` or the bone's; a skin is expected to be as large as a limb.
    file : for the error's text.
    smallest_mm : least diagonal of its box; by default as large as such a body from a file is.
    """
    if smallest_mm is None:
        smallest_mm = _SMALLEST_MM.get(name, _SMALLEST_OTHER_MM) if file or name == "skin" else 0.0
    with add_location(file=file):
        _check_size(surface, name, smallest_mm)
        open_edges = len(find_open_edges(surface.faces))
        if open_edges:
            raise SurfaceError(
                f"{name}: the surface is open, {open_edges} edges have a face on one side only",
                remedy="close its holes",
            )
        check_sides(surface, name)
        parts = len(find_bodies(surface))
        if parts > 1:
            raise SurfaceError(
                f"{name}: {parts} separate bodies in one surface", remedy="keep one closed body in each file"
            )
        if surface.volume <= 0:
            raise SurfaceError(
                f"{name}: the surface is inverted, its faces look inward",
                remedy="flip the normals so that they point outward",
            )
        crossing = surface.self_intersections
        if len(crossing):
            place = format_place(surface.triangles[crossing[0, 0]].mean(axis=0))
            raise SurfaceError(
                f"{name}: the surface crosses itself ({len(crossing)} pairs of faces, the first at {place})",
                remedy="remesh, smooth or repair it",
            )


def _check_size(surface: Surface, name: str, smallest: float) -> None:
    if len(surface.faces) < 4:
        raise SurfaceError(f"{name}: only {len(surface.faces)} faces")
    diagonal = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    if diagonal < smallest or diagonal > _LARGEST_MM:
        units = "metres, centimetres or inches" if diagonal < smallest else "another unit"
        raise SurfaceError(
            f"{name}: {diagonal:.3g} mm from end to end",
            remedy=f"if it is in {units}, say so (surfaces.unit in study.toml) or scale it to millimetres",
        )


def check_sides(surface: Surface, name: str) -> None:
    """Refuse a surface, open or closed, whose triangles do not agree on a side. Raises `SurfaceError` for
    edges of more than two faces, and for neighbours that are oriented against each other.
    """
    edges = find_half_edges(surface.faces)
    counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    if counts.max() > 2:
        raise SurfaceError(
            f"{name}: {int((counts > 2).sum())} edges join more than two faces",
            remedy="remove inner walls and doubled faces",
        )
    if has_turned_faces(surface.faces):
        raise SurfaceError(
            f"{name}: neighbouring faces are oriented against each other",
            remedy="orient the normals consistently outward",
        )
