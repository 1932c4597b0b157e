"""Fields of one accepted step, at elements and nodes."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit

from ..arrays import Array, Indices
from .kernel.elements import compute_face_areas
from .kernel.laws import Laws
from .kernel.response import elastic_response, kirchhoff_stress, pressures
from .lanes import LANES, workspace
from .result import State
from .system import Increment, System


@dataclass(frozen=True)
class ElementFields:
    """Volume averages per element.

    ``cauchy (m, 6)`` MPa in the order xx, yy, zz, xy, yz, zx; ``stretches (m, 3)`` principal, falling;
    ``J (m,)``; ``energy (m,)`` long-term elastic strain energy density, N mm per mm^3; contraction has none.
    """

    cauchy: Array
    stretches: Array
    J: Array
    energy: Array


def compute_element_fields(system: System, laws: Laws, state: State) -> ElementFields:
    """Fields of a state that kept its memory (``store="peak"``, or a step of `iterate`)."""
    history = _compute_relaxing_stress(system, laws, state)
    # Contraction has no strain energy: where there is some, the energy is that of a second pass without it.
    passes = [laws.activate(state.activation, np.ones(len(laws.prony)))]
    passes += [laws.tables] if state.activation else []
    out = np.zeros((len(passes), len(system.cells), 11))
    points, law, numbers, _, _, element, *_ = workspace(0, system.weights.shape[1], laws.numbers.shape[1])
    records = points, law, numbers, element
    mean, every = system.element.mean_dilatation, slice(0, len(system.cells))
    for tables, fields in zip(passes, out):
        _compute_fields(system.elements(every), mean, tables, history, state.u, records, fields)
    return ElementFields(out[0, :, :6], out[0, :, 6:9], out[0, :, 9], out[-1, :, 10])


def compute_nodal_forces(system: System, laws: Laws, state: State) -> Array:
    """Force (n, 3) that every node of a state needs to stay where it is, N, beside contact and pressures.

    At supports their reactions; at free nodes what Newton's iteration left.  The state must have kept its
    memory, as for `compute_element_fields`.
    """
    pressures = tuple(one.at(state.time) for one in system.problem.pressures)
    rims = system.pressures.compute_rims(state.rows, pressures) if pressures else 0.0
    increment = Increment(
        state.time, state.displacement, np.ones(len(laws.prony)),
        _compute_relaxing_stress(system, laws, state),
        state.penalty * laws.modulus, state.drives, state.grips, activation=state.activation,
        pressures=pressures, rims=rims,
    )  # fmt: skip
    found = system.evaluate(state.rows, laws, increment, tangent=False)
    return found.residual[: system.nodes]


def _compute_relaxing_stress(system: System, laws: Laws, state: State) -> Array:
    """Deviatoric second Piola-Kirchhoff stress (m, q, 6) of the Prony terms, MPa."""
    if state.memory is None:
        raise ValueError("the state was stored without its stresses")
    stress = np.zeros_like(state.memory.elastic)
    gamma = laws.prony[..., 0][system.regions]
    for l in range(gamma.shape[1]):
        stress += gamma[:, l, None, None] * state.memory.prony[l]
    return stress


def compute_contact_pressure(system: System, laws: Laws, state: State) -> Array:
    """Contact pressure (n,) at the nodes, MPa over the deformed area; 0 where nothing is in touch.

    The part of a node's contact force along the deformed skin's normal, over the node's share of the area.
    On quadratic faces only mid-edge nodes have a share (the integral of a corner's shape function is zero):
    a corner's force goes to the mid-edge nodes beside it, and it gets the mean of their pressures.
    """
    pressure = np.zeros(len(system.points))
    if not system.bodies.all:
        return pressure
    penalty = state.penalty * laws.modulus
    found = system.bodies.evaluate(state.rows, state.drives, penalty, np.inf, state.grips, tangent=False)
    force = found.residual[: system.nodes]
    faces = np.concatenate([np.asarray(body.faces) for body in system.problem.rigid_bodies])
    faces = faces[np.sort(np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1])]  # each once
    N, areas = compute_face_areas(system.element, system.points + state.u, faces, "gauss")
    parts = np.einsum("fqi,qk->fki", areas, N).reshape(-1, 3)
    share = np.stack([np.bincount(faces.ravel(), part, len(pressure)) for part in parts.T], axis=1)
    to_middles = _build_corner_mean(len(pressure), faces) if faces.shape[1] == 6 else None
    if to_middles is not None:
        force, share = (values + to_middles.T @ values for values in (force, share))
    size = np.linalg.norm(share, axis=1)
    bearing = size > 0.0
    pressure[bearing] = np.maximum((force * share).sum(axis=1)[bearing], 0.0) / size[bearing] ** 2
    if to_middles is not None:
        corners = np.unique(faces[:, :3])
        pressure[corners] = (to_middles @ pressure)[corners]
    return pressure


def _build_corner_mean(n: int, faces: Indices) -> sp.csr_matrix:
    """Matrix (n, n): at the corners of quadratic faces (f, 6) the mean over the mid-edge nodes beside."""
    corners, beside = faces[:, [0, 0, 1, 1, 2, 2]].ravel(), faces[:, [3, 5, 3, 4, 4, 5]].ravel()
    count = np.bincount(corners, minlength=n)
    return sp.csr_matrix((1.0 / count[corners], (corners, beside)), shape=(n, n))


def average_at_nodes(system: System, values: Array) -> Array:
    """Element values (m, c) at the nodes (n, c): the mean over the elements around, by their volume.

    Where two tissues meet it is a mean over both.
    """
    volume = system.weights.sum(axis=1)
    m, k = system.cells.shape
    around = sp.csr_matrix((np.repeat(volume, k), (system.cells.ravel(), np.repeat(np.arange(m), k))))
    return np.asarray((around @ values) / (around @ np.ones((m, 1))))


def compute_von_mises(cauchy: Array) -> Array:
    """Equivalent stress (m,) of stresses (m, 6) in the order xx, yy, zz, xy, yz, zx."""
    xx, yy, zz, xy, yz, zx = cauchy.T
    normal = (xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2
    return np.asarray(np.sqrt(0.5 * normal + 3.0 * (xy**2 + yz**2 + zx**2)))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _compute_fields(elements, mean, tables, history, u, records, out):  # type: ignore[no-untyped-def]
    """The kernel of `compute_element_fields`, `LANES` elements side by side; adds to ``out (m, 11)``."""
    points, law, numbers, element = records
    weights, regions = elements[2], elements[3]
    m, q = weights.shape
    for start in range(0, m, LANES):
        elastic_response(elements, start, tables, u, points, law[0], numbers)
        pressures(weights, regions, tables, mean, start, points, element[0])
        for t in range(q):
            p = points[t]
            for l in range(LANES):
                el = min(start + l, m - 1)
                p.weight[l] = p.scale[l] = 1.0
                for i in range(6):
                    p.history[i, l] = history[el, t, i]
            for l in range(min(LANES, m - start)):
                w = weights[start + l, t] / weights[start + l].sum()
                less, more = min(p.b[0, l], p.b[1, l]), max(p.b[0, l], p.b[1, l])
                out[start + l, 6] += w * np.sqrt(max(more, p.b[2, l]))
                out[start + l, 7] += w * np.sqrt(max(less, min(more, p.b[2, l])))
                out[start + l, 8] += w * np.sqrt(min(less, p.b[2, l]))
                out[start + l, 9] += w * p.J[l]
                out[start + l, 10] += w * (p.energy[l] + p.volumetric[l])
            kirchhoff_stress(p, len(elements[4]) > 0)
            for l in range(min(LANES, m - start)):
                w = weights[start + l, t] / weights[start + l].sum() / p.J[l]
                for i in range(6):
                    out[start + l, i] += w * p.tau[i, l]
