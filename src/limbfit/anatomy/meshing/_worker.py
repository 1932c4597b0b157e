"""Runs a mesher in a process of its own: a mesher can take the interpreter down with it.

Called as ``python _worker.py ENGINE TASK.npz MESH.npz``; imports nothing of limbfit, to start quickly. The
keys of the files are those of ``VolumeTask`` and ``VolumeMesh``.
"""

import ctypes
import signal
import sys

import numpy as np
from mmgpy import MmgMesh3D, MmgMeshS

Arrays = dict[str, np.ndarray]

SMALLEST_PART = 0.1  # of the smallest requested edge: MMG's lower bound where curvature asks for more
NETGEN_GRADING = 0.5
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>


def main() -> None:
    """From the task file to the mesh file, by the engine that the command line names."""
    if sys.platform == "linux":  # a mesher would not hear of a killed run, and keep a core until it is done
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    engine, source, target = sys.argv[1:]
    with np.load(source) as stored:
        mesh = {"mmg": remesh_with_mmg, "netgen": remesh_with_netgen}[engine](dict(stored))
    np.savez(target, allow_pickle=False, **mesh)


def remesh_with_mmg(task: Arrays) -> Arrays:
    """Adapt a mesh with surface references."""
    mesh = MmgMesh3D()
    points, tets, triangles = task["points"], task["tets"], task["triangles"]
    mesh.set_mesh_size(vertices=len(points), tetrahedra=len(tets), triangles=len(triangles))
    mesh.set_vertices(points)
    mesh.set_tetrahedra(tets.astype(np.int32), task["regions"].astype(np.int64) + 1)  # MMG keeps 0 for itself
    _adapt_to_size(mesh, triangles, task, task["size"])
    triangles, triangle_refs = mesh.get_triangles_with_refs()
    tets, regions = mesh.get_elements_with_refs()
    return {
        "points": mesh.get_vertices(),
        "tets": tets.astype(np.int64),
        "regions": np.asarray(regions) - 1,
        "triangles": triangles.astype(np.int64),
        "triangle_refs": triangle_refs,
    }


def _adapt_to_size(mesh: MmgMesh3D | MmgMeshS, triangles: np.ndarray, task: Arrays, size: np.ndarray) -> None:
    """Give a mesh its triangles (k, 3) and the edge lengths (n,) of its points, and let MMG adapt it."""
    mesh.set_triangles(triangles.astype(np.int32), task["triangle_refs"].astype(np.int64))
    mesh["metric"] = np.ascontiguousarray(size[:, None])
    mesh.remesh(
        hausd=float(task["hausdorff_mm"]),
        hgrad=-1.0,  # the size field is graded already
        hmin=SMALLEST_PART * float(size.min()),
        hmax=float(size.max()),
        verbose=-1,
    )


def remesh_with_netgen(task: Arrays) -> Arrays:
    """Fill the surface, which MMG remeshes alone; Netgen does not see the old tetrahedra."""
    from netgen.meshing import FaceDescriptor, Mesh, MeshingParameters, Pnt  # an optional package

    points, triangles, refs = _remesh_surface(task)
    size = task["size"]
    mesh = Mesh(dim=3)
    mesh.AddPoints(np.ascontiguousarray(points))
    for index, ref in enumerate(np.unique(refs), start=1):
        mesh.Add(FaceDescriptor(surfnr=index, domin=1, domout=0, bc=index))
        chosen = np.ascontiguousarray(triangles[refs == ref], dtype=np.int32)
        mesh.AddElements(dim=2, index=index, data=chosen, base=0)
    mesh.SetMaterial(1, "core")
    mesh.CalcLocalH(NETGEN_GRADING, 1)
    for point, edge in zip(task["points"], size):
        mesh.RestrictLocalH(Pnt(*point), float(edge))
    mesh.GenerateVolumeMesh(MeshingParameters(maxh=float(size.max()), grading=NETGEN_GRADING))
    filled = np.array(mesh.Coordinates())  # a copy: the mesh owns the memory
    if not np.array_equal(filled[: len(points)], points):
        raise RuntimeError("Netgen moved or renumbered points of the surface")
    tets = mesh.Elements3D().NumPy()["nodes"][:, :4].astype(np.int64) - 1
    return {
        "points": filled,
        "tets": tets[:, [0, 1, 3, 2]],  # Netgen's tetrahedra are oriented the other way round
        "regions": np.zeros(len(tets), dtype=np.int64),
        "triangles": triangles,
        "triangle_refs": refs,
    }


def _remesh_surface(task: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, triangles and references of the boundary with edges of the requested size."""
    used, triangles = np.unique(task["triangles"], return_inverse=True)
    triangles = triangles.reshape(-1, 3)
    mesh = MmgMeshS()
    mesh.set_mesh_size(vertices=len(used), triangles=len(triangles))
    mesh.set_vertices(task["points"][used])
    _adapt_to_size(mesh, triangles, task, task["size"][used])
    remeshed, refs = mesh.get_triangles_with_refs()
    return mesh.get_vertices(), remeshed.astype(np.int64), np.asarray(refs)


if __name__ == "__main__":
    main()
