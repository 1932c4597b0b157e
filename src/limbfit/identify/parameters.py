"""Which parameters move, how they are scaled, and between which bounds.

The solver of the inverse problem sees ``z``, the logarithms of the groups that move; a simulation sees the
full vector of positive parameters. Steps in ``z`` are relative changes, so kPa and seconds need no weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError

Array = NDArray[np.float64]
Grouping = tuple[int, ...]

FIXED = -1


def shared(names: Sequence[str]) -> Grouping:
    """One material: parameters ``<tissue>.<name>`` of one name move together, whatever their tissue."""
    kinds = [name.rpartition(".")[2] for name in names]
    first = list(dict.fromkeys(kinds))
    return tuple(first.index(kind) for kind in kinds)


def separate(names: Sequence[str]) -> Grouping:
    """Every tissue its own material."""
    return tuple(range(len(names)))


def two_stages(names: Sequence[str]) -> tuple[Grouping, ...]:
    """One material for all tissues, then each its own (paper, section 2.3, figure 5).

    A single tissue has one stage: the second would repeat it.
    """
    first, second = shared(names), separate(names)
    return (first,) if first == second else (first, second)


@dataclass(frozen=True)
class Unknowns:
    """The full parameter vector: ``names``, ``start``, ``lower`` and ``upper``, each (p,), all positive."""

    names: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        for name, low, start, high in zip(self.names, self.lower, self.start, self.upper, strict=True):
            if not 0 < low <= start <= high or low == high:
                what = f"needs 0 < lower <= start <= upper, has {low:g}, {start:g}, {high:g}"
                raise ProblemError(what, place=name, remedy="give positive bounds around the start")


@dataclass(frozen=True)
class Space:
    """The search space of one stage: ``log(parameters) = fixed + tie @ z`` with ``lower <= z <= upper``.

    ``fixed`` is (p,), ``tie`` (p, k) of zeros and ones, ``lower`` and ``upper`` (k,).
    """

    fixed: Array
    tie: Array
    lower: Array
    upper: Array

    def logarithms(self, z: Array) -> Array:
        """Logarithms (p,) of the full parameters at z (k,)."""
        return self.fixed + self.tie @ z

    def expand(self, z: Array) -> Array:
        """The full parameters (p,) at z (k,)."""
        return np.exp(self.logarithms(z))

    def reduce(self, logarithms: Array) -> Array:
        """z (k,) of logarithms (p,): group members are averaged, and clipped to the bounds."""
        return np.clip(self.tie.T @ logarithms / self.tie.sum(axis=0), self.lower, self.upper)

    def pull_back(self, jacobian: Array, parameters: Array) -> Array:
        """Derivatives with respect to z, (n, k), from those with respect to the parameters, (n, p)."""
        return (jacobian * parameters) @ self.tie


def search_space(unknowns: Unknowns, grouping: Sequence[int]) -> Space:
    """The space of a stage: parameters with equal numbers move together, those with -1 stay at their start.

    A group keeps to the bounds of all its members.
    """
    if len(grouping) != len(unknowns.names):
        raise ProblemError(f"{len(grouping)} group numbers for {len(unknowns.names)} parameters")
    groups = sorted(set(grouping) - {FIXED})
    members = np.array(grouping)
    tie = np.array([[float(member == group) for group in groups] for member in members])
    lower = np.array([np.log(unknowns.lower[members == group]).max() for group in groups])
    upper = np.array([np.log(unknowns.upper[members == group]).min() for group in groups])
    if not groups or np.any(lower >= upper):
        raise ProblemError("no parameter is left to move", remedy="check the groups and their bounds")
    fixed = np.where(members == FIXED, np.log(unknowns.start), 0.0)
    return Space(fixed, tie, lower, upper)
