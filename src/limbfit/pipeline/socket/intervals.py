"""Intervals of what a socket does to a limb: from the identified parameters, and from which of them.

To first order a value with the slopes g by the logarithms of the parameters, whose covariance is C, has the
variance g'Cg.  The share of a parameter i is what of it would go if that one were known: (C g)_i^2 / C_ii,
the squared correlation of the two.  Parameters are correlated, so that shares do not add up to one.  The
simulated parameters fit best, others are most probable: intervals cover both, as those of parameters do.

A socket is worn for longer than any record lasts, and how far tissue relaxes by then is known less well
(`limbfit.identify.uncertainty.relaxation`). That moves the value, adds to its variance and bounds how far it
may fall. Its share is what of the squared width of the interval would go without it; those of the parameters
are of the rest.

Contact and large strain are not of first order.  Where parameters drawn from C were simulated too, the mean
of what g misses of them is added to the value, and its variance to that of the value.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Array
from ...identify.fit.prediction import NORMAL_95, change_by_factor, widen_by_relaxation
from ...laws import LAWS, OGDEN
from ...study import Study

CHANGE_PERCENT = 10.0  # of a parameter, for which the change of a value is told
FRICTION = "friction"  # one that has no derivatives
RELAXATION = "relaxation"  # beyond the records, among what an interval comes from
_LEAST = {"kPa": 0.0, "mm": -np.inf}  # contact does not pull; a socket may also move off the limb
_CHANGE = float(np.log1p(CHANGE_PERCENT / 100.0))


@dataclass(frozen=True, eq=False)
class ParameterSpread:
    """How well the study's parameters are known, tissue by tissue; all of their logarithms.

    Beside the ``covariance`` (p, p), ``off`` (p,) is how far the most probable ones are from those that are
    simulated. Relaxation beyond the records moves them by ``shift`` (p,) and adds ``relaxation`` (p, p);
    beside that they may be lower by ``fall`` (p,); or 0.
    """

    covariance: Array
    off: Array
    shift: Array | float = 0.0
    relaxation: Array | float = 0.0
    fall: Array | float = 0.0

    @property
    def is_relaxed(self) -> bool:
        """True if relaxation beyond the records counts."""
        return any(np.any(one) for one in (self.shift, self.relaxation, self.fall))

    def select(self, chosen: Array) -> ParameterSpread:
        """Those of which ``chosen`` (p,) is True."""
        both, shape = np.ix_(chosen, chosen), self.covariance.shape
        shift, fall = (np.broadcast_to(one, shape[:1])[chosen] for one in (self.shift, self.fall))
        relaxation = np.broadcast_to(self.relaxation, shape)[both]
        return ParameterSpread(self.covariance[both], self.off[chosen], shift, relaxation, fall)


@dataclass(frozen=True, eq=False)
class SimulationSpread:
    """How well a simulation's parameters are ``known``: the k that were ``identified``, by their numbers.

    ``names`` are those of all of its parameters by tissue and key, such as ``skin.c_kPa``; a liner's too.
    """

    names: Sequence[str]
    identified: Sequence[int]
    known: ParameterSpread

    @classmethod
    def make(cls, study: Study, names: Sequence[tuple[str, str]], known: ParameterSpread) -> SimulationSpread:
        """For a simulation whose parameters have ``names``, tissue and name, of `Problem.parameter_names`.

        ``known`` is of all of the study's parameters, tissue by tissue.
        """
        own = [(tissue, parameter.name) for tissue in study.tissues for parameter in study.law.parameters]
        simulated = np.array([name in names for name in own])  # fibres that a tissue has not change nothing
        order = [list(names).index(name) for name in own if name in names]
        keyed = []
        for region, name in names:
            law = study.law if region in study.tissues else LAWS[OGDEN]  # a liner's
            keyed += [f"{region}.{parameter.key}" for parameter in law.parameters if parameter.name == name]
        return cls(keyed, order, known.select(simulated))

    def propagate(
        self, value: float, slopes: Array, least: float = 0.0
    ) -> tuple[list[float], dict[str, float], dict[str, float], list[float]]:
        """What is known of a value by its slopes (p,) by the logarithms of all parameters.

        Returns
        -------
        interval : 95 %, the value itself included, from ``least`` on.
        shares : of its squared width by the parameters and `RELAXATION`, percent, that would go if one were
            known, largest first.
        changes : of the value where each parameter of the simulation is ``CHANGE_PERCENT`` larger.
        relaxation : by which relaxation beyond the records moves the value, its standard deviation, and by
            how much the value may be lower beside that.
        """
        known, sign = self.known, -1.0 if value < 0.0 else 1.0
        size, own = sign * value, sign * slopes[list(self.identified)]
        along = known.covariance @ own
        variance = max(float(own @ along), 0.0)
        moved, fall = (float(np.sum(own * part)) for part in (known.shift, known.fall))
        sd = float(np.sqrt(max(float(own @ known.relaxation @ own), 0.0)))
        off, half = float(own @ known.off), NORMAL_95 * np.sqrt(variance)
        own_ends, width = (size + min(off, 0.0), size + max(off, 0.0)), abs(off) + 2.0 * half
        widened = widen_by_relaxation(size, own_ends, half, moved, sd, fall)
        low, high = min(float(widened[0]), size), max(float(widened[1]), size)
        ends = sorted((sign * low, sign * high))
        rest = min(width / max(high - low, np.finfo(float).tiny), 1.0) ** 2 if known.is_relaxed else 1.0
        scale = np.maximum(np.diag(known.covariance) * variance, np.finfo(float).tiny)
        shares = dict(zip((self.names[i] for i in self.identified), 100.0 * rest * along**2 / scale))
        if known.is_relaxed:
            shares[RELAXATION] = 100.0 * (1.0 - rest)
        found = {name: float(shares[name]) for name in sorted(shares, key=lambda name: -shares[name])}
        changes = dict(zip(self.names, map(float, _CHANGE * slopes), strict=True))
        relaxation = [sign * moved, sd, sign * (size - float(change_by_factor(size, -fall)))]
        return [max(end, least) for end in ends], found, changes, relaxation


def spread_to_facts(
    spread: SimulationSpread | None, name: str, unit: str, value: float, slopes: Array | None
) -> dict[str, Any]:
    """As it is stored: interval, shares, changes and relaxation, by keys with its name and unit; or none."""
    parts = (f"interval_{unit}", "interval_from", f"change_{unit}", f"relaxation_{unit}")
    keys = [f"{name}{part}" for part in parts]
    if spread is None or slopes is None:
        return dict.fromkeys(keys)
    return dict(zip(keys, spread.propagate(value, slopes, _LEAST[unit]), strict=True))


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
    The simulated values stay inside. There are two draws or more.
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
        ends = min(value, value + mean - below), max(value, value + mean + above)
        row[f"{name}interval_{unit}"] = [max(end, _LEAST[unit]) for end in ends]
        row[f"{name}missed_{unit}"] = [mean, sd]


def store_change(facts: Mapping[str, Any], other: Mapping[str, Any], of: str) -> None:
    """Store how every value with an interval changes to that of ``other`` facts, beside its other changes."""
    pairs = zip(_iterate_values(facts), _iterate_values(other), strict=True)
    for (row, key, name, unit), (there, *_) in pairs:
        row[f"{name}change_{unit}"][of] = there[key] - row[key]


def _iterate_values(facts: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], str, str, str]]:
    """Every value with an interval: its row, its key there, how names of its facts begin, and its unit."""
    for held in (facts["donning"], *facts["loads"]):
        for row in held["regions"]:
            yield row, "mean_kPa", "", "kPa"
        if "settling_mm" in held:
            yield held, "settling_mm", "settling_", "mm"
