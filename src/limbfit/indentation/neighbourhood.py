"""The tissue near a site: a part of its mesh that answers to the indenter almost like the whole.

Two thirds of the nodes of a limb's mesh lie beyond 60 mm of the indenter, where tissue hardly moves. Without
them a simulation costs a fraction, and its force is off by some percent, nearly in proportion
(docs/convergence.md): good for a search whose forces the whole mesh corrects, and for first guesses.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from ..arrays import Array, Indices, Mask
from ..errors import ProblemError
from ..fe import Result, System, build_linear_solver, compute_tangent_at_rest
from ..mesh import Mesh

# Of the cut, what lies this straight below the indenter is held, for deep tissue hangs on bone; the sides may
# move. Held or free altogether, the factor to the whole force would be 0.69 or 2.3 (docs/convergence.md).
_MIN_COSINE_BELOW = np.cos(np.radians(32.0))
_TRUSTED_SHARE = 0.6  # share of the radius within which the part's displacements are those of the whole


@dataclass(frozen=True)
class Neighbourhood:
    """A part of a mesh: its ``nodes`` (k,) and which of the ``cells`` (m,) there are its own; ``cut`` (j,):
    nodes of the part where it was cut off."""

    mesh: Mesh
    nodes: Indices
    cut: Indices
    cells: Mask


def cut_neighbourhood(mesh: Mesh, centre: Array, radius_mm: float) -> Neighbourhood:
    """The cells within a distance of a point that hang together with the one nearest to it.

    Node and face sets keep what is left of them. Raises `ProblemError` where no cell is that near.
    """
    distance = np.linalg.norm(mesh.points[mesh.corners].mean(axis=1) - centre, axis=1)
    near = np.flatnonzero(distance < radius_mm)
    if not len(near):
        raise ProblemError(
            f"no cell of the mesh is within {radius_mm:g} mm of the site",
            remedy="check the site's position, or give a larger calibration.search_radius_mm",
        )
    corners = mesh.corners[near]
    rows, columns = np.repeat(corners[:, :1], corners.shape[1] - 1, axis=1), corners[:, 1:]
    links = sp.coo_array((np.ones(rows.size), (rows.ravel(), columns.ravel())), shape=(len(mesh.points),) * 2)
    piece = connected_components(links, directed=False)[1][corners[:, 0]]
    kept = np.zeros(len(mesh.cells), dtype=bool)
    kept[near[piece == piece[np.argmin(distance[near])]]] = True
    inside, outside = np.zeros((2, len(mesh.points)), dtype=bool)
    inside[mesh.cells[kept]] = True
    outside[mesh.cells[~kept]] = True
    number = np.cumsum(inside) - 1
    part = replace(
        mesh,
        points=mesh.points[inside],
        cells=number[mesh.cells[kept]],
        regions=mesh.regions[kept],
        node_sets={name: number[nodes[inside[nodes]]] for name, nodes in mesh.node_sets.items()},
        face_sets={name: number[faces[inside[faces].all(axis=1)]] for name, faces in mesh.face_sets.items()},
    )
    return Neighbourhood(part, np.flatnonzero(inside), number[inside & outside], kept)


def find_fixed_cut_nodes(part: Neighbourhood, centre: Array, axis: Array) -> Indices:
    """Nodes of the cut to be held: those below the indenter, which advances along ``axis``."""
    offset = part.mesh.points[part.cut] - centre
    return part.cut[offset @ axis > _MIN_COSINE_BELOW * np.linalg.norm(offset, axis=1)]


class Extension:
    """Displacements of a neighbourhood carried on into the whole mesh, as a linear elastic limb would."""

    def __init__(self, system: System, part: Neighbourhood, centre: Array, radius_mm: float) -> None:
        self._system, self._part = system, part
        held = np.zeros(len(system.points), dtype=bool)
        held[part.nodes] = np.linalg.norm(part.mesh.points - centre, axis=1) < _TRUSTED_SHARE * radius_mm
        given = np.repeat(held, 3)[system.free]
        self._given, self._rest = np.flatnonzero(given), np.flatnonzero(~given)
        self._solver = None
        if len(self._rest):
            upper = sp.csr_array(
                (compute_tangent_at_rest(system), system.indices, system.indptr), shape=(system.unknowns,) * 2
            )
            own = sp.csr_array(upper[self._rest][:, self._rest])
            own.sort_indices()
            full = sp.csr_array(upper + sp.triu(upper, 1).T)
            self._links = full[self._rest][:, self._given]
            self._solver = build_linear_solver(own.indptr, own.indices, threads=system.threads)
            self._solver.factorise(own.data)

    def __call__(self, u: Array) -> Array:
        """Displacements (n, 3) of the whole mesh from those of the part (k, 3)."""
        whole = np.zeros_like(self._system.points)
        whole[self._part.nodes] = u
        values = whole.ravel()[self._system.free]
        if self._solver is not None:
            values[self._rest] = self._solver.solve(-(self._links @ values[self._given]))
        whole[:] = 0.0
        whole.ravel()[self._system.free] = values
        return whole

    def guesses(self, found: Result) -> Result:
        """A simulation of the part as the ``warm_start`` of one of the whole."""
        states = tuple(replace(s, u=self(s.u), sensitivity=None, memory=None) for s in found.states)
        return replace(found, problem=self._system.problem, states=states)
