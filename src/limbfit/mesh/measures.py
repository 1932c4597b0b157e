"""Quality of a mesh: angles, volumes, Jacobians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cells import TET_FACES
from .volume import Mesh, cell_volumes, node_jacobians


@dataclass(frozen=True)
class MeshQuality:
    """Element quality of a mesh; angles in degrees, volumes in mm3.

    Dihedral angles are those of the straight tetrahedra (NaN for hexahedra); the scaled Jacobian is the
    smallest determinant over an element's nodes divided by its mean, 1 for every straight tetrahedron.
    """

    min_dihedral_deg: float
    dihedral_percentiles_deg: Mapping[str, float]
    max_dihedral_deg: float
    volume_mm3: float
    region_volumes_mm3: Mapping[str, float]
    min_cell_volume_mm3: float
    min_scaled_jacobian: float
    inverted: int


def measure_quality(mesh: Mesh) -> MeshQuality:
    """Quality of a mesh; ``inverted`` counts cells whose Jacobian is not positive at some node."""
    size = cell_volumes(mesh)
    jacobians = node_jacobians(mesh)
    scaled = jacobians.min(axis=1) / np.abs(jacobians.mean(axis=1))
    angles = (
        compute_dihedral_angles(mesh.points, mesh.cells[:, :4])
        if mesh.kind.is_tetrahedron
        else np.full((1, 6), np.nan)
    )
    smallest = angles.min(axis=1)
    marks = (0.1, 1, 5, 50)
    return MeshQuality(
        min_dihedral_deg=float(smallest.min()),
        dihedral_percentiles_deg={f"{q:g}": float(np.percentile(smallest, q)) for q in marks},
        max_dihedral_deg=float(angles.max()),
        volume_mm3=float(size.sum()),
        region_volumes_mm3={
            name: float(size[mesh.regions == index].sum()) for index, name in enumerate(mesh.region_names)
        },
        min_cell_volume_mm3=float(size.min()),
        min_scaled_jacobian=float(scaled.min()),
        inverted=int((jacobians.min(axis=1) <= 0).sum()),
    )


def compute_dihedral_angles(points: NDArray[np.float64], tets: NDArray[np.int64]) -> NDArray[np.float64]:
    """The six dihedral angles (m, 6) of straight tetrahedra (m, 4), in degrees."""
    corners = points[tets]
    faces = corners[:, TET_FACES]
    normals = np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    first, second = np.triu_indices(4, 1)
    cosines = np.einsum("mij,mij->mi", normals[:, first], normals[:, second])
    return np.degrees(np.arccos(np.clip(-cosines, -1.0, 1.0)))
