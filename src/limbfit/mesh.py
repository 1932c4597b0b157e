"""Volume meshes: points, cells, regions, named sets; quality; VTU on disk.

Vocabulary
----------
points   (n, 3) float64, millimetres, LPS.
cells    (m, k) int64, in VTK order: tet4 (k=4), tet10 (k=10, mid-edge nodes 01 12 20 03 13 23), hex8 (k=8).
regions  (m,) int64, index of each cell into ``region_names``.
node_sets / face_sets  named integer arrays: node indices, and outward-oriented boundary faces
         (3, 6 or 4 nodes each, in VTK order).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import ProblemError

CELL_NODES = {"tet4": 4, "tet10": 10, "hex8": 8}
VTK_CELL = {"tet4": 10, "tet10": 24, "hex8": 12}
TET10_EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
TET_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])  # outward for positive volume
TRI6_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


@dataclass(frozen=True)
class Mesh:
    """An immutable volume mesh; see the module docstring for the arrays."""

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    cell_type: str
    regions: NDArray[np.int64]
    region_names: tuple[str, ...]
    node_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    face_sets: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.cell_type not in CELL_NODES:
            raise ProblemError(f"unknown cell type {self.cell_type!r}; use one of {sorted(CELL_NODES)}")
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise ProblemError(f"mesh points have shape {self.points.shape}, not (n, 3)")
        if self.cells.ndim != 2 or self.cells.shape[1] != CELL_NODES[self.cell_type]:
            raise ProblemError(f"{self.cell_type} cells have shape {self.cells.shape}")
        if len(self.regions) != len(self.cells):
            raise ProblemError(f"{len(self.regions)} region indices for {len(self.cells)} cells")

    @property
    def corners(self) -> NDArray[np.int64]:
        """Corner nodes of each cell: (m, 4) for tetrahedra, (m, 8) for hexahedra."""
        return self.cells[:, : 4 if self.cell_type.startswith("tet") else 8]

    def with_points(self, points: NDArray[np.float64]) -> Mesh:
        return replace(self, points=points)
