"""Sites whose record does not belong to the model that the others agree on, found after the fit.

Each site is left out and predicted from the others; its standardised error is that prediction's over the
error with which sites *other than it* are predicted when it has no say (both left out), so that one bad
record cannot hide behind the misfit that it causes. For two bad records, pairs are left out together. The
force ratio of measured over predicted names a unit; Cook's distance says how much a site moves the fit; an
exchange of two records that lowers the misfit of all sites says that names were swapped.

The fits are regularised Gauss-Newton on ``simulate``, which is meant to be cheap: :class:`FirstOrder` around
the answer, or an emulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...phases import boundaries, find_phases
from ..fit.objective import Measured, Simulate, SiteResponse, check_responses
from .first_order import _FLOOR, ERROR, GAIN, LARGE, Correction, FirstOrder, LeftOut, Sites
from .plausibility import UNITS, Flag

Array = NDArray[np.float64]
History = tuple[Array, Array]

_SHARE = 0.25  # of the logarithm of a unit's factor: how near the force ratio must come
_MOST = 3  # corrections that are looked for
_LOOKED_AT = 3  # exchanges that are simulated
_WORST = 8  # sites of which pairs and units are tried
MIN_SITES = 4
FORCE_UNITS = {name: force for name, (force, travel, time) in UNITS.items() if travel == time == 1.0}


def leave_one_out(simulate: Simulate, measured: Sequence[Measured], start: Array) -> tuple[LeftOut, ...]:
    """Every site predicted from all others.

    Parameters
    ----------
    simulate : all sites of ``measured``, in order; cheap.
    start : the answer (p,) that the fits start from and are drawn to where the data say nothing.
    """
    return tuple(_left_out(Sites(simulate, measured, start)))


def _left_out(sites: Sites) -> list[LeftOut]:
    whole = [r.force_N for r in sites.simulate(sites.without())]
    misfit = max(float(np.mean(sites.errors(sites.without()) ** 2)), (_FLOOR / 2) ** 2)
    found = []
    for i, site in enumerate(sites.measured):
        parameters = sites.without(i)
        moved = [
            np.mean((r.force_N - w) ** 2) / peak**2
            for r, w, peak in zip(sites.simulate(parameters), whole, sites.peaks)
        ]
        found.append(
            LeftOut(
                site=site.name,
                error=float(sites.errors(parameters)[i]),
                expected=sites.expected(i),
                ratio=sites.ratio(i, parameters),
                cook=float(np.sum(moved) / (len(sites.start) * misfit)),
            )
        )
    return found


def suspects(
    simulate: Simulate, measured: Sequence[Measured], start: Array
) -> tuple[tuple[LeftOut, ...], tuple[int, ...]]:
    """Every site left out, and the indices of those that do not belong: none, one, or a pair.

    Fewer than four sites cannot tell who is wrong.
    """
    number = _number_of_sites(measured)
    if number < MIN_SITES:
        return (), ()
    sites = Sites(simulate, measured, start)
    singles = _left_out(sites)
    best = int(np.argmax([single.standardised for single in singles]))
    alone = singles[best].standardised if singles[best].error > ERROR else 0.0
    pair, together = _worst_pair(sites, singles)
    if together > LARGE and together > 1.5 * alone and number > MIN_SITES:
        return tuple(singles), pair
    return tuple(singles), (best,) if alone > LARGE else ()


def _worst_pair(sites: Sites, singles: Sequence[LeftOut]) -> tuple[tuple[int, ...], float]:
    """The two sites that, both left out, are predicted worst by the rest; 0 where one of them is fine."""
    everyone = sites.errors(sites.without())
    if max(everyone.max(), *(single.error for single in singles)) <= ERROR / 2:
        return (), 0.0
    found: tuple[tuple[int, ...], float] = ((), 0.0)
    for i, j in _pairs(sites.measured, _worst(sites, everyone)):
        errors = sites.errors(sites.without(i, j))[[i, j]]
        if errors.min() < ERROR:
            continue
        size = float(np.sqrt(np.mean(errors**2))) / sites.expected(i, j)
        if size > found[1]:
            found = ((i, j), size)
    return found


Exchange = Callable[[Array, int, int], tuple[SiteResponse, SiteResponse]]


def as_driven(response: SiteResponse, own: History, other: History) -> SiteResponse:
    """About what a site would answer to another site's record: the curve stretched in time, and by a power
    law in depth, whose exponent is that of its own loading.

    Parameters
    ----------
    own, other : times (n,) s and depths (n,) mm of its record and of the other one.
    """
    (time, depth), (_, other_depth) = own, other
    deep = depth.max()
    rising = np.zeros(len(time), dtype=bool)
    for phase in find_phases(time, depth):
        if phase.kind == "load":
            rising |= (time >= phase.start_s) & (time <= phase.end_s)
    loading, force = depth[rising], response.force_N[rising]
    used = (loading > 0.3 * deep) & (force > 0)
    exponent = float(np.polyfit(np.log(loading[used]), np.log(force[used]), 1)[0]) if used.sum() > 2 else 1.0
    factor = (other_depth.max() / deep) ** np.clip(exponent, 0.5, 4.0)
    at = _same_moment(own, other)
    columns = [np.interp(at, time, column) for column in response.jacobian.T]
    return SiteResponse(factor * np.interp(at, time, response.force_N), factor * np.stack(columns, axis=1))


def _same_moment(own: History, other: History) -> Array:
    """The times (n,) of a site's own record at which it has come as far as the other one at its times.

    As far in the same phase; in the same share of the whole where they do not have the same phases.
    """
    mine, theirs = find_phases(*own), find_phases(*other)
    if [phase.kind for phase in mine] == [phase.kind for phase in theirs]:
        return np.asarray(np.interp(other[0], boundaries(theirs), boundaries(mine)))
    return other[0] / other[0][-1] * own[0][-1]


def best_correction(
    simulate: Simulate,
    measured: Sequence[Measured],
    start: Array,
    exchange: Exchange,
    exactly: Exchange | None = None,
) -> Correction | None:
    """The one change of names or of a unit that lowers the misfit of all sites most; None where none
    convinces.

    Parameters
    ----------
    exchange : at parameters (p,), the responses of the first site to the second's record, and of the second
        to the first's, each at the times of the record; may be an approximation (``as_driven``).
    exactly : the same by simulation, asked for the few exchanges that may matter, which it then judges; one
        that fails is not judged.
    """
    as_is = Sites(simulate, measured, start)
    before = as_is.errors(as_is.without())
    if before.max() <= ERROR / 2:
        return None  # nothing to explain
    worst = sorted(_worst(as_is, before))
    forces = [i for i in worst if measured[i].unit == "N"]
    units = [converted(simulate, measured, start, i, unit, before) for i in forces for unit in FORCE_UNITS]
    pairs = _pairs(measured, worst)
    swaps = [exchanged(simulate, measured, start, pair, exchange, before) for pair in pairs]
    if exactly is not None:
        likely = sorted((s for s in swaps if s.gain > GAIN / 2), key=lambda s: -s.gain)[:_LOOKED_AT]
        known = [_pair(s) for s in likely if all(r.completed for r in exactly(start, *_pair(s)))]
        swaps = [exchanged(simulate, measured, start, pair, exactly, before) for pair in known]
    convincing = [found for found in (*units, *swaps) if found.convinces]
    return max(convincing, key=lambda found: found.gain, default=None)


def _number_of_sites(measured: Sequence[Measured]) -> int:
    return len({one.where for one in measured})


def _pairs(measured: Sequence[Measured], some: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of records that are of two sites and compare the same, force or depth."""
    pairs = [(i, j, measured[i], measured[j]) for i, j in combinations(sorted(some), 2)]
    return [(i, j) for i, j, one, two in pairs if one.where != two.where and one.unit == two.unit]


