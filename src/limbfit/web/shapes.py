"""Surfaces and tetrahedral meshes as the arrays that scripts draw; lengths in mm, LPS.

A mesh is drawn with straight edges: mid-edge nodes of quadratic cells are left out.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from ..errors import ProblemError
from ..mesh import TET_FACES, Mesh, cell_volumes, compute_dihedral_angles, node_jacobians

Floats = NDArray[np.float32]
Indices = NDArray[np.uint32]
_NO_CELL = -1


@dataclass(frozen=True)
class Shell:
    """Triangles: points (n, 3) float32, faces (m, 3) uint32."""

    points: Floats
    faces: Indices


@dataclass(frozen=True)
class VolumeShape:
    """Tetrahedra, and the faces between them, each once.

    points (n, 3) float32; cells (m, 4) uint32; regions (m,) uint8; ``nodes`` (n,): numbers of the points in
    the mesh; faces (k, 3) uint32, outward from their owner; owners, neighbours (k,): cells on both sides,
    the neighbour -1 (int32) outside.
    """

    points: Floats
    cells: Indices
    regions: NDArray[np.uint8]
    nodes: NDArray[np.int64]
    faces: Indices
    owners: Indices
    neighbours: NDArray[np.int32]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What a script needs, by the names that ``static/volume.js`` expects."""
        names = ("points", "cells", "regions", "faces", "owners", "neighbours")
        return {name: getattr(self, name) for name in names}


def build_patient_frame(cut_normal: ArrayLike | None) -> NDArray[np.float64]:
    """Rows: the patient's left, posterior and proximal direction, the last one along the limb (LPS)."""
    up = np.asarray((0.0, 0.0, 1.0) if cut_normal is None else cut_normal, dtype=float)
    up = up / np.linalg.norm(up)
    back = np.array([0.0, 1.0, 0.0])
    back = back - (back @ up) * up if abs(up[1]) < 0.95 else np.array([0.0, 0.0, 1.0])
    back /= np.linalg.norm(back)
    return np.array([np.cross(back, up), back, up])


def read_shell(file: Path, max_faces: int | None = None) -> Shell:
    """A stored surface, of ``max_faces`` triangles at most; `ProblemError` where the file holds none."""
    surface: Any = pv.read(file)
    surface = surface.triangulate().clean()
    if surface.n_cells == 0:
        raise ProblemError("holds no triangles", file=file, remedy="make the surfaces again")
    if max_faces is not None and surface.n_cells > max_faces:
        surface = surface.decimate(1.0 - max_faces / surface.n_cells)
    return to_shell(surface)


def to_shell(surface: Any) -> Shell:
    """The triangles of a pyvista surface that holds nothing else."""
    faces = np.asarray(surface.faces).reshape(-1, 4)[:, 1:]
    return Shell(np.asarray(surface.points, dtype=np.float32), faces.astype(np.uint32))


def to_volume_shape(mesh: Mesh) -> VolumeShape:
    """A mesh of tetrahedra to draw; `ProblemError` for hexahedra, or a face of more than two cells."""
    if not mesh.kind.is_tetrahedron:
        raise ProblemError("only meshes of tetrahedra are drawn, not of hexahedra")
    nodes, cells = np.unique(mesh.cells[:, :4], return_inverse=True)
    cells = cells.reshape(-1, 4)
    faces, owners, neighbours = _build_face_table(cells, len(nodes))
    return VolumeShape(
        points=mesh.points[nodes].astype(np.float32),
        cells=cells.astype(np.uint32),
        regions=mesh.regions.astype(np.uint8),
        nodes=nodes,
        faces=faces.astype(np.uint32),
        owners=owners.astype(np.uint32),
        neighbours=neighbours.astype(np.int32),
    )


def _build_face_table(cells: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], ...]:
    faces = cells[:, TET_FACES].reshape(-1, 3)
    low, middle, high = np.sort(faces, axis=1).T
    keys = (low * count + middle) * count + high
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(keys[order]) != 0])
    sizes = np.diff(np.r_[starts, len(order)])
    if sizes.max() > 2:
        raise ProblemError("a face of the mesh belongs to more than two cells")
    owners = order[starts] // 4
    second = order[np.minimum(starts + 1, len(order) - 1)] // 4
    return faces[order[starts]], owners, np.where(sizes == 2, second, _NO_CELL)


def extract_interface(volume: VolumeShape, region: int) -> Shell:
    """The faces between the regions up to ``region`` (layers, outermost first) and those beyond."""
    inside = volume.neighbours != _NO_CELL
    near = volume.regions[volume.owners] <= region
    far = np.where(inside, volume.regions[volume.neighbours], 0) <= region
    chosen = inside & (near != far)
    points, faces = np.unique(volume.faces[chosen], return_inverse=True)
    return Shell(volume.points[points], faces.reshape(-1, 3).astype(np.uint32))


def compute_cell_quality(mesh: Mesh) -> dict[str, Floats]:
    """Of each cell: its smallest dihedral angle (degrees), scaled Jacobian (-) and volume (mm3)."""
    jacobians = node_jacobians(mesh)
    scaled = jacobians.min(axis=1) / np.abs(jacobians.mean(axis=1))
    measures = {
        "min_dihedral_deg": compute_dihedral_angles(mesh.points, mesh.cells[:, :4]).min(axis=1),
        "scaled_jacobian": scaled,
        "volume_mm3": cell_volumes(mesh),
    }
    return {name: values.astype(np.float32) for name, values in measures.items()}
