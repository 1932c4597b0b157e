"""Follower pressure: a pressure that stays normal to the faces it acts on, as they move.

Over a closed surface, or one whose rim slides in planes, it is the derivative of ``p V``, the work against
the volume that the faces enclose with a point.  At a free rim it is not: what differs there is held constant
in a step and renewed until it does not change, so that the tangent is symmetric and the forces are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..arrays import Array, Indices
from .kernel.elements import Element
from .motion import measure_moving_time, read_course
from .pattern import Pattern, find_positions


@dataclass(frozen=True)
class Pressure:
    """A pressure on faces over time, piecewise linear.

    Parameters
    ----------
    faces : (f, k) outward boundary faces.
    times : (n,) s, from 0.
    values : (n,) MPa, positive when pushing inwards.
    """

    faces: Indices
    times: Sequence[float] | Array
    values: Sequence[float] | Array

    def __post_init__(self) -> None:
        times, values = read_course("a pressure", "values", self.times, self.values)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    def delay(self, seconds: float) -> Pressure:
        """The same after so many seconds at its first value."""
        times, values = np.asarray(self.times), np.asarray(self.values)
        return Pressure(self.faces, np.append(0.0, times + seconds), np.append(values[0], values))

    def moving_s(self, t: float) -> float:
        """For how long it has changed up to time ``t``, s."""
        return measure_moving_time(np.asarray(self.times), np.asarray(self.values), t)

    def at(self, t: float) -> float:
        """The pressure at time ``t``, MPa."""
        return float(np.interp(t, np.asarray(self.times), np.asarray(self.values)))


class PressedSurface:
    """The faces of one pressure as volume, its derivatives, and the forces of a unit of pressure."""

    def __init__(self, element: Element, points: Array, faces: Indices) -> None:
        at, weights = element.face_rules["gauss"]
        self.N, self.dN = element.face_shape(at)
        self.weights, self.faces = weights, faces
        # The apex of the volume: the nearer it is, the less differs at a rim.
        self._middle = points[np.unique(faces)].mean(axis=0)

    def _frames(self, x: Array) -> tuple[Array, Array, Array]:
        """Place from the apex and the two tangents (f, q, 3) of nodes that are at ``x (n, 3)``."""
        of = x[self.faces] - self._middle
        place = np.einsum("qk,fki->fqi", self.N, of)
        first, second = np.moveaxis(np.einsum("qkj,fki->jfqi", self.dN, of), 0, 0)
        return place, first, second

    def volume(self, x: Array) -> tuple[float, Array, Array]:
        """Volume, mm^3, its gradient (n, 3), and the forces (n, 3) of a unit of outward traction, mm^2."""
        place, first, second = self._frames(x)
        normal = np.cross(first, second)
        volume = float(np.einsum("q,fqi,fqi->", self.weights, place, normal)) / 3.0
        across, along = np.cross(second, place), np.cross(place, first)
        forces = np.einsum("q,qk,fqi->fki", self.weights, self.N, normal)
        gradient = forces + np.einsum("q,qk,fqi->fki", self.weights, self.dN[..., 0], across)
        gradient = (gradient + np.einsum("q,qk,fqi->fki", self.weights, self.dN[..., 1], along)) / 3.0
        at_nodes = np.zeros((2, len(x), 3))
        np.add.at(at_nodes[0], self.faces, gradient)
        np.add.at(at_nodes[1], self.faces, forces)
        return volume, at_nodes[0], at_nodes[1]

    def hessian(self, x: Array) -> Array:
        """Second derivative (f, k, k, 3, 3) of the volume of every face."""
        place, first, second = (_cross_matrix(v) for v in self._frames(x))
        N, a, b = self.N, self.dN[..., 0], self.dN[..., 1]
        on = np.einsum("qk,ql->qkl", N, a), np.einsum("qk,ql->qkl", N, b), np.einsum("qk,ql->qkl", a, b)
        skew = [part - part.transpose(0, 2, 1) for part in on]
        found = np.einsum("q,qkl,fqij->fklij", self.weights, skew[1], first, optimize=True)
        found -= np.einsum("q,qkl,fqij->fklij", self.weights, skew[0], second, optimize=True)
        found -= np.einsum("q,qkl,fqij->fklij", self.weights, skew[2], place, optimize=True)
        return np.asarray(found / 3.0)

    def slope(self, x: Array) -> Array:
        """Derivative (f, k, k, 3, 3) of the forces of a unit of traction; symmetric but for the rim."""
        _, first, second = (_cross_matrix(v) for v in self._frames(x))
        N, a, b = self.N, self.dN[..., 0], self.dN[..., 1]
        found = np.einsum("q,qk,ql,fqij->fklij", self.weights, N, b, first, optimize=True)
        return np.asarray(found - np.einsum("q,qk,ql,fqij->fklij", self.weights, N, a, second, optimize=True))

    def matrix(self, blocks: Array, rows: int) -> sp.csr_matrix:
        """Blocks (f, k, k, 3, 3) as a matrix of all components (3 rows, 3 rows)."""
        component = 3 * self.faces[:, :, None] + np.arange(3)
        r, c = np.broadcast_arrays(component[:, :, None, :, None], component[:, None, :, None, :])
        return sp.csr_matrix((blocks.ravel(), (r.ravel(), c.ravel())), shape=(3 * rows, 3 * rows))

    @cached_property
    def upper_indices(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Upper triangle of a face's component-major matrix."""
        return np.triu_indices(3 * self.faces.shape[1])

    def entries(self, blocks: Array) -> Array:
        """The upper triangles (f, .) of blocks (f, k, k, 3, 3), component by component."""
        k = self.faces.shape[1]
        whole = blocks.transpose(0, 3, 1, 4, 2).reshape(-1, 3 * k, 3 * k)
        return np.asarray(whole[:, self.upper_indices[0], self.upper_indices[1]])