def _exchanged(measured: Sequence[Measured], i: int, j: int) -> list[Measured]:
    """Two records in each other's place."""
    found = list(measured)
    found[i] = replace(measured[j], site=measured[i].where)
    found[j] = replace(measured[i], site=measured[j].where)
    return found


def _pair(found: Correction) -> tuple[int, int]:
    i, j = found.sites
    return i, j


def _worst(sites: Sites, before: Array) -> list[int]:
    """The sites that are predicted worst, with or without themselves, at most eight."""
    alone = [sites.errors(sites.without(i))[i] for i in range(len(before))]
    return [int(i) for i in np.argsort(-np.maximum(before, alone))[:_WORST]]


@dataclass(frozen=True)
class Findings:
    """What was found: every site left out as the records are named, and the flags."""

    left_out: tuple[LeftOut, ...]
    flags: tuple[Flag, ...]


def find_outliers(
    simulate: Simulate,
    measured: Sequence[Measured],
    start: Array,
    exchange: Callable[[FirstOrder], Exchange],
    exactly: Exchange | None = None,
    neutral: Array | None = None,
) -> Findings:
    """Look for names exchanged, units of force, and sites that do not belong, one after the other.

    A correction that convinces is flagged and applied before the next is looked for, so that what is left is
    judged by what is right. Fewer than four sites cannot tell who is wrong: there is no finding then.

    Where the fit that ``start`` comes from was led astray, sites are off everywhere, and two materials end at
    bounds to please a wrong record. Then sites are looked at from ``neutral``, the answer with one material,
    which cannot be led as far.

    Parameters
    ----------
    simulate : all sites; called at ``start``, and at ``neutral`` where that is needed.
    exchange : from the expansion of all sites to the exchange of two, approximately (``as_driven``).
    exactly : the same by simulation.
    """
    if _number_of_sites(measured) < MIN_SITES:
        return Findings((), ())
    first = FirstOrder(start, simulate(start))
    named = leave_one_out(first, measured, start)
    if neutral is not None and Sites(first, measured, start).errors(start).max() > ERROR:
        responses = simulate(neutral)
        if not check_responses(responses, measured, len(neutral)):
            first = FirstOrder(neutral, responses)
    return Findings(named, _flags(first, measured, exchange(first), exactly))


