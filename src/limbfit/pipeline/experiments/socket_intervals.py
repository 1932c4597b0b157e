"""Intervals of what a socket does to a limb: from the identified parameters, and from which of them.

To first order a value with the slopes g by the logarithms of the parameters, whose covariance is C, has the
variance g'Cg.  The share of a parameter i is what of it would go if that one were known: (C g)_i^2 / C_ii,
the squared correlation of the two.  Parameters are correlated, so that shares do not add up to one.  The
simulated parameters fit best, others are most probable: intervals cover both, as those of parameters do.

Contact and large strain are not of first order.  Where parameters drawn from C were simulated too, the mean
of what g misses of them is added to the value, and its variance to that of the value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.uncertainty.uncertainty import NORMAL_95
from ...laws import LAWS, OGDEN, TissueLaw
from ...study import Study

CHANGE_PERCENT = 10.0  # of a parameter, for which the change of a value is told
FRICTION = "friction"  # one that has no derivatives
_CHANGE = float(np.log1p(CHANGE_PERCENT / 100.0))


@dataclass(frozen=True, eq=False)
class SimulationSpread:
    """How well a simulation's parameters are known.

    Attributes
    ----------
    names : of its parameters by tissue and key, such as ``skin.c_kPa``; a liner's too.
    identified : (k,) numbers of those that were identified.
    covariance : (k, k) of their logarithms.
    off : (k,) how far the logarithms of the most probable ones are from those that are simulated.
    """

    names: Sequence[str]
    identified: Sequence[int]
    covariance: Array
    off: Array

    @classmethod
    def of(
        cls, study: Study, names: Sequence[tuple[str, str]], covariance: Array, off: Array
    ) -> SimulationSpread:
        """For a simulation whose parameters have ``names``, tissue and name, of `Problem.parameter_names`.

        ``covariance`` and ``off`` are those of all of the study's parameters, tissue by tissue.
        """
        laws = dict.fromkeys(study.tissues, study.law)
        own = [(tissue, parameter.name) for tissue in study.tissues for parameter in study.law.parameters]
        known = np.array([name in names for name in own])  # fibres that a tissue has not change nothing
        order = [list(names).index(name) for name in own if name in names]
        keyed = [f"{region}.{_find_key(laws.get(region, LAWS[OGDEN]), name)}" for region, name in names]
        return cls(keyed, order, covariance[np.ix_(known, known)], off[known])

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
        by = _CHANGE * slopes
        changes = dict(zip(self.names, map(float, by), strict=True))
        ends = sorted((value, value + float(own @ self.off)))
        return [max(ends[0] - half, 0.0), ends[1] + half], found, changes


def _find_key(law: TissueLaw, name: str) -> str:
    return next(parameter.key for parameter in law.parameters if parameter.name == name)


def spread_to_facts(
    spread: SimulationSpread | None, name: str, unit: str, value: float, slopes: Array | None
) -> dict[str, Any]:
    """As it is stored: interval, shares and changes of a value, by keys with its name and unit; or none."""
    keys = (f"{name}interval_{unit}", f"{name}interval_from", f"{name}change_{unit}")
    found = (None,) * len(keys) if spread is None or slopes is None else spread.told(value, slopes)
    return dict(zip(keys, found, strict=True))


def draw_step(covariance: Array, number: int, seed: int = 0) -> Array:
    """The ``number``-th draw (k,) from the ``covariance (k, k)``, of the logarithms of parameters."""
    random = np.random.default_rng([seed, number])
    return random.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh")


def predict_change(row: Mapping[str, Any], name: str, unit: str, step: Mapping[str, float]) -> float:
    """A stored value's change by its derivatives, where the logarithms of parameters change by ``step``."""
    slopes = row[f"{name}change_{unit}"]
    return float(sum(slopes[key] * by for key, by in step.items() if key in slopes)) / _CHANGE


def widen_intervals(
    facts: Mapping[str, Any], draws: Sequence[tuple[Mapping[str, float], Mapping[str, Any]]]
) -> None:
    """Widen the intervals of stored facts by what derivatives miss of ``draws``: steps, and facts there.

    That, mean and standard deviation, is stored beside each interval: ``missed_kPa``, ``settling_missed_mm``.
    There are two draws or more.
    """
    others = [list(_iterate_values(found)) for _, found in draws]
    for i, (row, key, name, unit) in enumerate(_iterate_values(facts)):
        value, (low, high) = row[key], row[f"{name}interval_{unit}"]
        missed = [
            other[i][0][key] - value - predict_change(row, name, unit, step)
            for (step, _), other in zip(draws, others, strict=True)
        ]
        mean, sd = float(np.mean(missed)), float(np.std(missed, ddof=1))
        below, above = (float(np.hypot(end - value, NORMAL_95 * sd)) for end in (low, high))
        row[f"{name}interval_{unit}"] = [max(value + mean - below, 0.0), value + mean + above]
        row[f"{name}missed_{unit}"] = [mean, sd]


def store_change(facts: Mapping[str, Any], other: Mapping[str, Any], of: str) -> None:
    """Store how every value with an interval changes to that of ``other`` facts, beside its other changes."""
    for (row, key, name, unit), (there, *_) in zip(
        _iterate_values(facts), _iterate_values(other), strict=True
    ):
        row[f"{name}change_{unit}"][of] = there[key] - row[key]


def _iterate_values(facts: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], str, str, str]]:
    """Every value with an interval: its row, its key there, how names of its facts begin, and its unit."""
    for held in (facts["donning"], *facts["loads"]):
        for row in held["regions"]:
            yield row, "mean_kPa", "", "kPa"
        if "settling_mm" in held:
            yield held, "settling_mm", "settling_", "mm"