class Pressures:
    """All pressures of a discretised problem."""

    def __init__(
        self, element: Element, points: Array, pressures: Sequence[Pressure], pattern: Pattern
    ) -> None:
        self._points, self._pattern = points, pattern
        self.all = [
            PressedSurface(element, points, np.asarray(one.faces, dtype=np.int64)) for one in pressures
        ]
        self._positions = [
            find_positions(one.faces, pattern.numbers, pattern.indptr, pattern.indices) for one in self.all
        ]

    def evaluate(self, u: Array, values: Sequence[float], rims: Array | float) -> tuple[float, Array, float]:
        """Energy of the pressures ``values (k,)``, MPa, at ``u (r, 3)``, its derivative (r, 3), and the norm
        of the forces, N; ``rims (n, 3)`` as `compute_rims` gave them."""
        x = self._move_points(u)
        residual, total, energy = np.zeros_like(u), np.zeros_like(x), 0.0
        residual[: len(x)] += rims
        energy = float((residual * u).sum())
        for one, p in zip(self.all, values):
            volume, gradient, forces = one.volume(x)
            energy += p * volume
            residual[: len(x)] += p * gradient
            total += p * forces
        return energy, residual, float(np.linalg.norm(total))

    def _move_points(self, u: Array) -> Array:
        return self._points + u[: len(self._points)]

    def compute_rims(self, u: Array, values: Sequence[float]) -> Array:
        """Forces (n, 3) that the pressures have at ``u (r, 3)`` beyond the derivative of their energy, N."""
        x, out = self._move_points(u), np.zeros_like(self._points)
        for one, p in zip(self.all, values):
            _, gradient, forces = one.volume(x)
            out += p * (forces - gradient)
        return out

    def add_tangent(self, u: Array, values: Sequence[float], data: Array) -> None:
        """Add the hessian of the energy to the entries ``data``."""
        x = self._move_points(u)
        for one, p, places in zip(self.all, values, self._positions):
            if p:
                there = places >= 0
                np.add.at(data, places[there], p * one.entries(one.hessian(x))[there])

    def coupling(self, u: Array, values: Sequence[float]) -> sp.csr_matrix:
        """Derivative (unknowns, unknowns) of what a step holds constant at the rims."""
        x, numbers = self._move_points(u), self._pattern.numbers
        free = np.flatnonzero(numbers.ravel() >= 0)
        total = sp.csr_matrix((numbers.size, numbers.size))
        for one, p in zip(self.all, values):
            total = total + p * one.matrix(one.slope(x) - one.hessian(x), len(numbers))
        return total[free][:, free]


def _cross_matrix(v: Array) -> Array:
    """Matrices (..., 3, 3) that take the cross product of ``v (..., 3)`` with a vector."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = np.moveaxis(v, -1, 0)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