def _flags(
    first: FirstOrder, measured: Sequence[Measured], exchange: Exchange, exactly: Exchange | None
) -> tuple[Flag, ...]:
    start = first.parameters
    respond: Simulate = first
    flags, corrected = [], list(measured)
    for _ in range(_MOST):
        found = best_correction(respond, corrected, start, exchange, exactly)
        if found is None:
            break
        if found.kind == "unit":
            i = found.sites[0]
            factor = FORCE_UNITS[found.cause]
            corrected[i] = replace(corrected[i], force_N=corrected[i].force_N / factor)
        else:
            i, j = found.sites
            respond = _renamed(respond, start, (i, j), exactly or exchange)
            corrected = _exchanged(corrected, i, j)
        flags.append(flag_of_correction(found, [site.name for site in measured]))
    singles, odd = suspects(respond, corrected, start)
    flags += [flag_of(singles[i], measured[i].unit) for i in odd if not _named(flags, measured[i].name)]
    return tuple(flags)


def _named(flags: Sequence[Flag], site: str) -> bool:
    return any(site in flag.sites for flag in flags)


def _renamed(simulate: Simulate, start: Array, pair: tuple[int, int], exchange: Exchange) -> Simulate:
    """The same sites, two of them driven by each other's record."""
    i, j = pair
    moved = FirstOrder(start, exchange(start, i, j))

    def respond(parameters: Array) -> list[SiteResponse]:
        responses = list(simulate(parameters))
        responses[i], responses[j] = moved(parameters)
        return responses

    return respond


