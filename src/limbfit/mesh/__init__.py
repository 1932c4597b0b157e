"""Volume meshes: points, cells, named sets; their quality; VTU on disk."""

from .cells import TET10_EDGES, TET_FACES
from .locating import Gauge, find_gauges_along, locate
from .volume import (
    Mesh,
    MeshQuality,
    boundary_faces,
    cell_volumes,
    check,
    compute_dihedral_angles,
    measure_quality,
    node_jacobians,
    to_tet10,
)
from .vtu import grid_to_mesh, read_grid, read_vtu, silence_vtk, write_pvd, write_vtu

__all__ = [
    "TET10_EDGES",
    "TET_FACES",
    "Gauge",
    "Mesh",
    "MeshQuality",
    "boundary_faces",
    "cell_volumes",
    "check",
    "compute_dihedral_angles",
    "find_gauges_along",
    "grid_to_mesh",
    "locate",
    "measure_quality",
    "node_jacobians",
    "read_grid",
    "read_vtu",
    "silence_vtk",
    "to_tet10",
    "write_pvd",
    "write_vtu",
]
