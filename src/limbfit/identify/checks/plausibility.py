"""Checks of records before anything is simulated: units, names, axes and places that cannot be right.

Records of different sites are compared by the apparent shear modulus: peak force over depth, taken as that of
a rigid flat punch on an incompressible layer bonded to bone (Hayes et al. 1972), ``F / d = 8 a G k(a / h)``
with the punch's radius a and the tissue's thickness h. Over clean synthetic limbs its standard deviation is a
factor of about 1.25, while the stiffness itself varies sevenfold. A wrong unit shifts it, the speed, the
depth and the time step by known factors, so the hypothesis that explains all four names the unit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from ...arrays import Array

# Hayes, Keer, Herrmann and Mockros 1972, flat punch, Poisson's ratio 0.5: kappa against a / h.
_HAYES_FACTORS = (
    (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.5, 2.0),
    (1.0, 1.281, 1.683, 2.211, 2.855, 3.609, 5.970, 9.069),
)
# Relaxed and tensed soft tissue of limbs in elastography and indentation: about 1.5 to 60 kPa.
MODULUS_KPA = (1.0, 100.0)
# Standard deviations (logarithmic) below which differences between sites of one study mean nothing:
# modulus with and without a known thickness, speed, time step, depth.
_MIN_SDS = {"modulus": 0.3, "stiffness": 0.75, "speed": 0.2, "step": 0.1, "depth": 0.4}
_MIN_OTHERS = 3
_MAX_STANDARDISED = 3.8  # standard deviations of one quantity
_MIN_PAIR_DEVIATION = 4.0  # of two sites together, exchanged
_MIN_CHI2_DROP = 12.0  # by which a hypothesis must lower chi-square
_MAX_CHI2_EXPLAINED = 16.0  # the chi-square (of 4) up to which a hypothesis explains what it names
MAX_AXIS_DEG, MAX_OFF_SKIN_MM, MAX_HINT_MM, MAX_DEPTH_SHARE = 25.0, 3.0, 12.0, 0.8
# Sites so close are one, and what repeats there differ by at most
SAME_PLACE_MM, MAX_REPEAT_RATIO = 2.0, 1.15

# Recorded over true number: force, displacement, time.
UNITS: dict[str, tuple[float, float, float]] = {
    "force in kgf (or N x 0.102) instead of N": (1 / 9.80665, 1.0, 1.0),
    "force multiplied by 9.81 (N taken for kgf)": (9.80665, 1.0, 1.0),
    "force in gf instead of N": (101.97, 1.0, 1.0),
    "force in lbf instead of N": (1 / 4.44822, 1.0, 1.0),
    "force multiplied by 4.45 (N taken for lbf)": (4.44822, 1.0, 1.0),
    "force in mN instead of N": (1000.0, 1.0, 1.0),
    "force in kN instead of N": (1e-3, 1.0, 1.0),
    "displacement in cm instead of mm": (1.0, 0.1, 1.0),
    "displacement in m instead of mm": (1.0, 1e-3, 1.0),
    "displacement in inches instead of mm": (1.0, 1 / 25.4, 1.0),
    "displacement multiplied by 10": (1.0, 10.0, 1.0),
    "time in ms instead of s": (1.0, 1.0, 1000.0),
    "time in minutes instead of s": (1.0, 1.0, 1 / 60),
    "time multiplied by 10 (wrong sampling rate)": (1.0, 1.0, 10.0),
    "time divided by 10 (wrong sampling rate)": (1.0, 1.0, 0.1),
}


@dataclass(frozen=True)
class RecordWarning:
    """A warning about records: sites, what is wrong, numbers that show it, likely cause, remedy."""

    sites: tuple[str, ...]
    kind: str
    what: str
    evidence: Mapping[str, float]
    cause: str
    remedy: str

    @property
    def text(self) -> str:
        names = " and ".join(self.sites)
        head = f"site{'s' if len(self.sites) > 1 else ''} {names}" if names else "all sites"
        return f"{head}: {self.what}; likely {self.cause}; {self.remedy}"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-like values, the text among them."""
        return {**asdict(self), "sites": list(self.sites), "evidence": dict(self.evidence), "text": self.text}


def explain_warnings(
    warnings: Sequence[RecordWarning], in_records: Sequence[RecordWarning]
) -> list[RecordWarning]:
    """Give warnings against the model the cause and remedy that the record itself shows, if it shows a wrong
    unit.

    The model compares forces, and takes a wrong displacement for a wrong force.
    """
    units = {warning.sites: warning for warning in in_records if warning.kind == "unit"}
    return [
        replace(warning, cause=units[warning.sites].cause, remedy=units[warning.sites].remedy)
        if warning.sites in units
        else warning
        for warning in warnings
    ]