def converted(
    simulate: Simulate, measured: Sequence[Measured], start: Array, i: int, unit: str, before: Array
) -> Correction:
    """The fit to all sites with the force of one converted; ``before`` are the errors without."""
    renamed = list(measured)
    renamed[i] = replace(measured[i], force_N=measured[i].force_N / FORCE_UNITS[unit])
    return _correction("unit", (i,), unit, before, Sites(simulate, renamed, start))


def exchanged(
    simulate: Simulate,
    measured: Sequence[Measured],
    start: Array,
    pair: tuple[int, int],
    exchange: Exchange,
    before: Array,
) -> Correction:
    """The fit to all sites with the records of two exchanged; ``before`` are the errors without."""
    renamed = _exchanged(measured, *pair)
    sites = Sites(_renamed(simulate, start, pair, exchange), renamed, start)
    return _correction("swap", pair, "swapped site names", before, sites)


def _correction(
    kind: Literal["swap", "unit"], which: tuple[int, ...], cause: str, before: Array, sites: Sites
) -> Correction:
    after = sites.errors(sites.without())
    gain = float(np.sum(before**2) / max(np.sum(after**2), len(after) * (_FLOOR / 2) ** 2))
    pairs = [(float(before[i]), float(after[i])) for i in which]
    return Correction(
        kind,
        which,
        cause,
        gain,
        tuple(b for b, _ in pairs),
        tuple(a for _, a in pairs),
        float(before.max()),
    )


def flag_of(found: LeftOut, of: str = "N") -> Flag:
    """The flag of a site that does not belong, with the unit that its force ratio is near.

    ``of`` is the unit of what is compared: a depth of another unit was seen before.
    """
    numbers = {
        "prediction_error_percent": 100 * found.error,
        "expected_error_percent": 100 * found.expected,
        "standardised_error": found.standardised,
        "force_ratio": found.ratio,
        "cooks_distance": found.cook,
    }
    what = (
        f"predicted from the other sites, it is off by {100 * found.error:.0f} % of its peak, "
        f"{found.standardised:.1f} times as much as they are (measured {found.ratio:.2f} times predicted)"
    )
    unit = unit_of(found.ratio) if of == "N" else ""
    if unit:
        return Flag((found.site,), "unit", what, numbers, unit, "convert the force to N")
    cause = "another place, axis, limb or name, or tissue that differs there"
    remedy = "check the record, position and axis of this site; leave it out of the fit until then"
    return Flag((found.site,), "outlier", what, numbers, cause, remedy)


def flag_of_correction(found: Correction, names: Sequence[str]) -> Flag:
    sites = tuple(names[i] for i in found.sites)
    numbers = {
        "misfit_ratio": found.gain,
        "error_before_percent": 100 * max(found.errors_before),
        "error_after_percent": 100 * max(found.errors_after),
    }
    done = "their records exchanged" if found.kind == "swap" else "its force converted"
    what = (
        f"with {done}, the squared misfit of all sites falls {found.gain:.1f} times and the error here from "
        f"{numbers['error_before_percent']:.0f} to {numbers['error_after_percent']:.0f} % of the peak"
    )
    remedies = {
        "swap": "exchange the traces of the two sites, or their names",
        "unit": "convert the force to N",
    }
    return Flag(sites, found.kind, what, numbers, found.cause, remedies[found.kind])


def unit_of(ratio: float) -> str:
    """The unit of force that a ratio of measured to predicted force comes near; empty if none does."""
    if ratio <= 0:
        return ""
    name = min(FORCE_UNITS, key=lambda unit: abs(np.log(ratio / FORCE_UNITS[unit])))
    away = abs(np.log(ratio / FORCE_UNITS[name]))
    return name if away < min(_SHARE * abs(np.log(FORCE_UNITS[name])), 0.5) else ""
