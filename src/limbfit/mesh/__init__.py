"""Volume meshes: points, cells, named sets; their quality; VTU on disk."""

from .cells import TET10_EDGES as TET10_EDGES
from .cells import TET_FACES as TET_FACES
from .locating import Gauge as Gauge
from .locating import find_gauges_along as find_gauges_along
from .locating import locate as locate
from .volume import Mesh as Mesh
from .volume import MeshQuality as MeshQuality
from .volume import boundary_faces as boundary_faces
from .volume import cell_volumes as cell_volumes
from .volume import check as check
from .volume import compute_dihedral_angles as compute_dihedral_angles
from .volume import measure_quality as measure_quality
from .volume import node_jacobians as node_jacobians
from .volume import to_tet10 as to_tet10
from .vtu import grid_to_mesh as grid_to_mesh
from .vtu import read_grid as read_grid
from .vtu import read_vtu as read_vtu
from .vtu import silence_vtk as silence_vtk
from .vtu import write_pvd as write_pvd
from .vtu import write_vtu as write_vtu
