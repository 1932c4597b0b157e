"""Viscoelastic history at the quadrature points and its update, step by step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from ..arrays import Array
from .kernel.laws import EvaluationPoints, Laws
from .kernel.response import elastic_response, pull_back
from .lanes import LANES, workspace
from .materials import compute_prony_factors
from .motion import Drives
from .system import Increment, System

Points = System | EvaluationPoints  # those with a past of their own


@dataclass(frozen=True)
class Memory:
    """What the tissue keeps of its past at the quadrature points, MPa.

    ``elastic``: (m, q, 6) deviatoric second Piola-Kirchhoff stress Se. ``prony``: (l, m, q, 6) history H of
    each Prony term. ``before``, ``duration``: Se one step earlier and how long that step was, s; None and
    infinite where the next step takes the stress as linear in time: at rest, and where the indenter has just
    turned.
    """

    elastic: Array
    prony: Array
    before: Array | None = None
    duration: float = np.inf

    @classmethod
    def rest(cls, points: Points, laws: Laws) -> Memory:
        shape = (*points.weights.shape, 6)
        return cls(np.zeros(shape), np.zeros((laws.prony.shape[1], *shape)))

    def drop_past(self) -> Memory:
        """The same, with no smooth past: the next step takes the stress as linear in time."""
        return Memory(self.elastic, self.prony)

    def build_increment(
        self, points: Points, laws: Laws, time: float, dt: float, displacement: float, penalty: float,
        drives: Drives,
    ) -> Increment:  # fmt: skip
        """The step of ``dt`` s that ends at ``time``."""
        decay, ramp, back, *_ = compute_prony_factors(dt, laws.prony[..., 1], self.duration)
        gamma = laws.prony[..., 0]
        of = points.regions
        K = ((gamma * (back - ramp)).sum(axis=1))[of][:, None, None] * self.elastic
        if self.before is not None:
            K -= ((gamma * back).sum(axis=1))[of][:, None, None] * self.before
        for l in range(gamma.shape[1]):
            K += (gamma * decay)[of, l][:, None, None] * self.prony[l]
        scale = 1.0 + (gamma * ramp).sum(axis=1)
        return Increment(time, displacement, scale, K, penalty, drives)

    def advance(self, points: Points, laws: Laws, elastic: Array, dt: float) -> Memory:
        """The memory at the end of a step of ``dt`` s that ended with the elastic stress ``elastic``."""
        decay, ramp, back, *_ = compute_prony_factors(dt, laws.prony[..., 1], self.duration)
        of = points.regions
        prony = np.empty_like(self.prony)
        for l in range(len(prony)):
            prony[l] = decay[of, l][:, None, None] * self.prony[l]
            prony[l] += ramp[of, l][:, None, None] * (elastic - self.elastic)
            if self.before is not None:
                prony[l] += back[of, l][:, None, None] * (self.elastic - self.before)
        return Memory(elastic, prony, self.elastic, dt)


def compute_elastic_stresses(system: System, laws: Laws, u: Array) -> Array:
    """Deviatoric second Piola-Kirchhoff stress ``Se (m, q, 6)`` of the elastic law at ``u (n, 3)``, MPa."""
    stress = np.empty((*system.weights.shape, 6))

    def part(cells: slice) -> None:
        elements = system.elements(cells)
        records = workspace(0, system.weights.shape[1], laws.numbers.shape[1])[:3]
        _compute_elastic_stresses(elements, laws.tables, u, records, stress[cells])

    system.map_cells(part)
    return stress


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _compute_elastic_stresses(elements, tables, u, records, out):  # type: ignore[no-untyped-def]
    """The kernel of `compute_elastic_stresses`, `LANES` elements side by side."""
    points, law, numbers = records
    m, q = elements[2].shape
    for start in range(0, m, LANES):
        elastic_response(elements, start, tables, u, points, law[0], numbers)
        for t in range(q):
            pull_back(points[t], len(elements[4]) > 0)
            for l in range(min(LANES, m - start)):
                for i in range(6):
                    out[start + l, t, i] = points[t].tau[i, l]
