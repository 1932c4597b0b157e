"""Runs Netgen in a process of its own: a mesher can take the interpreter down with it.

Called as ``python _netgen_worker.py TASK.npz MESH.npz``; imports next to nothing of limbfit, for its start.
MMG remeshes the surface alone to the wanted edges; Netgen fills it and does not see the old tetrahedra.
"""

from __future__ import annotations

import numpy as np
from mmgpy import MmgMeshS
from netgen.meshing import FaceDescriptor, Mesh, MeshingParameters, Pnt

from limbfit.anatomy.meshing._worker import work

SMALLEST_PART = 0.1  # of the smallest wanted edge: MMG's lower bound where curvature asks for more
GRADING = 0.5


def remesh(task: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Mesh what a surface encloses; the keys are those of ``VolumeTask`` and ``VolumeMesh``."""
    points, triangles, refs = surface(task)
    size = task["size"]
    mesh = Mesh(dim=3)
    mesh.AddPoints(np.ascontiguousarray(points))
    for index, ref in enumerate(np.unique(refs), start=1):
        mesh.Add(FaceDescriptor(surfnr=index, domin=1, domout=0, bc=index))
        chosen = np.ascontiguousarray(triangles[refs == ref], dtype=np.int32)
        mesh.AddElements(dim=2, index=index, data=chosen, base=0)
    mesh.SetMaterial(1, "core")
    mesh.CalcLocalH(GRADING, 1)
    for point, edge in zip(task["points"], size):
        mesh.RestrictLocalH(Pnt(*point), float(edge))
    mesh.GenerateVolumeMesh(MeshingParameters(maxh=float(size.max()), grading=GRADING))
    filled = np.array(mesh.Coordinates())  # a copy: the mesh owns the memory
    if not np.array_equal(filled[: len(points)], points):
        raise RuntimeError("Netgen moved or renumbered points of the surface")
    tets = mesh.Elements3D().NumPy()["nodes"][:, :4].astype(np.int64) - 1
    tets = tets[:, [0, 1, 3, 2]]  # Netgen's tetrahedra are oriented the other way round
    regions = np.zeros(len(tets), dtype=np.int64)
    return {
        "points": filled,
        "tets": tets,
        "regions": regions,
        "triangles": triangles,
        "triangle_refs": refs,
    }


def surface(task: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, triangles and references of the boundary with edges of the wanted size."""
    used, triangles = np.unique(task["triangles"], return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    size = np.ascontiguousarray(task["size"][used][:, None])
    mesh = MmgMeshS()
    mesh.set_mesh_size(vertices=len(used), triangles=len(triangles))
    mesh.set_vertices(task["points"][used])
    mesh.set_triangles(triangles.astype(np.int32), task["triangle_refs"].astype(np.int64))
    mesh["metric"] = size
    mesh.remesh(
        hausd=float(task["hausdorff_mm"]),
        hgrad=-1.0,  # the size field is graded already
        hmin=SMALLEST_PART * float(size.min()),
        hmax=float(size.max()),
        verbose=-1,
    )
    remeshed, refs = mesh.get_triangles_with_refs()
    return mesh.get_vertices(), remeshed.astype(np.int64), np.asarray(refs)


if __name__ == "__main__":
    work(remesh)
