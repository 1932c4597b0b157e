"""Viscoelastic history at the quadrature points and its update, step by step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .kernel.kinematics import deform, invert, principal_axes
from .kernel.laws import Laws
from .lanes import COMPILED, LANES, workspace
from .materials import prony_factors
from .materials.ogden import ogden_lanes, set_terms
from .system import Increment, System

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Memory:
    """What the tissue keeps of its past at the quadrature points, MPa.

    Parameters
    ----------
    elastic : (m, q, 6) deviatoric second Piola-Kirchhoff stress Se.
    prony : (l, m, q, 6) history H of each Prony term.
    before, duration : Se one step earlier and how long that step was, s; None and infinite where the next
        step takes the stress as linear in time: at rest, and where the indenter has just turned.
    """

    elastic: Array
    prony: Array
    before: Array | None = None
    duration: float = np.inf

    @classmethod
    def rest(cls, system: System, laws: Laws) -> Memory:
        shape = (*system.weights.shape, 6)
        return cls(np.zeros(shape), np.zeros((laws.prony.shape[1], *shape)))

    def turned(self) -> Memory:
        """The same, with no smooth past: the next step takes the stress as linear in time."""
        return Memory(self.elastic, self.prony)

    def increment(
        self, system: System, laws: Laws, time: float, dt: float, displacement: float, penalty: float
    ) -> Increment:
        """The step of ``dt`` s that ends at ``time``."""
        decay, ramp, back, *_ = prony_factors(dt, laws.prony[..., 1], self.duration)
        gamma = laws.prony[..., 0]
        of = system.regions
        K = ((gamma * (back - ramp)).sum(axis=1))[of][:, None, None] * self.elastic
        if self.before is not None:
            K -= ((gamma * back).sum(axis=1))[of][:, None, None] * self.before
        for l in range(gamma.shape[1]):
            K += (gamma * decay)[of, l][:, None, None] * self.prony[l]
        return Increment(time, displacement, 1.0 + (gamma * ramp).sum(axis=1), K, penalty)

    def advanced(self, system: System, laws: Laws, elastic: Array, dt: float) -> Memory:
        """The memory at the end of a step of ``dt`` s that ended with the elastic stress ``elastic``."""
        decay, ramp, back, *_ = prony_factors(dt, laws.prony[..., 1], self.duration)
        of = system.regions
        prony = np.empty_like(self.prony)
        for l in range(len(prony)):
            prony[l] = decay[of, l][:, None, None] * self.prony[l]
            prony[l] += ramp[of, l][:, None, None] * (elastic - self.elastic)
            if self.before is not None:
                prony[l] += back[of, l][:, None, None] * (self.elastic - self.before)
        return Memory(elastic, prony, self.elastic, dt)


def elastic_stresses(system: System, laws: Laws, u: Array) -> Array:
    """Deviatoric second Piola-Kirchhoff stress ``Se (m, q, 6)`` of the elastic law at ``u (n, 3)``, MPa."""
    stress = np.empty((*system.weights.shape, 6))

    def part(cells: slice) -> None:
        points, law, *_ = workspace(0, 1, laws.terms.shape[1])
        elements = system.cells[cells], system.gradients[cells], system.regions[cells]
        _elastic_stresses(*elements, laws.terms, u, points[0], law, stress[cells])

    system.over_cells(part)
    return stress


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _elastic_stresses(cells, grads, regions, terms, u, point, law, out):  # type: ignore[no-untyped-def]
    """The kernel of `elastic_stresses`, `LANES` elements side by side; a POINT and TERMs are its scratch."""
    m = len(cells)
    for start in range(0, m, LANES):
        for l in range(LANES):
            set_terms(law, l, terms[regions[min(start + l, m - 1)]])
        for q in range(grads.shape[1]):
            for l in range(LANES):
                el = min(start + l, m - 1)
                deform(point, l, cells[el], grads[el, q], u)
            invert(point)
            principal_axes(point)
            ogden_lanes(point, law)
            _pull_back(point)
            for l in range(min(LANES, m - start)):
                for i in range(6):
                    out[start + l, q, i] = point.tau[i, l]


@njit(**COMPILED)
def _pull_back(p):  # type: ignore[no-untyped-def]
    """``Se = sum_i beta_i v_i x v_i`` of a POINT, with ``v_i = F^-1 n_i``, in the place of ``tau``."""
    for l in range(LANES):
        b0, b1, b2 = p.beta[0, l], p.beta[1, l], p.beta[2, l]
        x0, x1, x2 = p.n[0, 0, l], p.n[0, 1, l], p.n[0, 2, l]
        y0, y1, y2 = p.n[1, 0, l], p.n[1, 1, l], p.n[1, 2, l]
        z0, z1, z2 = p.n[2, 0, l], p.n[2, 1, l], p.n[2, 2, l]
        f, g, h = p.inverse[0, 0, l], p.inverse[1, 0, l], p.inverse[2, 0, l]
        X0, X1, X2 = f * x0 + g * y0 + h * z0, f * x1 + g * y1 + h * z1, f * x2 + g * y2 + h * z2
        f, g, h = p.inverse[0, 1, l], p.inverse[1, 1, l], p.inverse[2, 1, l]
        Y0, Y1, Y2 = f * x0 + g * y0 + h * z0, f * x1 + g * y1 + h * z1, f * x2 + g * y2 + h * z2
        f, g, h = p.inverse[0, 2, l], p.inverse[1, 2, l], p.inverse[2, 2, l]
        Z0, Z1, Z2 = f * x0 + g * y0 + h * z0, f * x1 + g * y1 + h * z1, f * x2 + g * y2 + h * z2
        p.tau[0, l] = b0 * X0 * X0 + b1 * X1 * X1 + b2 * X2 * X2
        p.tau[1, l] = b0 * Y0 * Y0 + b1 * Y1 * Y1 + b2 * Y2 * Y2
        p.tau[2, l] = b0 * Z0 * Z0 + b1 * Z1 * Z1 + b2 * Z2 * Z2
        p.tau[3, l] = b0 * X0 * Y0 + b1 * X1 * Y1 + b2 * X2 * Y2
        p.tau[4, l] = b0 * Y0 * Z0 + b1 * Y1 * Z1 + b2 * Y2 * Z2
        p.tau[5, l] = b0 * Z0 * X0 + b1 * Z1 * X1 + b2 * Z2 * X2
