"""Volume meshes: points, cells, named sets; their quality; VTU on disk."""

from .cells import CELLS, TET10_EDGES, TET_FACES, TRI6_EDGES, CellType
from .gauges import Gauge, LayerGauge, find_gauges_along
from .locating import locate
from .measures import MeshQuality, dihedral_angles, quality
from .volume import (
    Mesh,
    boundary_faces,
    cell_volumes,
    check,
    node_jacobians,
    to_tet10,
)
from .vtu import read_grid, read_vtu, silent_vtk, write_pvd, write_vtu

__all__ = [
    "CELLS",
    "TET10_EDGES",
    "TET_FACES",
    "TRI6_EDGES",
    "CellType",
    "Gauge",
    "LayerGauge",
    "Mesh",
    "MeshQuality",
    "boundary_faces",
    "cell_volumes",
    "check",
    "dihedral_angles",
    "find_gauges_along",
    "locate",
    "node_jacobians",
    "quality",
    "read_grid",
    "read_vtu",
    "silent_vtk",
    "to_tet10",
    "write_pvd",
    "write_vtu",
]
