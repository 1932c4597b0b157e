"""Blocks of layered tissue under a square punch as sites of a study: real solving without the mesher."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from limbfit.bench.blocks import SIX_TETS, boxes, upright
from limbfit.indentation import SiteModel
from limbfit.mesh import Mesh, boundary_faces, to_tet10, write_vtu
from limbfit.study import SolverTable

TISSUES = ("skin", "fat", "muscle")
TRUTH = {
    "skin": {"c_kPa": 12.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "fat": {"c_kPa": 2.0, "m": 4.0, "gamma": 1.0, "tau_s": 1.2},
    "muscle": {"c_kPa": 5.0, "m": 5.0, "gamma": 3.0, "tau_s": 0.3},
}


def layered_block(
    thickness_mm: Sequence[float], tissues: Sequence[str] = TISSUES, half_mm: float = 24.0, divisions: int = 4
) -> Mesh:
    """A block of quadratic tetrahedra whose top is z = 0; ``thickness_mm`` of each tissue, outermost first.

    Node set ``fixed_bottom``, face set ``skin`` (the whole top).
    """
    side = np.linspace(-half_mm, half_mm, divisions + 1)
    ends = -np.concatenate([[0.0], np.cumsum(thickness_mm)])
    lines = [np.linspace(a, b, max(round((a - b) / 8.0), 1), endpoint=False) for a, b in pairwise(ends)]
    z = np.concatenate([*lines, ends[-1:]])[::-1]
    points, corners = boxes(side, side, z)
    cells = upright(points, corners[:, SIX_TETS].reshape(-1, 4))
    depth = -points[cells][:, :, 2].mean(axis=1)
    regions = np.searchsorted(np.cumsum(thickness_mm)[:-1], depth)
    mesh = Mesh(points, cells, "tet4", regions, tuple(tissues))
    faces = boundary_faces(mesh)
    top = faces[(points[faces][:, :, 2] >= 0.0).all(axis=1)]
    bottom = np.flatnonzero(points[:, 2] <= ends[-1])
    return to_tet10(
        Mesh(points, cells, "tet4", regions, tuple(tissues), {"fixed_bottom": bottom}, {"skin": top})
    )


def block_model(name: str, file: Path, mesh: Mesh, depth_mm: float, steps: SolverTable) -> SiteModel:
    """A site on a block, its mesh stored in ``file``; in and out at 0.96 mm/s."""
    write_vtu(mesh, file)
    ramp = depth_mm / 0.96
    return SiteModel(
        name=name,
        mesh=file,
        mesh_digest=name,
        position=(0.0, 0.0, 0.0),
        axis=(0.0, 0.0, -1.0),
        knots_s=(0.0, ramp, 2 * ramp),
        knots_mm=(0.0, depth_mm, 0.0),
        steps=steps,
    )
