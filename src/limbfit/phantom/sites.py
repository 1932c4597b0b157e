"""Where a phantom is indented, how deep, and along which axis: 18 places in four regions, as in the paper.

Places are given around the limb (angle from anterior through medial, radians) and along it (millimetres
below the knee joint, or a thigh's proximal cut), so that they keep their anatomical meaning when a seed
changes the limb.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import SiteError
from .geometry import Limb, Shank
from .mri import SkinMarker

INDENTER_MM, INDENTER_EDGE_MM = 20.0, 2.0
SAFE_SHARE = 0.4  # of the thinnest soft tissue under the indenter
HINT_ERROR_MM = (3.0, 5.0)  # how far off a place is when measured by hand
SPEED_MM_S, SPEED_SPREAD = 0.96, 0.05

PATELLAR, TIBIA, LATERAL, POSTERIOR = "patellar tendon", "tibia", "lateral", "posterior wall"


@dataclass(frozen=True)
class Place:
    """A place on the limb: angle (rad), distance below its shape's datum (mm), wanted depth (mm)."""

    name: str
    region: str
    angle: float
    below: float
    depth: float


def _build_places(region: str, depth: float, first: int, spots: Sequence[tuple[float, float]]) -> list[Place]:
    return [Place(f"{first + i:02d}", region, angle, below, depth) for i, (angle, below) in enumerate(spots)]


SHANK_PLACES = (
    *_build_places(PATELLAR, 5.0, 1, [(0.0, 7.0), (-0.45, 16.0), (0.45, 16.0)]),
    *_build_places(TIBIA, 3.5, 4, [(0.95, 46.0), (0.95, 72.0), (0.95, 98.0), (0.35, 42.0), (1.0, 124.0)]),
    *_build_places(
        LATERAL, 5.0, 9, [(-0.8, 44.0), (-0.85, 72.0), (-0.85, 100.0), (-1.3, 58.0), (-1.3, 86.0)]
    ),
    *_build_places(
        POSTERIOR, 7.0, 14, [(3.14, 38.0), (2.75, 64.0), (-2.7, 64.0), (3.14, 92.0), (3.14, 120.0)]
    ),
)
_COLUMN = ((0.0, 75.0), (0.3, 105.0), (-0.3, 105.0), (0.0, 130.0), (0.0, 160.0))
THIGH_PLACES = (
    *_build_places("anterior", 6.0, 1, [(0.0, 95.0), (-0.45, 125.0), (0.45, 125.0)]),
    *_build_places("medial", 6.0, 4, [(0.5 * np.pi + aside, below) for aside, below in _COLUMN]),
    *_build_places("lateral", 5.0, 9, [(-0.5 * np.pi + aside, below) for aside, below in _COLUMN]),
    *_build_places("posterior", 7.0, 14, [(np.pi + aside, below) for aside, below in _COLUMN]),
)
FITTED = ("01", "05", "10", "15")
DETAIL_SITES = {
    "coarse": (*FITTED, "13", "17"),
    "paper": tuple(place.name for place in SHANK_PLACES),
}


@dataclass(frozen=True)
class Ramp:
    """A constant-speed indentation: ``depth`` mm under touch-down at ``speed`` mm/s, and back."""

    depth: float
    speed: float

    def __post_init__(self) -> None:
        if not (self.depth > 0 and self.speed > 0):
            raise SiteError(
                f"cannot indent {self.depth:g} mm at {self.speed:g} mm/s", remedy="give positive numbers"
            )

    @property
    def peak_s(self) -> float:
        """Seconds from touch-down to the peak."""
        return self.depth / self.speed

    @property
    def knots(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Times (s) and displacements (mm) from touch-down: start, peak, back."""
        return (0.0, self.peak_s, 2 * self.peak_s), (0.0, self.depth, 0.0)


@dataclass(frozen=True)
class TrueSite:
    """A site as it is: position on the skin, unit axis into the limb (LPS mm), depth (mm), speed (mm/s).

    ``hint`` is the position as measured by hand, ``thickness`` the thinnest soft tissue under the indenter.
    """

    name: str
    region: str
    fitted: bool
    position: Array
    axis: Array
    depth: float
    speed: float
    thickness: float
    hint: Array

    @property
    def ramp(self) -> Ramp:
        """The indentation that the robot makes there."""
        return Ramp(self.depth, self.speed)


def build_true_sites(limb: Limb, seed: int) -> tuple[TrueSite, ...]:
    """Build all 18 sites of a limb."""
    places = SHANK_PLACES if isinstance(limb.shape, Shank) else THIGH_PLACES
    return tuple(
        _build_true_site(limb, place, np.random.default_rng([seed, 6, i])) for i, place in enumerate(places)
    )


def select_sites(sites: Sequence[TrueSite], names: Sequence[str]) -> tuple[TrueSite, ...]:
    """Select the named sites, in the order of the limb's list; all are fitted where none would be. Raises
    `SiteError` when a name is not among them.
    """
    available = {site.name for site in sites}
    unknown = [name for name in names if name not in available]
    if unknown:
        raise SiteError(
            f"the phantom has no site {unknown[0]!r}", remedy=f"choose from {', '.join(sorted(available))}"
        )
    found = [site for site in sites if site.name in set(names)]
    unfitted = not any(site.fitted for site in found)
    return tuple(replace(site, fitted=site.fitted or unfitted) for site in found)


def build_markers(sites: Sequence[TrueSite]) -> tuple[SkinMarker, ...]:
    """Put a skin marker on every site."""
    return tuple(SkinMarker(site.position, -site.axis) for site in sites)


def _build_true_site(limb: Limb, place: Place, random: np.random.Generator) -> TrueSite:
    position = limb.skin_point(place.angle, limb.shape.datum - place.below)
    footprint = _sample_footprint(limb, position)
    axis = limb.inward(footprint).mean(axis=0)
    axis /= np.linalg.norm(axis)
    thickness = min(limb.tissue_thickness(point, axis) for point in footprint)
    error = random.normal(size=3)
    error *= random.uniform(*HINT_ERROR_MM) / np.linalg.norm(error)
    return TrueSite(
        name=place.name,
        region=place.region,
        fitted=place.name in FITTED,
        position=position,
        axis=axis,
        depth=round(min(place.depth, SAFE_SHARE * thickness), 2),
        speed=SPEED_MM_S * (1 + SPEED_SPREAD * random.uniform(-1, 1)),
        thickness=thickness,
        hint=position + error,
    )


def _sample_footprint(limb: Limb, position: Array) -> Array:
    """Find skin points (25, 3) under a square indenter at a position, along its normal."""
    normal = -limb.inward(position[None])[0]
    proximal = limb.proximal_normal - normal * (limb.proximal_normal @ normal)
    proximal /= np.linalg.norm(proximal)
    across = np.cross(normal, proximal)
    ticks = np.linspace(-INDENTER_MM / 2, INDENTER_MM / 2, 5)
    u, v = np.meshgrid(ticks, ticks)
    points = position + u.reshape(-1, 1) * across + v.reshape(-1, 1) * proximal
    for _ in range(8):  # Newton along the normal; the field is close to a distance
        points = points - limb.skin(points)[:, None] * normal
    return points
