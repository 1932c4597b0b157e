"""Changes of force as changes of the answer: ``-(J' C^-1 J + P)^-1 J' C^-1 dF`` in logarithms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fit.objective import SiteResponse
from ..fit.parameters import Space, Unknowns
from .beliefs import Beliefs
from .discrepancy import ResidualModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Gain:
    """The linearised fit: what it makes of a change of the simulated force at each site.

    ``matrices`` are (p, n) per site, per N, for the logarithms of the full parameters.
    """

    matrices: tuple[Array, ...]

    @classmethod
    def at(
        cls,
        parameters: Array,
        responses: Sequence[SiteResponse],
        model: ResidualModel,
        unknowns: Unknowns,
        space: Space,
    ) -> Gain:
        """Of the fit whose answer is ``parameters`` (p,)."""
        scaled = [space.pull_back(response.jacobian, parameters) for response in responses]
        weighted = model.solve(scaled)
        A = Beliefs.of(unknowns, space).precision + sum(J.T @ W for J, W in zip(scaled, weighted))
        return cls(tuple(-space.tie @ np.linalg.solve(A, W.T) for W in weighted))

    def shift(self, changes: Sequence[Array]) -> Array:
        """Change (p,) of the logarithms where the force rises by ``changes`` (n,) at all sites at once."""
        return np.sum([G @ change for G, change in zip(self.matrices, changes, strict=True)], axis=0)

    def covariance(self, changes: Sequence[Array], shared: bool, sites: Sequence[str] = ()) -> Array:
        """Covariance (p, p) of one deviation of ``changes``: the same at all sites, or each site's own.

        ``sites`` names the site of each change, where several are of one; by default each is another.
        """
        if shared:
            parts = [self.shift(changes)]
        else:
            moved = [G @ c for G, c in zip(self.matrices, changes)]
            of = list(sites) or [str(i) for i in range(len(moved))]
            parts = [np.sum([m for m, s in zip(moved, of) if s == one], axis=0) for one in dict.fromkeys(of)]
        return np.sum([np.outer(part, part) for part in parts], axis=0)
