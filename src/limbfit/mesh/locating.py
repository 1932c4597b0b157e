"""Where a point or a line lies in a mesh: the cell of a point, and how thick regions are along a line.

A line meets faces between regions; the points of these faces are followed as material points. What the
thickness of a region loses is then a fixed linear function of the nodal displacements: a gauge.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..arrays import Array, Indices
from ..errors import ProblemError
from .cells import linear_simplex, quadratic_simplex
from .volume import Mesh

MAX_CANDIDATES = 24  # cells that are looked at, by their middles
_STEPS = 8  # of Newton's iteration; one is enough where edges are straight and cells are tetrahedra
_MAX_LOCAL = 4.0  # local coordinates that mean nothing any more
_ON_EDGE = 1e-9  # in local coordinates: a line through an edge meets the faces on both sides
_SAME_MM = 1e-6


def locate(mesh: Mesh, points: Array, region: int) -> tuple[Indices, Array, Array]:
    """Cells (k,) of a region that hold ``points`` (k, 3), mm, or come nearest to that.

    Raises `ProblemError` where no cell is of that region.

    Returns
    -------
    cells : (k,) their numbers.
    local : (k, 3) local coordinates of the points, moved into the cell where they are out of it.
    off_mm : (k,) how far they were moved.
    """
    candidates = np.flatnonzero(mesh.regions == region)
    if not len(candidates):
        what = f"the mesh has no cell of {mesh.region_names[region]}"
        raise ProblemError(what, remedy="mesh the site anew")
    middles = mesh.points[mesh.corners[candidates]].mean(axis=1)
    found = []
    for point in points:
        near = candidates[np.argsort(np.linalg.norm(middles - point, axis=1))[:MAX_CANDIDATES]]
        inside = _find_local_coordinates(mesh, near, point)
        values, _ = mesh.kind.shape(inside)
        away = np.linalg.norm(np.einsum("mk,mki->mi", values, mesh.points[mesh.cells[near]]) - point, axis=1)
        best = int(np.argmin(away))
        found.append((near[best], inside[best], away[best]))
    cells, local, off = map(np.array, zip(*found, strict=True))
    return cells, local, off


def _find_local_coordinates(mesh: Mesh, cells: Indices, point: Array) -> Array:
    """Local coordinates (m, 3) of a point in each of the cells (m,), moved into the cell."""
    corners = mesh.points[mesh.cells[cells]]
    middle = mesh.kind.nodes[: mesh.kind.corners].mean(axis=0)
    x = np.tile(middle, (len(cells), 1))
    for _ in range(_STEPS):
        values, slopes = mesh.kind.shape(x)
        missed = point - np.einsum("mk,mki->mi", values, corners)
        x = x + np.linalg.solve(np.einsum("mki,mkj->mij", corners, slopes), missed[..., None])[..., 0]
        x = np.clip(x, -_MAX_LOCAL, _MAX_LOCAL)
    if not mesh.kind.is_tetrahedron:
        return np.asarray(np.clip(x, -1.0, 1.0))
    shares = np.column_stack([1.0 - x.sum(axis=1), x]).clip(0.0)
    return np.asarray((shares / shares.sum(axis=1, keepdims=True))[:, 1:])


@dataclass(frozen=True)
class Gauge:
    """A length that displacements u (n, 3) of all nodes change by ``weights @ (u[nodes] @ along)``.

    ``nodes`` and ``weights`` are (k,), ``along`` (3,) is a unit vector.
    """

    nodes: Indices
    weights: Array
    along: Array

    def read(self, field: Array) -> Array:
        """The change (...) in a nodal field (n, 3, ...), such as displacements, mm, or their derivatives."""
        return np.asarray(self.weights @ np.tensordot(self.along, field[self.nodes], (0, 1)))


@dataclass(frozen=True)
class LayerGauge(Gauge):
    """How much thinner one region becomes along a line than its ``thickness_mm`` at rest."""

    region: str
    thickness_mm: float


@dataclass(frozen=True)
class _Crossing:
    """Where the line meets a face: so far along it (mm), from region ``above`` into ``below`` (-1: outside).

    ``weights`` (j,) interpolate between the face's ``nodes`` (j,).
    """

    along_mm: float
    above: int
    below: int
    nodes: Indices
    weights: Array


def find_gauges_along(mesh: Mesh, origin: Array, axis: Array) -> tuple[LayerGauge, ...]:
    """A gauge of each region that a line meets, from where it enters the mesh nearest to ``origin``.

    It ends where the line first leaves the mesh: at bone, which is hollow, or at the other side. Of a region
    that is met twice, as skin is where the line passes no bone, the first part counts. Curved faces are met
    as the flat triangles of their corners, and quadrilaterals as two. The line is given by a point (3,) in
    mm, and the direction (3,) in which regions are met. Raises `ProblemError` where it does not enter the
    mesh.
    """
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    crossings = _find_crossings(mesh, np.asarray(origin, dtype=float), axis)
    entries = [k for k, crossing in enumerate(crossings) if crossing.above < 0]
    if not entries:
        raise ProblemError("no tissue lies under the indenter's axis", remedy="check the site's position")
    first = min(entries, key=lambda k: abs(crossings[k].along_mm))
    end = next((k for k in range(first + 1, len(crossings)) if crossings[k].below < 0), None)
    if end is None:
        raise ProblemError("the mesh under the indenter is not closed", remedy="mesh the site anew")
    spans: dict[int, tuple[_Crossing, _Crossing]] = {}
    for top, bottom in pairwise(crossings[first : end + 1]):
        spans.setdefault(top.below, (top, bottom))
    gauges = []
    for region, (top, bottom) in spans.items():
        weights: Array = np.concatenate([top.weights, -bottom.weights])
        nodes, place = np.unique(np.concatenate([top.nodes, bottom.nodes]), return_inverse=True)
        weights = np.bincount(place, weights).astype(np.float64)
        thickness = bottom.along_mm - top.along_mm
        gauges.append(LayerGauge(nodes, weights, axis, mesh.region_names[region], thickness))
    return tuple(gauges)


def _find_crossings(mesh: Mesh, origin: Array, axis: Array) -> list[_Crossing]:
    """Where the line goes from one region into another, in order, each place once."""
    near = _find_cells_at(mesh, origin, axis)
    faces = mesh.cells[near][:, mesh.kind.faces]
    owners = np.repeat(near, faces.shape[1])
    faces = faces.reshape(-1, faces.shape[2])
    corners = np.sort(faces[:, : mesh.kind.face_corners], axis=1)
    _, first, place, counts = np.unique(
        corners, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    last = np.empty(len(first), dtype=np.int64)
    last[place.ravel()] = np.arange(len(faces))
    crossings: list[_Crossing] = []
    for first_face, last_face, count in zip(first, last, counts):
        here, there = mesh.regions[owners[first_face]], mesh.regions[owners[last_face]]
        if count == 1 or here != there:
            outside = -1 if count == 1 else int(there)
            crossings += _intersect_face(mesh, faces[first_face], origin, axis, int(here), outside)
    crossings.sort(key=lambda c: c.along_mm)
    distinct: list[_Crossing] = []
    for crossing in crossings:
        if (
            not distinct
            or crossing.along_mm - distinct[-1].along_mm >= _SAME_MM
            or crossing.below != distinct[-1].below
        ):
            distinct.append(crossing)
    return distinct


def _find_cells_at(mesh: Mesh, origin: Array, axis: Array) -> Indices:
    """Cells (k,) whose corners lie around the line: in a ball about their middle that it meets."""
    corners = mesh.points[mesh.corners]
    middle = corners.mean(axis=1)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    offset = middle - origin
    away = np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1)
    return np.flatnonzero(away <= radius + _SAME_MM)


def _intersect_face(
    mesh: Mesh, face: Indices, origin: Array, axis: Array, inside: int, outside: int
) -> list[_Crossing]:
    """Where the line meets a face that is outward from region ``inside``: nowhere or once."""
    triangles = [[0, 1, 2]] if mesh.kind.face_corners == 3 else [[0, 1, 2], [0, 2, 3]]
    for triangle in triangles:
        a, b, c = mesh.points[face[triangle]]
        normal = np.cross(b - a, c - a)
        slope = float(normal @ axis)
        if abs(slope) <= 1e-12 * np.linalg.norm(normal):
            continue
        along = float(normal @ (a - origin)) / slope
        local = np.linalg.lstsq(np.column_stack([b - a, c - a]), origin + along * axis - a, rcond=None)[0]
        if local.min() < -_ON_EDGE or local.sum() > 1.0 + _ON_EDGE:
            continue
        shape = quadratic_simplex if len(face) == 6 else linear_simplex
        nodes = face if len(face) == 6 else face[triangle]
        weights = shape(local[None])[0][0]
        above, below = (inside, outside) if slope > 0.0 else (outside, inside)
        return [_Crossing(along, above, below, nodes, weights)]
    return []
