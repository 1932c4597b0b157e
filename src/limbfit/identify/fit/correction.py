"""Coarse simulations corrected to the fine ones of the same sites.

``F(p) = F_fine(a) + s (F_coarse(p) - F_coarse(a))`` per site. At the anchor ``a`` both meshes are simulated.
The scalar ``s`` takes the coarse curve there to the fine one in least squares. The correction is exact in
value at the anchor and scaled in slope (space mapping with a zero-order output map: Bandler 2004; the scaled
slope is that of manifold mapping with one singular direction: Echeverria and Hemker 2005).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...errors import CalibrationError
from .objective import SiteResponse

# Of the coarse and of the fine simulations, in reasons
COARSE_MESH, FINE_MESH = "in the search", "on the whole mesh"


@dataclass(frozen=True)
class MeshCorrection:
    """The responses of sites at an anchor, on their coarse and on their fine meshes, in the same order.

    Calling it corrects coarse responses at any parameters. A site of which either response failed, is not
    finite or has no force is not corrected: ``reasons`` says why, and its corrected response has no numbers.
    The fine responses need no derivatives.

    Raises
    ------
    CalibrationError
        If the two, or the responses to be corrected, are not of the same sites and times: an error of the
        caller.
    """

    coarse: Sequence[SiteResponse]
    fine: Sequence[SiteResponse]

    def __post_init__(self) -> None:
        _check_same_sites(self.coarse, self.fine)

    @cached_property
    def reasons(self) -> tuple[str, ...]:
        """Why each site cannot be corrected; empty where it can."""
        pairs = zip(self.coarse, self.fine)
        return tuple(_find_fault(c, COARSE_MESH) or _find_fault(f, FINE_MESH) for c, f in pairs)

    @cached_property
    def scales(self) -> tuple[float | None, ...]:
        """The factor s of each site that takes the coarse curve to the fine one; None where there is none."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(None if reason else _fit_scale(c, f) for c, f, reason in pairs)

    @property
    def differences_percent(self) -> tuple[float | None, ...]:
        """Mean absolute difference of fine and coarse force per site, in percent of the largest fine one."""
        pairs = zip(self.coarse, self.fine, self.reasons)
        return tuple(None if reason else _compute_difference_percent(c, f) for c, f, reason in pairs)

    def __call__(self, responses: Sequence[SiteResponse]) -> list[SiteResponse]:
        """Return coarse responses (force and derivatives) as the fine meshes would give them."""
        _check_same_sites(responses, self.coarse)
        parts = zip(responses, self.coarse, self.fine, self.scales, self.reasons)
        return [_correct_response(*part) for part in parts]

    def select(self, sites: Sequence[int]) -> MeshCorrection:
        """Return the correction of some of the sites."""
        return MeshCorrection([self.coarse[i] for i in sites], [self.fine[i] for i in sites])


def _correct_response(
    response: SiteResponse, coarse: SiteResponse, fine: SiteResponse, scale: float | None, reason: str
) -> SiteResponse:
    reason = reason or ("" if response.completed else f"{COARSE_MESH}: {_describe_failure(response)}")
    if scale is None or reason:
        nothing = np.full_like(response.force_N, np.nan), np.full_like(response.jacobian, np.nan)
        return SiteResponse(*nothing, False, reason, response.site)
    doubtful = dict.fromkeys(f"{COARSE_MESH}: {text}" for text in (*coarse.warnings, *response.warnings))
    return replace(
        response,
        force_N=fine.force_N + scale * (response.force_N - coarse.force_N),
        jacobian=scale * response.jacobian,
        warnings=(*fine.warnings, *doubtful),
    )


def _find_fault(response: SiteResponse, where: str) -> str:
    """Return why a response cannot be an anchor, or an empty text."""
    if not response.completed:
        return f"{where}: {_describe_failure(response)}"
    if not (np.all(np.isfinite(response.force_N)) and np.all(np.isfinite(response.jacobian))):
        return f"{where}: the simulated force is not finite"
    return "" if np.any(response.force_N) else f"{where}: there is no force"


def _describe_failure(response: SiteResponse) -> str:
    return response.reason or "simulation failed"


def _fit_scale(coarse: SiteResponse, fine: SiteResponse) -> float:
    return float(fine.force_N @ coarse.force_N / (coarse.force_N @ coarse.force_N))


def _compute_difference_percent(coarse: SiteResponse, fine: SiteResponse) -> float:
    return float(100 * np.mean(np.abs(fine.force_N - coarse.force_N)) / np.max(np.abs(fine.force_N)))


def _check_same_sites(responses: Sequence[SiteResponse], expected: Sequence[SiteResponse]) -> None:
    if len(responses) != len(expected):
        raise CalibrationError(f"{len(responses)} and {len(expected)} responses are not of the same sites")
    for one, other in zip(responses, expected):
        if (one.site, one.force_N.shape) != (other.site, other.force_N.shape):
            raise CalibrationError(f"responses of sites {one.site!r} and {other.site!r}, or of other times")
