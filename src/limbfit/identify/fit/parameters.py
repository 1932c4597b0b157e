"""The parameters of the search: which ones move together, how they are scaled, and their bounds.

A simulation sees the full vector of positive parameters. The search sees ``z``, the logarithms of the groups
of parameters that move together. A step in ``z`` is a relative change, so kPa and seconds need no weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays import Array, Mask
from ...errors import ProblemError
from .readings import LinearisedReadings

Grouping = tuple[int, ...]

FIXED = -1
_BOUND_TOLERANCE_LOG = 1e-3  # nearer to a bound, in logarithms, is at it


def group_by_kind(names: Sequence[str]) -> Grouping:
    """Group the parameters ``<tissue>.<name>`` of one name, so that all tissues are one material."""
    kinds = [name.rpartition(".")[2] for name in names]
    first = list(dict.fromkeys(kinds))
    return tuple(first.index(kind) for kind in kinds)


def group_separately(names: Sequence[str]) -> Grouping:
    """Put every parameter in a group of its own, so that every tissue is its own material."""
    return tuple(range(len(names)))


def build_stage_groupings(names: Sequence[str]) -> tuple[Grouping, ...]:
    """Return the groupings of the stages: one material, then one per tissue (paper, section 2.3).

    A single tissue has one stage, because the second would repeat the first.
    """
    first, second = group_by_kind(names), group_separately(names)
    return (first,) if first == second else (first, second)


def constrain(
    grouping: Sequence[int],
    names: Sequence[str],
    fixed: Sequence[str] = (),
    tied: Sequence[Sequence[str]] = (),
) -> Grouping:
    """Return ``grouping`` with each set of ``tied`` parameters in one group and the ``fixed`` ones in none.

    A group has the number of its first parameter, so that groupings are equal where the same parameters move
    together. Names are known, and ties are of one kind and free, as the study has checked where they are
    stated.
    """
    found = list(grouping)
    for group in tied:
        members = {found[names.index(name)] for name in group}
        found = [min(members) if number in members else number for number in found]
    found = [FIXED if name in fixed else number for name, number in zip(names, found, strict=True)]
    return tuple(FIXED if number == FIXED else found.index(number) for number in found)


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter before the fit: a lognormal distribution.

    The standard deviation of the logarithm is ``ln(factor)``, with a factor above 1.
    """

    name: str
    median: float
    factor: float


@dataclass(frozen=True)
class Unknowns:
    """The full parameter vector: ``names``, ``start``, ``lower`` and ``upper``, each (p,), all positive.

    ``priors`` of some of the parameters, and linearised ``readings``, count in the fit beside the forces.
    """

    names: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    priors: tuple[Prior, ...] = ()
    readings: LinearisedReadings | None = None

    def __post_init__(self) -> None:
        for name, low, start, high in zip(self.names, self.lower, self.start, self.upper, strict=True):
            if not 0 < low <= start <= high or low == high:
                what = f"needs 0 < lower <= start <= upper, has {low:g}, {start:g}, {high:g}"
                raise ProblemError(what, place=name, remedy="give positive bounds around the start")

    def with_start(self, start: Array) -> Unknowns:
        """Return the same unknowns with another start, which is clipped to the bounds."""
        return replace(self, start=np.clip(start, self.lower, self.upper))

    def is_at_bound(self, parameters: Array) -> Mask:
        """Return (p,) True for each parameter that lies at one of its bounds."""
        low, high = np.log(parameters / self.lower), np.log(self.upper / parameters)
        return np.asarray(np.minimum(low, high) < _BOUND_TOLERANCE_LOG)

    def build_prior_rows(self) -> tuple[Array, Array]:
        """Return ``(A, b)``: ``A @ log(parameters) - b`` are deviations in standard deviations, from priors
        and then from readings.
        """
        rows = np.zeros((len(self.priors), len(self.names)))
        target = np.zeros(len(self.priors))
        for i, prior in enumerate(self.priors):
            rows[i, self.names.index(prior.name)] = 1 / np.log(prior.factor)
            target[i] = np.log(prior.median) / np.log(prior.factor)
        if self.readings is None:
            return rows, target
        return np.vstack([rows, self.readings.rows]), np.concatenate([target, self.readings.target])


@dataclass(frozen=True)
class SearchSpace:
    """The search space of one stage: ``log(parameters) = fixed_log + tie @ z`` with ``lower <= z <= upper``.

    ``fixed_log`` is (p,), ``tie`` (p, k) of zeros and ones, ``lower`` and ``upper`` (k,). Parameters that do
    not move keep ``fixed_values`` (p,) to the last digit.
    """

    fixed_log: Array
    tie: Array
    lower: Array
    upper: Array
    fixed_values: Array

    def to_logarithms(self, z: Array) -> Array:
        """Return the logarithms (..., p) of the full parameters at z (..., k)."""
        return self.fixed_log + z @ self.tie.T

    def expand(self, z: Array) -> Array:
        """Return the full parameters (..., p) at z (..., k)."""
        return np.where(self.tie.any(axis=1), np.exp(self.to_logarithms(z)), self.fixed_values)

    def reduce(self, logarithms: Array) -> Array:
        """Return z (k,) for logarithms (p,): the mean of each group's members, clipped to the bounds."""
        return np.clip(self.tie.T @ logarithms / self.tie.sum(axis=0), self.lower, self.upper)

    def clip(self, logarithms: Array) -> Array:
        """Clip logarithms (..., p) of parameters that move to the bounds of their group."""
        inside = np.clip(logarithms, self.tie @ self.lower, self.tie @ self.upper)
        return np.where(self.tie.any(axis=1), inside, logarithms)

    @property
    def bounds_sd(self) -> Array:
        """Standard deviations (k,) of uniform distributions between the bounds."""
        return (self.upper - self.lower) / np.sqrt(12.0)

    def pull_back(self, jacobian: Array, parameters: Array) -> Array:
        """Return derivatives with respect to z (n, k) from those with respect to the parameters (n, p)."""
        return (jacobian * parameters) @ self.tie


def build_space(unknowns: Unknowns, grouping: Sequence[int]) -> SearchSpace:
    """Build the space of a stage, in which parameters of equal group number move together (-1: not at all).

    A group stays within the bounds of all its members.
    """
    groups = sorted(set(grouping) - {FIXED})
    members = np.array(grouping)
    tie = np.array([[float(member == group) for group in groups] for member in members])
    lower = np.array([np.log(unknowns.lower[members == group]).max() for group in groups])
    upper = np.array([np.log(unknowns.upper[members == group]).min() for group in groups])
    if not groups or np.any(lower >= upper):
        remedy = "fix fewer, or widen the bounds of those that are tied"
        raise ProblemError("no parameter is left to move", remedy=remedy)
    fixed = np.where(members == FIXED, np.log(unknowns.start), 0.0)
    return SearchSpace(fixed, tie, lower, upper, unknowns.start)
