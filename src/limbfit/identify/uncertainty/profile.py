"""The profile likelihood: how well the records can be fitted with one parameter fixed and all others free.

It needs no prior and no linearisation (Raue et al. 2009). A parameter whose profile stays below the threshold
up to its bound is not determined on that side, whatever a covariance says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import stdtrit

from ...arrays import Array
from ...results.uncertainty import ProfileCheck
from ..fit.objective import SiteResponse
from .likelihood import Likelihood, Optimum

_CLOSED, _ONE_SIDED, _OPEN = "determined on both sides", "determined on one side", "not determined"
_FIRST_STEP, _STEP_GROWTH, _MAX_STEPS = 0.5, 1.5, 25  # in standard deviations


@dataclass(frozen=True)
class Profile:
    """The profile of one coordinate: ``values`` (n,) of the parameter in rising order, and ``rise`` (n,).

    ``rise`` is that of minus twice the log-likelihood over its least value. ``interval_95`` ends where it
    crosses ``threshold``, or at a bound if ``closed`` (low, high) is False. ``ends`` are the full parameters
    (2, p) there. ``extrapolated`` (n,) and ``ends_extrapolated`` say where the emulator is asked outside its
    runs.
    """

    name: str
    values: Array
    rise: Array
    threshold: float
    interval_95: tuple[float, float]
    closed: tuple[bool, bool]
    ends: Array
    extrapolated: NDArray[np.bool_]
    ends_extrapolated: tuple[bool, bool]

    @property
    def verdict(self) -> str:
        return (_OPEN, _ONE_SIDED, _CLOSED)[sum(self.closed)]


def compute_profile(
    likelihood: Likelihood,
    best: Optimum,
    k: int,
    sd: float,
    freedom: float = 1e6,
    is_inside: Callable[[Array], bool] = lambda parameters: True,
) -> Profile:
    """Compute the profile of coordinate k from the optimum outwards.

    Parameters
    ----------
    sd : a guess of the coordinate's standard deviation, for the steps.
    freedom : degrees of freedom of the misfit's size. The threshold is the square of Student's 97.5 %
        quantile, 3.84 for many.
    is_inside : True if the emulator's runs surround full parameters (p,); by default they do everywhere.
    """
    threshold = float(stdtrit(freedom, 0.975) ** 2)
    sides = [_walk_side(likelihood, best, k, sign * sd, threshold) for sign in (-1.0, 1.0)]
    (left, low, low_closed), (right, high, high_closed) = sides
    track = [*reversed(left), best, *right]
    least = min(point.minus_2_log for point in track)
    name = likelihood.unknowns.names[int(np.flatnonzero(likelihood.space.tie[:, k])[0])]
    return Profile(
        name=name,
        values=np.exp([point.z[k] for point in track]),
        rise=np.array([point.minus_2_log - least for point in track]),
        threshold=threshold,
        interval_95=(float(np.exp(low.z[k])), float(np.exp(high.z[k]))),
        closed=(low_closed, high_closed),
        ends=np.stack([low.parameters, high.parameters]),
        extrapolated=np.array([not is_inside(point.parameters) for point in track]),
        ends_extrapolated=(not is_inside(low.parameters), not is_inside(high.parameters)),
    )


def _walk_side(
    likelihood: Likelihood, best: Optimum, k: int, step: float, threshold: float
) -> tuple[list[Optimum], Optimum, bool]:
    """Return the points on one side, the end of the interval, and True if it crossed the threshold."""
    bound = float((likelihood.space.lower if step < 0 else likelihood.space.upper)[k])
    track, at, length = [], best, _FIRST_STEP * step
    for _ in range(_MAX_STEPS):
        value = at.z[k] + length
        value = max(value, bound) if step < 0 else min(value, bound)
        following = _optimise_with_fixed(likelihood, at, k, value)
        track.append(following)
        if following.minus_2_log - best.minus_2_log > threshold:
            return track, _find_crossing(likelihood, best, at, following, k, threshold), True
        if value == bound:
            return track, following, False
        at, length = following, length * _STEP_GROWTH
    return track, at, False


def _optimise_with_fixed(likelihood: Likelihood, near: Optimum, k: int, value: float) -> Optimum:
    start = near.z.copy()
    start[k] = value
    return likelihood.find_optimum(start, fixed_entry=k)


def _find_crossing(
    likelihood: Likelihood, best: Optimum, inner: Optimum, outer: Optimum, k: int, threshold: float
) -> Optimum:
    """Find the point between two at which the rise is the threshold."""
    if inner.minus_2_log - best.minus_2_log >= threshold:
        return inner
    found = {}

    def excess(value: float) -> float:
        found[value] = _optimise_with_fixed(likelihood, inner, k, value)
        return found[value].minus_2_log - best.minus_2_log - threshold

    a, b = float(inner.z[k]), float(outer.z[k])
    if excess(b) <= 0:  # reached from elsewhere it was higher: the better of the two counts
        return found[b]
    value = float(brentq(excess, a, b, xtol=1e-3 * abs(b - a)))
    return found.get(value) or _optimise_with_fixed(likelihood, inner, k, value)


def select_profiles_to_check(profiles: Sequence[Profile], narrowest: int) -> list[tuple[str, Profile]]:
    """Select the narrowest profiles, on which verdicts rest, and the widest, which extrapolates most."""
    order = sorted(profiles, key=lambda one: np.log(one.interval_95[1] / one.interval_95[0]))
    chosen = [("narrowest", one) for one in order[:narrowest]]
    return chosen + [("widest", one) for one in order[narrowest:][-1:]] if chosen else []


def check_profile_ends(
    likelihood: Likelihood,
    best: Optimum,
    best_responses: Sequence[SiteResponse],
    profile: Profile,
    responses: Sequence[Sequence[SiteResponse]],
    why: str = "",
) -> ProfileCheck:
    """Compare a profile's two ends with ``responses`` of the solver there and at the optimum."""
    reference = likelihood.minus_2_log_of(best_responses, best.parameters)

    def compute_solved_rise(run: Sequence[SiteResponse], parameters: Array) -> float | None:
        if not all(response.completed for response in run):
            return None
        return likelihood.minus_2_log_of(run, parameters) - reference

    low, high = (compute_solved_rise(run, p) for run, p in zip(responses, profile.ends, strict=True))
    z = [likelihood.space.reduce(np.log(p)) for p in profile.ends]
    emulated = [float(likelihood.compute_minus_2_log(at)[0]) - best.minus_2_log for at in z]
    ends = emulated[0], emulated[1]
    return ProfileCheck(
        name=profile.name,
        why=why,
        emulated=ends,
        solved=(low, high),
        extrapolated=profile.ends_extrapolated,
    )
