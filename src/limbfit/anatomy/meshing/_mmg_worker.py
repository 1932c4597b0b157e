"""Runs MMG in a process of its own: a mesher can take the interpreter down with it.

Called as ``python _mmg_worker.py TASK.npz MESH.npz``; imports next to nothing of limbfit, to start quickly.
"""

from __future__ import annotations

import numpy as np
from mmgpy import MmgMesh3D

from limbfit.anatomy.meshing._worker import work

SMALLEST_PART = 0.1  # of the smallest wanted edge: MMG's lower bound where curvature asks for more


def remesh(task: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Adapt a mesh with surface references; the keys are those of ``VolumeTask`` and ``VolumeMesh``."""
    mesh = MmgMesh3D()
    points, tets, triangles = task["points"], task["tets"], task["triangles"]
    mesh.set_mesh_size(vertices=len(points), tetrahedra=len(tets), triangles=len(triangles))
    mesh.set_vertices(points)
    mesh.set_tetrahedra(tets.astype(np.int32), task["regions"].astype(np.int64) + 1)  # MMG keeps 0 for itself
    mesh.set_triangles(triangles.astype(np.int32), task["triangle_refs"].astype(np.int64))
    mesh["metric"] = np.ascontiguousarray(task["size"][:, None])
    mesh.remesh(
        hausd=float(task["hausdorff_mm"]),
        hgrad=-1.0,  # the size field is graded already
        hmin=SMALLEST_PART * float(task["size"].min()),
        hmax=float(task["size"].max()),
        verbose=-1,
    )
    triangles, triangle_refs = mesh.get_triangles_with_refs()
    tets, regions = mesh.get_elements_with_refs()
    return {
        "points": mesh.get_vertices(),
        "tets": tets.astype(np.int64),
        "regions": np.asarray(regions) - 1,
        "triangles": triangles.astype(np.int64),
        "triangle_refs": triangle_refs,
    }


if __name__ == "__main__":
    work(remesh)
