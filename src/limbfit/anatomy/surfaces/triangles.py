"""Closed triangle surfaces: the type, the search for nearest points, and whether one may bound a body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...arrays import Array, Indices, Mask
from ...errors import SurfaceError

# Diagonals of the bounding box: a limb and a bone from a file are larger; in inches or centimetres they are
# not. What is left of a bone after a virtual amputation may be small.
_SMALLEST_MM = {"skin": 60.0, "tibia": 30.0, "fibula": 30.0, "femur": 30.0}
_SMALLEST_OTHER_MM = 15.0
_LARGEST_MM = 3000.0
_LARGE_RATIO = 4.0  # of the median face's size: larger ones are looked for in pieces
_BATCH = 20_000  # faces whose neighbours are held in memory


@dataclass(frozen=True)
class Surface:
    """Triangles in LPS mm: ``points`` (n, 3), ``faces`` (m, 3), counter-clockwise seen from outside.

    Neither may be changed in place: ``search`` would not follow.
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
    def search(self) -> SurfaceSearch:
        """Its trees for nearest points and signed distances."""
        return SurfaceSearch(self.points, self.faces)

    @cached_property
    def self_intersections(self) -> Indices:
        """(p, 2) pairs of faces without a common point of which an edge of one pierces the other."""
        return _find_crossings(self)

    @property
    def triangles(self) -> Array:
        """(m, 3, 3) corner points of each face."""
        return self.points[self.faces]

    @property
    def face_areas(self) -> Array:
        """(m,) mm2."""
        return np.linalg.norm(self._face_vectors, axis=1) / 2

    @property
    def face_normals(self) -> Array:
        """(m, 3) unit outward normals; zero for a degenerate face."""
        vectors = self._face_vectors
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)

    @property
    def _face_vectors(self) -> Array:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return np.cross(b - a, c - a)

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
        normals = np.zeros_like(self.points)
        for corner in range(3):
            np.add.at(normals, self.faces[:, corner], self._face_vectors)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)

    @property
    def flipped(self) -> Surface:
        """The same surface seen from the other side."""
        return replace(self, faces=self.faces[:, ::-1])

    @property
    def outward(self) -> Surface:
        """The same closed surface with its faces looking outward."""
        return self if self.volume > 0.0 else self.flipped

    def to_pyvista(self) -> pv.PolyData:
        faces: Any = self.faces  # pyvista's stubs know no int64
        return pv.PolyData.from_regular_faces(self.points, faces)


def from_pyvista(poly: pv.PolyData) -> Surface:
    """A surface from triangulated poly-data; points that no face uses are dropped."""
    return remove_unused_points(
        Surface(np.asarray(poly.points), np.asarray(poly.regular_faces, dtype=np.int64))
    )


def remove_unused_points(surface: Surface) -> Surface:
    """Return the surface without the points that no face uses."""
    used, inverse = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.points[used], inverse.reshape(surface.faces.shape))


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


def has_turned_faces(faces: Indices) -> bool:
    """True if two faces (m, 3) run along an edge in the same direction."""
    edges = find_half_edges(faces)
    return len(np.unique(edges, axis=0)) < len(edges)


