"""Fields over the cells of a limb's mesh: directions of fibres, and pre-stretches along them or in a layer.

Fibres run in a stated direction, or along a flow from the proximal cut to bone.

Fibres of a muscle run between its attachments and along its boundaries, as the gradient of a potential that
Laplace's equation gives does: one at one attachment, zero at the other, no flow through what is between
(Choi and Blemker 2013, PLoS ONE 8, e77576).
"""

from collections.abc import Container, Iterable
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.spatial import cKDTree

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from ..fe import ELEMENTS, isochoric_stretch
from ..fe.kernel.elements import compute_reference_gradients
from ..mesh import Mesh
from ..study import Vector

Direction = Vector | Literal["flow"]
DISTAL_MM = 10.0  # of the bone's far end, along the limb, that fibres run to
_POTENTIAL_TOLERANCE = 1e-8  # residual of the potential


def build_fibre_field(fibres: Iterable[tuple[str, Direction]], mesh: Mesh) -> Array | None:
    """The fibres' direction in each cell (m, 3); any where a tissue has none, None where all have none.
    Raises `ProblemError` where a flow has no way: see `compute_flow_directions`.
    """
    found = None
    for tissue, direction in fibres:
        if tissue in mesh.region_names:
            found = np.tile([1.0, 0.0, 0.0], (len(mesh.cells), 1)) if found is None else found
            own = mesh.regions == mesh.region_names.index(tissue)
            found[own] = compute_flow_directions(mesh, tissue) if direction == "flow" else direction
    return found


def compute_flow_directions(mesh: Mesh, tissue: str) -> Array:
    """Unit directions (k, 3) in the cells of a tissue, in their order, towards the far end of the bone.

    The potential is 0 on the proximal cut and 1 on the bone within `DISTAL_MM` of its far end. Raises
    `ProblemError` for a mesh of other than tetrahedra, and where the tissue meets no cut or no end of the
    bone.
    """
    if not mesh.kind.is_tetrahedron:
        raise ProblemError("fibres along a flow need a mesh of tetrahedra", remedy="state a direction")
    corners = mesh.corners[mesh.regions == mesh.region_names.index(tissue)]
    nodes, cells = np.unique(corners, return_inverse=True)
    cells = cells.reshape(corners.shape)
    start, end = _find_ends(mesh, nodes)
    for met, what in ((start, "the proximal cut"), (end, "the far end of the bone")):
        if not met.any():
            raise ProblemError(
                f"the fibres of {tissue!r} have no flow: it does not meet {what}",
                remedy='state a direction, or "axis", in material.fibres',
            )
    points = mesh.points[nodes]
    gradients, weights = compute_reference_gradients(ELEMENTS["tet4"], points, cells)
    potential = _solve_potential(len(nodes), cells, gradients[:, 0], weights[:, 0], start, end)
    flow = np.einsum("mik,mk->mi", gradients[:, 0], potential[cells])
    size = np.linalg.norm(flow, axis=1, keepdims=True)
    if not (size > 0.0).all():
        raise ProblemError(f"the fibres of {tissue!r} have no flow in a part of it that hangs on nothing")
    return np.asarray(flow / size)


def _find_ends(mesh: Mesh, nodes: Indices) -> tuple[Mask, Mask]:
    """Which of the ``nodes`` are on the proximal cut, and which at the far end of the bone."""
    none = np.zeros(0, dtype=np.int64)
    cut, bone = (mesh.node_sets.get(name, none) for name in ("fixed_proximal", "fixed_bone"))
    if not len(cut) or not len(bone):
        return np.isin(nodes, cut), np.isin(nodes, bone)
    middle = mesh.points[cut].mean(axis=0)
    normal = np.linalg.svd(mesh.points[cut] - middle, full_matrices=False)[2][2]
    away = np.abs((mesh.points[bone] - middle) @ normal)
    end = bone[away > away.max() - DISTAL_MM]
    return np.isin(nodes, cut), np.isin(nodes, end) & ~np.isin(nodes, cut)


def _solve_potential(
    count: int, cells: Indices, gradients: Array, weights: Array, start: Mask, end: Mask
) -> Array:
    """The solution (n,) of Laplace's equation by linear tetrahedra: 0 at ``start``, 1 at ``end``."""
    blocks = np.einsum("mia,mib,m->mab", gradients, gradients, weights)
    rows, columns = np.broadcast_arrays(cells[:, :, None], cells[:, None])
    K = sp.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count))
    free, out = ~(start | end), end.astype(float)
    inner, right = K[free][:, free], -(K[free] @ out)
    M = sp.diags(1.0 / inner.diagonal())
    out[free], failed = spla.cg(inner, right, rtol=_POTENTIAL_TOLERANCE, maxiter=20 * count, M=M)
    if failed:
        raise ProblemError("the potential of the fibres' flow was not found", remedy="state a direction")
    return out


def build_prestretch_field(
    stretches: Iterable[tuple[str, float]], mesh: Mesh, fibres: Array | None, fibred: Container[str]
) -> Array | None:
    """The pre-stretch of each cell (m, 3, 3) at constant volume; None where no tissue has one.

    Parameters
    ----------
    stretches : of tissues by name: along their fibres in those that are ``fibred``, in every direction of the
        plane of the skin in others.
    fibres : (m, 3) direction in each cell, where tissues have some.
    """
    found = None
    for tissue, stretch in stretches:
        if tissue not in mesh.region_names:
            continue
        found = np.tile(np.eye(3), (len(mesh.cells), 1, 1)) if found is None else found
        own = np.flatnonzero(mesh.regions == mesh.region_names.index(tissue))
        if fibres is not None and tissue in fibred:
            found[own] = isochoric_stretch(fibres[own], stretch)
        else:
            corners = mesh.points[mesh.face_sets["skin"][:, :3]]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            middles = mesh.points[mesh.corners[own]].mean(axis=1)
            nearest = cKDTree(corners.mean(axis=1)).query(middles)[1]  # of the skin
            found[own] = isochoric_stretch(normals[nearest], stretch**-2.0)
    return found
