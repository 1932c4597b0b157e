"""Intervals of what a socket does to a limb: from the identified parameters, and from which of them.

To first order a value with the slopes g by the logarithms of the parameters, whose covariance is C, has the
variance g'Cg.  The share of a parameter i is what of it would go if that one were known: (C g)_i^2 / C_ii,
the squared correlation of the two.  Parameters are correlated, so that shares do not add up to one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...identify.uncertainty.uncertainty import NORMAL_95
from ...laws import LAWS, OGDEN, TissueLaw
from ...study import Study

Array = NDArray[np.float64]

CHANGE_PERCENT = 10.0  # of a parameter, for which the change of a value is told


@dataclass(frozen=True, eq=False)
class Spread:
    """How well a simulation's parameters are known.

    Attributes
    ----------
    names : of its parameters by tissue and key, such as ``skin.c_kPa``; a liner's too.
    identified : (k,) numbers of those that were identified.
    covariance : (k, k) of their logarithms.
    """

    names: Sequence[str]
    identified: Sequence[int]
    covariance: Array

    @classmethod
    def of(cls, study: Study, names: Sequence[tuple[str, str]], covariance: Array) -> Spread:
        """For a simulation whose parameters have ``names``, tissue and name, of `Problem.parameter_names`.

        ``covariance`` is that of all of the study's parameters, tissue by tissue.
        """
        laws = dict.fromkeys(study.tissues, study.law)
        own = [(tissue, parameter.name) for tissue in study.tissues for parameter in study.law.parameters]
        known = np.array([name in names for name in own])  # fibres that a tissue has not change nothing
        order = [list(names).index(name) for name in own if name in names]
        keyed = [f"{region}.{_key(laws.get(region, LAWS[OGDEN]), name)}" for region, name in names]
        return cls(keyed, order, covariance[np.ix_(known, known)])

    def told(self, value: float, slopes: Array) -> tuple[list[float], dict[str, float], dict[str, float]]:
        """What is known of a positive value by its slopes (p,) by the logarithms of all parameters.

        Returns
        -------
        interval : 95 %.
        shares : of its variance, percent, that would go if a parameter were known, largest first.
        changes : of the value where each parameter of the simulation is ``CHANGE_PERCENT`` larger.
        """
        own = slopes[list(self.identified)]
        along = self.covariance @ own
        variance = float(own @ along)
        half = NORMAL_95 * np.sqrt(max(variance, 0.0))
        scale = np.maximum(np.diag(self.covariance) * variance, np.finfo(float).tiny)
        shares = 100.0 * along**2 / scale
        found = {self.names[self.identified[i]]: float(shares[i]) for i in np.argsort(-shares)}
        by = np.log1p(CHANGE_PERCENT / 100.0) * slopes
        changes = dict(zip(self.names, map(float, by), strict=True))
        return [max(value - half, 0.0), value + half], found, changes


def _key(law: TissueLaw, name: str) -> str:
    return next(parameter.key for parameter in law.parameters if parameter.name == name)


def spread_facts(
    spread: Spread | None, name: str, unit: str, value: float, slopes: Array | None
) -> dict[str, Any]:
    """As it is stored: interval, shares and changes of a value, by keys with its name and unit; or none."""
    keys = (f"{name}interval_{unit}", f"{name}interval_from", f"{name}change_{unit}")
    found = (None,) * len(keys) if spread is None or slopes is None else spread.told(value, slopes)
    return dict(zip(keys, found, strict=True))