@dataclass(frozen=True)
class RecordFacts:
    """A record and its site in numbers; what is not known (yet) is None.

    ``record`` is its name, and ``site`` that of the site if it has several records.
    ``position_mm`` (LPS) is where that is on the skin, ``step_s`` the time between samples, ``radius_mm``
    that of a circle of the punch's area, ``thickness_mm`` the soft tissue under the indenter along its axis,
    ``axis_deg`` the angle between that axis and the skin's inward normal, ``hint_mm`` how far its marker is
    from where the study says the site is.
    """

    record: str
    peak_N: float
    depth_mm: float
    speed_mm_s: float
    step_s: float
    radius_mm: float
    thickness_mm: float | None = None
    axis_deg: float | None = None
    off_skin_mm: float | None = None
    hint_mm: float | None = None
    position_mm: tuple[float, float, float] | None = None
    site: str = ""

    @property
    def site_name(self) -> str:
        """The name that all records of one site share."""
        return self.site or self.record

    @property
    def modulus_kPa(self) -> float:
        """The apparent shear modulus; that of a half-space if the thickness is not known."""
        stiffness = self.peak_N / self.depth_mm / (8 * self.radius_mm) * 1e3
        if not self.thickness_mm:
            return stiffness
        return stiffness / compute_layer_factor(self.radius_mm / self.thickness_mm)


def compute_layer_factor(radius_over_thickness: float) -> float:
    """Return how much stiffer a bonded incompressible layer is than a half-space, under a flat punch."""
    ratios, factors = _HAYES_FACTORS
    if radius_over_thickness > ratios[-1]:  # the limit of a thin layer: as the cube
        return factors[-1] * (radius_over_thickness / ratios[-1]) ** 3
    return float(np.interp(radius_over_thickness, ratios, factors))


def check_plausibility(facts: Sequence[RecordFacts]) -> tuple[RecordWarning, ...]:
    """Check the records of a study, each against the others and against what limbs are like."""
    return (
        *_check_places(facts),
        *_check_shared_places(facts),
        *_check_all_moduli(facts),
        *_compare_records(facts),
    )


def _check_places(facts: Sequence[RecordFacts]) -> Iterator[RecordWarning]:
    seen_sites: set[str] = set()  # of a site once, however many records it has
    for f in facts:
        share = f.depth_mm / f.thickness_mm if f.thickness_mm else 0.0
        if share > MAX_DEPTH_SHARE:
            what = f"it goes {f.depth_mm:.1f} mm deep where the soft tissue is {f.thickness_mm:.1f} mm thick"
            cause = "another place, another limb, or a wrong unit of displacement"
            yield RecordWarning((f.record,), "depth", what, {"depth_share": share}, cause, "check the record")
        if f.site_name in seen_sites:
            continue
        seen_sites.add(f.site_name)
        if f.axis_deg is not None and f.axis_deg > MAX_AXIS_DEG:
            what = f"the axis is {f.axis_deg:.0f} degrees from the inward normal of the skin"
            cause = "an axis of another site or frame"
            remedy = "check it, or leave axis out to take the skin's normal"
            yield RecordWarning((f.site_name,), "axis", what, {"axis_deg": f.axis_deg}, cause, remedy)
        if f.off_skin_mm is not None and f.off_skin_mm > MAX_OFF_SKIN_MM:
            what = f"the stated position is {f.off_skin_mm:.1f} mm off the skin"
            cause, remedy = "a wrong position or coordinate system", "give LPS millimetres on the skin"
            yield RecordWarning((f.site_name,), "place", what, {"off_skin_mm": f.off_skin_mm}, cause, remedy)
        if f.hint_mm is not None and f.hint_mm > MAX_HINT_MM:
            what = f"its marker lies {f.hint_mm:.1f} mm from where the study says the site is"
            cause, remedy = "another site's marker", "check 'near' of this site and its neighbours"
            yield RecordWarning((f.site_name,), "place", what, {"hint_mm": f.hint_mm}, cause, remedy)


def _check_shared_places(facts: Sequence[RecordFacts]) -> Iterator[RecordWarning]:
    """Warn of sites at one place whose records differ by more than repeats do."""
    for one, two in combinations(facts, 2):
        if one.position_mm is None or two.position_mm is None or one.site_name == two.site_name:
            continue
        apart = float(np.linalg.norm(np.subtract(one.position_mm, two.position_mm)))
        ratio = one.modulus_kPa / two.modulus_kPa
        if apart > SAME_PLACE_MM or max(ratio, 1 / ratio) < MAX_REPEAT_RATIO:
            continue
        what = (
            f"they are at one place ({apart:.1f} mm apart), but the apparent modulus of the first record is "
            f"{ratio:.2g} times that of the second"
        )
        numbers = {"apart_mm": apart, "modulus_ratio": ratio}
        remedy = "give each site its own place"
        sites = one.record, two.record
        yield RecordWarning(sites, "place", what, numbers, "a position given twice", remedy)


def _check_all_moduli(facts: Sequence[RecordFacts]) -> Iterator[RecordWarning]:
    """Warn if all records together cannot be those of a limb."""
    known = [f.modulus_kPa for f in facts if f.thickness_mm]
    if len(known) < 2:
        return
    middle = float(np.median(known))
    low, high = MODULUS_KPA
    if low <= middle <= high:
        return
    what = f"an apparent shear modulus of {middle:.3g} kPa is not that of soft tissue ({low:g} to {high:g})"
    wanted = float(np.log(middle / 8.0))
    cause = min(UNITS, key=lambda name: abs(np.log(UNITS[name][0] / UNITS[name][1]) - wanted))
    yield RecordWarning((), "unit", what, {"modulus_kPa": middle}, cause, "check the units of all records")


