"""Which parameters move, how they are scaled, and between which bounds.

The solver of the inverse problem sees ``z``, the logarithms of the groups that move; a simulation sees the
full vector of positive parameters. Steps in ``z`` are relative changes, so kPa and seconds need no weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError

Array = NDArray[np.float64]
Grouping = tuple[int, ...]

FIXED = -1
_EDGE = 1e-3  # nearer to a bound, in logarithms, is at it


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


def constrained(
    grouping: Sequence[int],
    names: Sequence[str],
    fixed: Sequence[str] = (),
    tied: Sequence[Sequence[str]] = (),
) -> Grouping:
    """``grouping`` with the parameters of each set of ``tied`` in one group, and those of ``fixed`` in none.

    Raises
    ------
    ProblemError
        For an unknown name, a tie of unlike parameters, or one that is fixed too.
    """
    for name in (*fixed, *(name for group in tied for name in group)):
        if name not in names:
            raise ProblemError(f"no parameter is named {name!r}", remedy=f"use {', '.join(names)}")
    found = list(grouping)
    for group in tied:
        if len(group) < 2 or len({name.rpartition(".")[2] for name in group}) > 1:
            what = f"{', '.join(group)} cannot be tied"
            raise ProblemError(what, remedy="tie two or more of a kind, such as skin.tau_s and muscle.tau_s")
        if set(group) & set(fixed):
            raise ProblemError(f"{', '.join(group)}: tied and fixed", remedy="fix all of them, or none")
        members = {found[names.index(name)] for name in group}
        found = [min(members) if number in members else number for number in found]
    return tuple(FIXED if name in fixed else number for name, number in zip(names, found, strict=True))


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter beforehand: lognormal, its logarithm's standard deviation ln(factor)."""

    name: str
    median: float
    factor: float

    def __post_init__(self) -> None:
        if not (self.median > 0 and self.factor > 1):
            what = f"a prior needs median > 0 and factor > 1, has {self.median:g}, {self.factor:g}"
            raise ProblemError(what, place=self.name)


@dataclass(frozen=True)
class Unknowns:
    """The full parameter vector: ``names``, ``start``, ``lower`` and ``upper``, each (p,), all positive.

    ``priors`` of some of them count beside the forces.
    """

    names: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    priors: tuple[Prior, ...] = ()

    def __post_init__(self) -> None:
        for prior in self.priors:
            if prior.name not in self.names:
                remedy = f"use {', '.join(self.names)}"
                raise ProblemError(f"a prior of {prior.name!r}, which is not a parameter", remedy=remedy)
        for name, low, start, high in zip(self.names, self.lower, self.start, self.upper, strict=True):
            if not 0 < low <= start <= high or low == high:
                what = f"needs 0 < lower <= start <= upper, has {low:g}, {start:g}, {high:g}"
                raise ProblemError(what, place=name, remedy="give positive bounds around the start")

    def from_start(self, start: Array) -> Unknowns:
        """The same, started elsewhere."""
        return replace(self, start=np.clip(start, self.lower, self.upper))

    def at_bound(self, parameters: Array) -> NDArray[np.bool_]:
        """Which of the parameters (p,) lie at one of their bounds."""
        low, high = np.log(parameters / self.lower), np.log(self.upper / parameters)
        return np.asarray(np.minimum(low, high) < _EDGE)

    def prior_rows(self) -> tuple[Array, Array]:
        """``(A, b)``: ``A @ log(parameters) - b`` is how many standard deviations off each prior is."""
        rows = np.zeros((len(self.priors), len(self.names)))
        target = np.zeros(len(self.priors))
        for i, prior in enumerate(self.priors):
            rows[i, self.names.index(prior.name)] = 1 / np.log(prior.factor)
            target[i] = np.log(prior.median) / np.log(prior.factor)
        return rows, target


@dataclass(frozen=True)
class Space:
    """The search space of one stage: ``log(parameters) = fixed + tie @ z`` with ``lower <= z <= upper``.

    ``fixed`` is (p,), ``tie`` (p, k) of zeros and ones, ``lower`` and ``upper`` (k,). ``stated`` (p,) are the
    values of parameters that do not move, which they keep to the last digit.
    """

    fixed: Array
    tie: Array
    lower: Array
    upper: Array
    stated: Array

    def logarithms(self, z: Array) -> Array:
        """Logarithms (p,) of the full parameters at z (k,)."""
        return self.fixed + self.tie @ z

    def expand(self, z: Array) -> Array:
        """The full parameters (p,) at z (k,)."""
        return np.where(self.tie.any(axis=1), np.exp(self.logarithms(z)), self.stated)

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
    return Space(fixed, tie, lower, upper, unknowns.start)
