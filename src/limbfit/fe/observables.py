"""Fields of one accepted step, at elements and nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray

from .kernel.elements import Element
from .kernel.kinematics import (
    deformation_gradient,
    from_principal,
    logarithmic_stretches,
    mean_dilatation,
    principal,
    push_forward,
)
from .kernel.laws import Laws
from .materials.ogden import ogden
from .materials.volumetric import volumetric
from .result import State
from .system import Increment, System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ElementFields:
    """Volume averages per element.

    ``cauchy (m, 6)`` MPa in the order xx, yy, zz, xy, yz, zx; ``stretches (m, 3)`` principal, falling;
    ``J (m,)``; ``energy (m,)`` long-term elastic strain energy density, N mm per mm^3.
    """

    cauchy: Array
    stretches: Array
    J: Array
    energy: Array


def element_fields(system: System, laws: Laws, state: State) -> ElementFields:
    """Fields of a state that kept its memory (``store="peak"``, or a step of `iterate`)."""
    history = _relaxing(system, laws, state)
    out = np.zeros((len(system.cells), 11))
    _fields(
        system.cells, system.gradients, system.weights, system.element.mean_dilatation, system.regions,
        laws.tables, history, state.u, out,
    )  # fmt: skip
    return ElementFields(out[:, :6], out[:, 6:9], out[:, 9], out[:, 10])


def nodal_forces(system: System, laws: Laws, state: State) -> Array:
    """Force (n, 3) from outside that every node of a state needs to stay where it is, N, but for contact.

    At supports their reactions; at free nodes what Newton's iteration left.  The state must have kept its
    memory, as for `element_fields`.
    """
    increment = Increment(
        state.time, state.displacement, np.ones(len(laws.terms)), _relaxing(system, laws, state),
        state.penalty * laws.modulus,
    )  # fmt: skip
    return system.evaluate(state.u, laws, increment, tangent=False).residual


def _relaxing(system: System, laws: Laws, state: State) -> Array:
    """Deviatoric second Piola-Kirchhoff stress (m, q, 6) of the Prony terms, MPa."""
    if state.memory is None:
        raise ValueError("the state was stored without its stresses")
    stress = np.zeros_like(state.memory.elastic)
    gamma = laws.prony[..., 0][system.regions]
    for l in range(gamma.shape[1]):
        stress += gamma[:, l, None, None] * state.memory.prony[l]
    return stress


def contact_pressure(system: System, laws: Laws, state: State) -> Array:
    """Contact pressure (n,) at the nodes, MPa over the deformed area; 0 where nothing is in touch.

    The part of a node's contact force along the deformed skin's normal, over the node's share of the area.
    On quadratic faces only mid-edge nodes have a share (the integral of a corner's shape function is zero):
    a corner's force goes to the mid-edge nodes beside it, and it gets the mean of their pressures.
    """
    pressure = np.zeros(len(system.points))
    if system.surface is None:
        return pressure
    nothing, penalty = np.zeros(0), state.penalty * laws.modulus
    force = system.contact_force(
        state.u, Increment(state.time, state.displacement, nothing, nothing, penalty)
    )
    faces = np.asarray(system.problem.contact_faces)
    share = _nodal_areas(system.element, system.points + state.u, faces)
    to_middles = _corner_mean(len(pressure), faces) if faces.shape[1] == 6 else None
    if to_middles is not None:
        force, share = (values + to_middles.T @ values for values in (force, share))
    size = np.linalg.norm(share, axis=1)
    bearing = size > 0.0
    pressure[bearing] = np.maximum((force * share).sum(axis=1)[bearing], 0.0) / size[bearing] ** 2
    if to_middles is not None:
        corners = np.unique(faces[:, :3])
        pressure[corners] = (to_middles @ pressure)[corners]
    return pressure


def _corner_mean(n: int, faces: NDArray[np.int64]) -> sp.csr_matrix:
    """Matrix (n, n): at the corners of quadratic faces (f, 6) the mean over the mid-edge nodes beside."""
    corners, beside = faces[:, [0, 0, 1, 1, 2, 2]].ravel(), faces[:, [3, 5, 3, 4, 4, 5]].ravel()
    count = np.bincount(corners, minlength=n)
    return sp.csr_matrix((1.0 / count[corners], (corners, beside)), shape=(n, n))


def _nodal_areas(element: Element, points: Array, faces: NDArray[np.int64]) -> Array:
    """Each node's share (n, 3) of the area of the faces (f, k), outward, mm^2."""
    at, weights = element.face_rules["gauss"]
    N, dN = element.face_shape(at)
    tangents = np.einsum("fki,qkj->fqij", points[faces], dN)
    normals = np.cross(tangents[..., 0], tangents[..., 1])
    shares = np.einsum("fqi,q,qk->fki", normals, weights, N).reshape(-1, 3)
    return np.stack([np.bincount(faces.ravel(), part, len(points)) for part in shares.T], axis=1)


def nodal_average(system: System, values: Array) -> Array:
    """Element values (m, c) at the nodes (n, c): the mean over the elements around, by their volume.

    Where two tissues meet it is a mean over both.
    """
    volume = system.weights.sum(axis=1)
    m, k = system.cells.shape
    around = sp.csr_matrix((np.repeat(volume, k), (system.cells.ravel(), np.repeat(np.arange(m), k))))
    return np.asarray((around @ values) / (around @ np.ones((m, 1))))


def von_mises(cauchy: Array) -> Array:
    """Equivalent stress (m,) of stresses (m, 6) in the order xx, yy, zz, xy, yz, zx."""
    xx, yy, zz, xy, yz, zx = cauchy.T
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    return np.asarray(np.sqrt(0.5 * normal + 3.0 * (xy**2 + yz**2 + zx**2)))


@njit(cache=True)
def _fields(cells, grads, weights, mean, regions, tables, history, u, out):  # type: ignore[no-untyped-def]
    terms, kappa, law = tables
    m, k = cells.shape
    ue, matrix, vector = np.empty((3, k)), np.empty((4, 3, 3)), np.empty((5, 3))
    F, A, N, n = matrix[0], matrix[1], matrix[2], matrix[3]
    c2, e, beta, slope, quotient = vector[0], vector[1], vector[2], vector[3], vector[4]
    tau = np.empty(6)
    for el in range(m):
        for a in range(k):
            for i in range(3):
                ue[i, a] = u[cells[el, a], i]
        r = regions[el]
        ratio = mean_dilatation(grads[el], weights[el], ue, F) if mean else 1.0
        volume = weights[el].sum()
        for q in range(grads.shape[1]):
            J = deformation_gradient(grads[el, q], ue, F)
            principal(F, A, c2, N)
            logarithmic_stretches(c2, e)
            W = ogden(terms[r], c2, e, beta, slope, quotient)
            U, JU, _ = volumetric(law[r], kappa[r], ratio if mean else J)
            pressure = JU * J / ratio if mean else JU
            for i in range(3):
                root = np.sqrt(c2[i])
                for p in range(3):
                    n[p, i] = (F[p, 0] * N[0, i] + F[p, 1] * N[1, i] + F[p, 2] * N[2, i]) / root
            from_principal(beta, n, tau)
            push_forward(F, history[el, q], A, tau, 1.0)
            w = weights[el, q] / volume
            for p in range(6):
                out[el, p] += w / J * (tau[p] + (pressure if p < 3 else 0.0))
            c2.sort()
            for i in range(3):
                out[el, 6 + i] += w * np.sqrt(c2[2 - i])
            out[el, 9] += w * J
            out[el, 10] += w * (W + U)