def _compare_records(facts: Sequence[RecordFacts]) -> Iterator[RecordWarning]:
    if len(facts) < _MIN_OTHERS + 1:
        return
    known = all(f.thickness_mm for f in facts)
    if not known:
        facts = [replace(f, thickness_mm=None) for f in facts]
    table = np.log([[f.modulus_kPa, f.speed_mm_s, f.step_s, f.depth_mm] for f in facts])
    away, spread = np.zeros_like(table), np.zeros_like(table)  # robust, from the median of the others
    floors = [_MIN_SDS[key] for key in ("modulus" if known else "stiffness", "speed", "step", "depth")]
    for i in range(len(facts)):
        rest = np.delete(table, i, axis=0)
        middle = np.median(rest, axis=0)
        scatter = np.maximum(floors, 1.4826 * np.median(np.abs(rest - middle), axis=0))
        away[i], spread[i] = table[i] - middle, scatter * np.sqrt(1 + 1 / len(rest))
    swapped = _find_exchange(facts, away[:, 0] / spread[:, 0]) if known else None
    if swapped is not None:
        yield swapped
    for f, shift, sd in zip(facts, away, spread):
        if swapped is None or f.record not in swapped.sites:
            yield from _explain_odd_record(f, shift, sd)


def _explain_odd_record(f: RecordFacts, shift: Array, sd: Array) -> Iterator[RecordWarning]:
    """Explain what is odd about a record: a unit that explains it all, or an unexplained stiffness."""
    if np.abs(shift / sd).max() < _MAX_STANDARDISED:
        return
    chi2 = {"": float(((shift / sd) ** 2).sum())}
    for unit, (force, travel, time) in UNITS.items():
        expected = np.log([force / travel, travel / time, time, travel])
        chi2[unit] = float((((shift - expected) / sd) ** 2).sum())
    name = min(chi2, key=lambda unit: chi2[unit])
    numbers = {
        "modulus_kPa": f.modulus_kPa,
        "modulus_ratio": float(np.exp(shift[0])),
        "speed_ratio": float(np.exp(shift[1])),
        "time_step_ratio": float(np.exp(shift[2])),
        "depth_ratio": float(np.exp(shift[3])),
        "chi2": chi2[""],
        "chi2_explained": chi2[name],
    }
    what = (
        f"against the other sites its apparent modulus is {np.exp(shift[0]):.2g} times, its speed "
        f"{np.exp(shift[1]):.2g} times, its depth {np.exp(shift[3]):.2g} times"
    )
    if chi2[name] < _MAX_CHI2_EXPLAINED and chi2[""] - chi2[name] > _MIN_CHI2_DROP:
        yield RecordWarning((f.record,), "unit", what, numbers, name, "convert the column to s, mm and N")
    elif abs(shift[0] / sd[0]) >= _MAX_STANDARDISED:  # a protocol of its own is no fault
        cause = "a swapped name, another place or another limb"
        remedy = "check which site this record belongs to"
        yield RecordWarning((f.record,), "stiffness", what, numbers, cause, remedy)


def _find_exchange(facts: Sequence[RecordFacts], z: Array) -> RecordWarning | None:
    """Find the exchange of two records that makes the moduli of all sites alike if they are not.

    Both sites must be odd, one too stiff and one too soft for its tissue's thickness: two errors that no
    single unit makes.
    """

    def scatter(rows: Sequence[RecordFacts]) -> float:
        moduli = np.log([f.modulus_kPa for f in rows])
        return float(np.abs(moduli - np.median(moduli)).sum())

    before, exchanged = scatter(facts), []
    for i, j in combinations(range(len(facts)), 2):
        if z[i] * z[j] > 0 or np.hypot(z[i], z[j]) < _MIN_PAIR_DEVIATION or min(abs(z[i]), abs(z[j])) < 2.0:
            continue
        rows = list(facts)
        rows[i] = replace(facts[i], thickness_mm=facts[j].thickness_mm)
        rows[j] = replace(facts[j], thickness_mm=facts[i].thickness_mm)
        exchanged.append((scatter(rows), i, j))
    after, i, j = min(exchanged, default=(np.inf, 0, 0))
    if after > 0.5 * before:
        return None
    one, two = facts[i], facts[j]
    what = (
        f"for tissue of {one.thickness_mm:.0f} and {two.thickness_mm:.0f} mm their apparent moduli are "
        f"{one.modulus_kPa:.3g} and {two.modulus_kPa:.3g} kPa; exchanged, the records of all sites agree"
    )
    numbers = {"scatter": before, "scatter_exchanged": after}
    remedy = "exchange the traces of the two sites, or their names"
    return RecordWarning((one.record, two.record), "swap", what, numbers, "swapped site names", remedy)
