"""The limb of a study as far as it is known before anything is meshed or simulated, and what must fit it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...results.limb import PlacedSite
from ...study import Site, Study, Vector
from ..engine.store import Store
from .simulations import count_pins_met


@dataclass(frozen=True, eq=False)
class LimbGeometry:
    """Surfaces, and by site its place on them as ``sites.json`` has it: none where sites are not placed."""

    anatomy: Anatomy
    places: Mapping[str, PlacedSite] = field(default_factory=dict)

    @classmethod
    def stored(cls, store: Store) -> LimbGeometry:
        """That of the stages ``surfaces`` and ``sites``, which are done."""
        return cls(load_anatomy(store["surfaces"]), {row.site: row for row in store.results.sites.sites})

    def place(self, site: Site) -> tuple[Vector, Vector]:
        """Position, mm, and axis of the indenter at a site, LPS."""
        row = self.places[site.name]
        return row.position_mm, row.axis

    def clamping_pins(self, study: Study) -> dict[str, int]:
        """How many pins of ``[clamps]`` hold the limb at each site.

        Raises
        ------
        ProblemError
            Where they cannot be placed, with the study's file.
        """
        skin, (x, y, z) = self.anatomy.skin, map(float, self.anatomy.cut_normal)
        found = {}
        for site in study.sites:
            one, faces = (study.records_at(site) or (site,))[0], (skin.points, skin.faces)
            place = self.place(site)
            found[site.name] = count_pins_met(
                study, one.name, study.indenter_of(one), place, faces, (x, y, z)
            )
        return found


# Refuses what a study, its limb (None: not known yet) and options decide, before anything is simulated.
Check = Callable[[Study, LimbGeometry | None, Mapping[str, Any]], None]