def number_components(edges: Indices, count: int) -> Indices:
    """The number (count,) of the connected piece that each of the nodes belongs to, by the edges (k, 2)."""
    graph = coo_array((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def check_closed(
    surface: Surface,
    name: str = "skin",
    file: str | Path | None = None,
    *,
    smallest_mm: float | None = None,
) -> None:
    """Refuse a surface that does not bound a body.

    Parameters
    ----------
    surface : LPS mm.
    name : ``skin`` or the bone's; a skin is expected to be as large as a limb.
    file : for the error's text.
    smallest_mm : least diagonal of its box; by default as large as such a body from a file is.

    Raises
    ------
    SurfaceError
        Open, non-manifold, inconsistently or inwardly oriented, several bodies, of a size that only another
        unit explains, or crossing itself.
    """
    if smallest_mm is None:
        smallest_mm = _SMALLEST_MM.get(name, _SMALLEST_OTHER_MM) if file or name == "skin" else 0.0
    _check_size(surface, name, file, smallest_mm)
    open_edges = len(find_open_edges(surface.faces))
    if open_edges:
        raise SurfaceError(
            f"{name}: the surface is open, {open_edges} edges have a face on one side only",
            file=file,
            remedy="close its holes",
        )
    check_sides(surface, name, file)
    parts = len(find_bodies(surface))
    if parts > 1:
        raise SurfaceError(
            f"{name}: {parts} separate bodies in one surface",
            file=file,
            remedy="keep one closed body in each file",
        )
    if surface.volume <= 0:
        raise SurfaceError(
            f"{name}: the surface is inverted, its faces look inward",
            file=file,
            remedy="flip the normals so that they point outward",
        )
    crossing = surface.self_intersections
    if len(crossing):
        place = ", ".join(f"{x:.1f}" for x in surface.triangles[crossing[0, 0]].mean(axis=0))
        raise SurfaceError(
            f"{name}: the surface crosses itself ({len(crossing)} pairs of faces, the first at ({place}) mm)",
            file=file,
            remedy="remesh, smooth or repair it",
        )


def _check_size(surface: Surface, name: str, file: str | Path | None, smallest: float) -> None:
    if len(surface.faces) < 4:
        raise SurfaceError(f"{name}: only {len(surface.faces)} faces", file=file)
    diagonal = float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    if diagonal < smallest or diagonal > _LARGEST_MM:
        units = "metres, centimetres or inches" if diagonal < smallest else "another unit"
        raise SurfaceError(
            f"{name}: {diagonal:.3g} mm from end to end",
            file=file,
            remedy=f"if it is in {units}, say so (surfaces.unit in study.toml) or scale it to millimetres",
        )


def check_sides(surface: Surface, name: str, file: str | Path | None = None) -> None:
    """Refuse a surface, open or closed, whose triangles do not agree on a side.

    Raises
    ------
    SurfaceError
        For edges of more than two faces, and for neighbours that are oriented against each other.
    """
    edges = find_half_edges(surface.faces)
    counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    if counts.max() > 2:
        raise SurfaceError(
            f"{name}: {int((counts > 2).sum())} edges join more than two faces",
            file=file,
            remedy="remove inner walls and doubled faces",
        )
    if has_turned_faces(surface.faces):
        raise SurfaceError(
            f"{name}: neighbouring faces are oriented against each other",
            file=file,
            remedy="orient the normals consistently outward",
        )


def _find_crossings(surface: Surface) -> Indices:
    pairs = _find_near_pairs(surface)
    triangles = surface.triangles
    crossing = np.zeros(len(pairs), dtype=bool)
    for first, second in ((0, 1), (1, 0)):
        a, b = triangles[pairs[:, first]], triangles[pairs[:, second]]
        for corner in range(3):
            crossing |= _find_piercing(a[:, corner], a[:, (corner + 1) % 3], b)
    return pairs[crossing]


def _find_near_pairs(surface: Surface) -> Indices:
    """Pairs (p, 2) of faces that share no point and may cross: bounding boxes of pieces of them overlap.

    Pieces whose spheres meet are looked up in trees, one for each octave of sizes, some pieces at a time.
    """
    owner, pieces = _split_large(surface.triangles)
    low, high, centre = pieces.min(axis=1), pieces.max(axis=1), pieces.mean(axis=1)
    radius = _compute_radii(pieces)
    octave = np.floor(np.log2(np.maximum(radius, 1e-6 * radius.max()))).astype(int)
    groups = [np.flatnonzero(octave == n) for n in np.unique(octave)]
    trees = [cKDTree(centre[group]) for group in groups]
    found = []
    for n, group in enumerate(groups):
        for part in np.array_split(group, -(-len(group) // _BATCH)):
            tree = cKDTree(centre[part])
            for other, larger in zip(groups[n:], trees[n:]):
                reach = float(radius[part].max() + radius[other].max())
                near = tree.sparse_distance_matrix(larger, reach, output_type="ndarray")
                i, j = part[near["i"]], other[near["j"]]
                apart = np.any((low[i] > high[j]) | (low[j] > high[i]), axis=1)
                found.append(_select_distinct_pairs(owner[i[~apart]], owner[j[~apart]], surface.faces))
    return np.unique(np.concatenate(found), axis=0)


def _select_distinct_pairs(i: Indices, j: Indices, faces: Indices) -> Indices:
    """Pairs (p, 2) of faces, the lower number first, each once, without those that share a point."""
    keys = np.unique(np.minimum(i, j) * len(faces) + np.maximum(i, j))
    pairs = np.column_stack(np.divmod(keys, len(faces)))
    first, second = faces[pairs[:, 0]], faces[pairs[:, 1]]
    return pairs[~(first[:, :, None] == second[:, None, :]).any(axis=(1, 2))]


def _split_large(triangles: Array) -> tuple[Indices, Array]:
    """Triangles (m, 3, 3) with the large ones halved until they are of a usual size, and whose each is.

    The flat caps of scans consist of long slivers, to each of which thousands of small faces are near.
    """
    owner = np.arange(len(triangles))
    usual = _LARGE_RATIO * float(np.median(_compute_radii(triangles)))
    owners, pieces = [], []
    while len(owner):
        large = _compute_radii(triangles) > usual
        owners.append(owner[~large])
        pieces.append(triangles[~large])
        owner, triangles = np.repeat(owner[large], 2), _halve(triangles[large])
    return np.concatenate(owners), np.concatenate(pieces)


def _halve(triangles: Array) -> Array:
    """(2 m, 3, 3) halves of triangles (m, 3, 3), cut at the middle of the longest edge."""
    longest = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2).argmax(axis=1)
    order = (longest[:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(triangles, order[:, :, None], axis=1), 1, 0)
    middle = (a + b) / 2
    halves = np.stack([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)], axis=1)
    return halves.reshape(-1, 3, 3)


def _compute_radii(triangles: Array) -> Array:
    """(m,) largest distance of a corner from the centroid."""
    return np.linalg.norm(triangles - triangles.mean(axis=1, keepdims=True), axis=2).max(axis=1)


def _find_piercing(start: Array, end: Array, triangle: Array) -> Mask:
    """True for each segment that passes through the inside of its triangle (signed volumes)."""
    a, b, c = np.moveaxis(triangle, 1, 0)

    def side(p: Array, q: Array, r: Array, s: Array) -> Array:
        return np.einsum("ij,ij->i", np.cross(q - p, r - p), s - p)

    above, below = side(a, b, c, start), side(a, b, c, end)
    u, v, w = side(start, end, a, b), side(start, end, b, c), side(start, end, c, a)
    same = ((u > 0) & (v > 0) & (w > 0)) | ((u < 0) & (v < 0) & (w < 0))
    return same & (above * below < 0)


class SurfaceSearch:
    """The trees of a surface: ``points`` (n, 3) mm and ``faces`` (m, 3), which must not change any more."""

    def __init__(self, points: Array, faces: Indices) -> None:
        self._surface = np.ascontiguousarray(points), np.ascontiguousarray(faces)

    def nearest(self, points: ArrayLike) -> tuple[Array, Indices, Array]:
        """Squared distance (k,) of points (k, 3), mm^2, the nearest face (k,), and where on it (k, 3)."""
        query = _to_query(points)
        if not len(query):
            return np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        squared, face, foot = self._boxes.squared_distance(*self._surface, query)
        return squared, face, foot

    def signed(self, points: ArrayLike) -> tuple[Array, Indices, Array]:
        """As `nearest`, with the distance (k,) to a closed outward surface, mm, negative inside.

        Inside is where the fast winding number says so (Barill et al. 2018, ACM Trans Graph 37, 43), which
        small holes and crossing faces do not mislead.
        """
        squared, face, foot = self.nearest(points)
        if not len(face):
            return squared, face, foot
        inside = self._windings.winding_number(_to_query(points)) > 0.5
        return np.where(inside, -1.0, 1.0) * np.sqrt(squared), face, foot

    @cached_property
    def _boxes(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(*self._surface)
        return tree

    @cached_property
    def _windings(self) -> igl.FastWindingNumberBVH:
        tree = igl.FastWindingNumberBVH()
        tree.init(*self._surface)
        return tree


def _to_query(points: ArrayLike) -> Array:
    return np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
