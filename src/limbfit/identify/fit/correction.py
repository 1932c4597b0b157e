"""Coarse simulations brought to the fine ones of the same sites, by what both give at one point.

``F(p) = F_fine(a) + s (F_coarse(p) - F_coarse(a))`` per site, with the anchor ``a`` and the scalar ``s`` that
takes the coarse curve there to the fine one in least squares: exact in value at the anchor, scaled in slope
(space mapping with a zero-order output map: Bandler 2004; the scaled slope is that of manifold mapping with
one singular direction: Echeverria and Hemker 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...errors import CalibrationError
from .objective import SiteResponse

SEARCH, OWN = "in the search", "on the whole mesh"  # of the coarse and of the fine simulations, in reasons


@dataclass(frozen=True)
class CoarseToFine:
    """The responses of sites at an anchor, on their coarse and on their fine meshes, in the same order.

    A site of which either failed, is not finite or has no force is not corrected: ``reasons`` says why, and
    what the call gives for it has no numbers. The fine ones need no derivatives.

    Raises
    ------
    CalibrationError
        Where the two, or what is to be corrected, are not of the same sites and times: a fault of the caller.
    """

    coarse: Sequence[SiteResponse]
    fine: Sequence[SiteResponse]

    def __post_init__(self) -> None:
        _check_same(self.coarse, self.fine)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Per site why it cannot be corrected; empty where it can."""
        pairs = zip(self.coarse, self.fine)
        return tuple(_unusable(c, SEARCH) or _unusable(f, OWN) for c, f in pairs)

    @cached_property
    def scales(self) -> tuple[float | None, ...]:
        """Per site the factor s that takes the coarse curve to the fine one; None where there is none."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(None if reason else _scale(c, f) for c, f, reason in pairs)

    @property
    def differences_percent(self) -> tuple[float | None, ...]:
        """Mean absolute difference of fine and coarse force, in percent of the largest fine one, per site."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(None if reason else _difference_percent(c, f) for c, f, reason in pairs)

    def __call__(self, responses: Sequence[SiteResponse]) -> list[SiteResponse]:
        """Coarse responses (force and derivatives) anywhere, as the fine meshes would give them."""
        _check_same(responses, self.coarse)
        parts = zip(responses, self.coarse, self.fine, self.scales, self.reasons)
        return [_corrected(*part) for part in parts]

    def of(self, sites: Sequence[int]) -> CoarseToFine:
        """The correction of some of the sites."""
        return CoarseToFine([self.coarse[i] for i in sites], [self.fine[i] for i in sites])


def _corrected(
    response: SiteResponse, coarse: SiteResponse, fine: SiteResponse, scale: float | None, reason: str
) -> SiteResponse:
    reason = reason or ("" if response.completed else f"{SEARCH}: {_told(response)}")
    if scale is None or reason:
        nothing = np.full_like(response.force_N, np.nan), np.full_like(response.jacobian, np.nan)
        return SiteResponse(*nothing, False, reason, response.site)
    doubtful = dict.fromkeys(f"{SEARCH}: {text}" for text in (*coarse.doubts, *response.doubts))
    return replace(
        response,
        force_N=fine.force_N + scale * (response.force_N - coarse.force_N),
        jacobian=scale * response.jacobian,
        doubts=(*fine.doubts, *doubtful),
    )


def _unusable(response: SiteResponse, where: str) -> str:
    """Why a response cannot be an anchor; else an empty text."""
    if not response.completed:
        return f"{where}: {_told(response)}"
    if not (np.all(np.isfinite(response.force_N)) and np.all(np.isfinite(response.jacobian))):
        return f"{where}: the simulated force is not finite"
    return "" if np.any(response.force_N) else f"{where}: there is no force"


def _told(response: SiteResponse) -> str:
    return response.reason or "simulation failed"


def _scale(coarse: SiteResponse, fine: SiteResponse) -> float:
    return float(fine.force_N @ coarse.force_N / (coarse.force_N @ coarse.force_N))


def _difference_percent(coarse: SiteResponse, fine: SiteResponse) -> float:
    return float(100 * np.mean(np.abs(fine.force_N - coarse.force_N)) / np.max(np.abs(fine.force_N)))


def _check_same(ones: Sequence[SiteResponse], others: Sequence[SiteResponse]) -> None:
    if len(ones) != len(others):
        raise CalibrationError(f"{len(ones)} and {len(others)} responses are not of the same sites")
    for one, other in zip(ones, others):
        if (one.site, one.force_N.shape) != (other.site, other.force_N.shape):
            raise CalibrationError(f"responses of sites {one.site!r} and {other.site!r}, or of other times")
