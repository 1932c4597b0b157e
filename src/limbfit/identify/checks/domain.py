"""The domain of validity: what a prediction does to the tissue, beside what the fitted records did to it.

A small error at held-out sites tells nothing about a load that strains the tissue more, comes on faster or
lasts longer than any record, or presses elsewhere. Each quantity of a prediction is an `Extent`, and so is
the same quantity of all fitted records together; what lies outside is listed with both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ...arrays import Array
from ...results.identification import OutsideRecords, RecordedExtents

SHEAR, COMPRESSION, RATE = "shear strain", "compressive strain", "shear strain rate"
TIME, PRESSURE, DEPTH = "time", "pressure", "depth over thickness"
LEVEL, ANGLE = "level along the limb", "angle to the nearest fitted site"
TAIL_SHARE = 0.01  # of the volume, or area: what strains or presses more than this share does is the largest
SECTOR_DEG = 45.0  # around a fitted site, as seen along the limb: a quarter of the limb
_PROBABILITIES = np.linspace(0.0, 1.0, 401)
# How far a prediction may go beyond the records. Relaxation changes with the logarithm of time: half as long
# again is little. A site tells of tissue around it.
_FACTOR, _FACTORS, _ALLOWED = 1.1, {TIME: 1.5, ANGLE: 1.0, LEVEL: 1.0}, {LEVEL: 20.0}
_TWO_SIDED = (TIME, LEVEL)
_MAX_LISTED = 3  # quantities in one sentence


@dataclass(frozen=True)
class Extent:
    """How far a quantity goes, from ``low`` to ``high``; ``tissue``: None where it is of no one tissue.

    ``quantiles``: where it is distributed over volume or area, the values that the shares ``_PROBABILITIES``
    do not exceed; ``high`` is then what 1 % exceeds.
    """

    quantity: str
    unit: str
    low: float
    high: float
    tissue: str | None = None
    quantiles: Array | None = field(default=None, repr=False, compare=False)

    @classmethod
    def from_values(
        cls, quantity: str, unit: str, values: Array, weights: Array, tissue: str | None = None
    ) -> Self:
        """Build it from values (n,) with their volumes or areas (n,)."""
        order = np.argsort(values)
        cumulative = np.cumsum(weights[order])
        places = np.searchsorted(cumulative, _PROBABILITIES * cumulative[-1])
        quantiles = values[order][np.minimum(places, len(values) - 1)]
        low, high = (float(np.interp(p, _PROBABILITIES, quantiles)) for p in (TAIL_SHARE, 1.0 - TAIL_SHARE))
        return cls(quantity, unit, low if quantity in _TWO_SIDED else 0.0, high, tissue, quantiles)

    def is_within(self, tested: Extent) -> bool:
        """True if it goes no farther beyond the ``tested`` extent than is allowed."""
        factor, more = _FACTORS.get(self.quantity, _FACTOR), _ALLOWED.get(self.quantity, 0.0)
        above = self.high > factor * tested.high + more
        below = self.quantity in _TWO_SIDED and self.low < tested.low / factor - more
        return not (above or below)

    def compute_share_outside(self, tested: Extent) -> float:
        """Return the share of volume, area, or else of its range that is outside the ``tested`` extent."""
        low = tested.low if self.quantity in _TWO_SIDED else -np.inf
        if self.quantiles is not None:
            below, above = np.interp([low, tested.high], self.quantiles, _PROBABILITIES)
            return float(1.0 - above + (below if np.isfinite(low) else 0.0))
        width = self.high - self.low
        if width <= 0.0:
            return float(not low <= self.high <= tested.high)
        inside = min(self.high, tested.high) - max(self.low, low)
        return float(1.0 - max(inside, 0.0) / width)


@dataclass(frozen=True)
class RecordedRange:
    """What the fitted records did to the tissue: ``extents`` over all of them, ``angles_deg`` of their sites.

    Angles are about the axis of the limb.
    """

    extents: tuple[Extent, ...]
    angles_deg: tuple[float, ...] = ()

    @classmethod
    def from_records(cls, records: Iterable[Sequence[Extent]], angles_deg: Iterable[float]) -> Self:
        """Merge the extents of the records: the least low and the largest high of each quantity."""
        merged: dict[tuple[str, str | None], Extent] = {}
        for extent in (one for record in records for one in record):
            key = extent.quantity, extent.tissue
            known = merged.get(key, extent)
            low, high = min(known.low, extent.low), max(known.high, extent.high)
            merged[key] = Extent(extent.quantity, extent.unit, low, high, extent.tissue)
        angles = tuple(angles_deg)
        around = (Extent(ANGLE, "deg", 0.0, SECTOR_DEG),) if angles else ()
        return cls((*merged.values(), *around), angles)

    @classmethod
    def from_stored(cls, stored: RecordedExtents) -> Self:
        """Build it from what ``predict.json`` holds; distributions are not stored."""
        return cls(tuple(Extent(**one.to_plain()) for one in stored.extents), tuple(stored.angles_deg))

    def measure_angle(self, angles_deg: Array) -> Array:
        """Return the angle (n,) in degrees from each direction (n,) to that of the nearest fitted site."""
        apart = np.abs(np.asarray(angles_deg)[:, None] - np.array(self.angles_deg)) % 360.0
        return np.asarray(np.minimum(apart, 360.0 - apart).min(axis=1))

    def find_outside(self, prediction: Iterable[Extent]) -> list[OutsideRecords]:
        """Return a row for each quantity of a ``prediction`` that goes beyond the records; none: all within.

        A tissue that no record strained was strained by 0.
        """
        rows = []
        for extent in prediction:
            alike = {one.tissue: one for one in self.extents if one.quantity == extent.quantity}
            tested = alike.get(extent.tissue, Extent(extent.quantity, extent.unit, 0.0, 0.0, extent.tissue))
            if alike and not extent.is_within(tested):
                rows.append(
                    OutsideRecords(
                        quantity=extent.quantity,
                        tissue=extent.tissue,
                        unit=extent.unit,
                        records=(tested.low, tested.high),
                        prediction=(extent.low, extent.high),
                        share=extent.compute_share_outside(tested),
                    )
                )
        return rows


def describe_outside(outside: Mapping[str, Sequence[OutsideRecords] | None]) -> list[str]:
    """Return at most two sentences on predictions by name, each that of the one farthest outside.

    The first is about times, the second about all else.
    """
    found = []
    for is_time, describe in ((True, _describe_times), (False, _describe_others)):
        alike = {
            name: [row for row in rows or () if (row.quantity == TIME) is is_time]
            for name, rows in outside.items()
        }
        known = {name: rows for name, rows in alike.items() if rows}
        if known:
            worst = max(known, key=lambda name: max(map(_compute_excess, known[name])))
            more = f" ({len(known) - 1} more of {len(outside)} too)" if len(known) > 1 else ""
            found.append(f"{worst} {describe(known[worst])}{more}")
    return found


def _compute_excess(row: OutsideRecords) -> float:
    """How many times as far as the records the prediction goes."""
    (low, high), (least, most) = row.records, row.prediction
    if row.quantity == LEVEL:
        return 1.0 + max(low - least, most - high) / max(high - low, 20.0)
    above = most / max(high, 1e-6)
    return float(max(above, low / max(least, 1e-6) if row.quantity in _TWO_SIDED else 0.0))


def _describe_times(rows: Sequence[OutsideRecords]) -> str:
    (low, high), (ramp, end) = rows[0].records, rows[0].prediction
    factor, parts = _FACTORS[TIME], []
    if ramp * factor < low:
        parts.append(f"comes on in {_format(ramp)} s (the records' shortest ramp takes {_format(low)} s)")
    if end > factor * high:
        parts.append(f"lasts {_format(end)} s (the records last {_format(high)} s)")
    return f"{' and '.join(parts)}: no record tells how tissue relaxes at such times"


def _describe_others(rows: Sequence[OutsideRecords]) -> str:
    first = sorted(rows, key=_compute_excess, reverse=True)
    parts = [_describe_row(row) for row in first[:_MAX_LISTED]]
    more = f", and {len(first) - _MAX_LISTED} more" if len(first) > _MAX_LISTED else ""
    return f"goes beyond the records: {'; '.join(parts)}{more}"


def _describe_row(row: OutsideRecords) -> str:
    unit = f" {row.unit}" if row.unit else ""
    of = f" of {row.tissue}" if row.tissue else ""
    (low, high), (least, most) = row.records, row.prediction
    if row.quantity == LEVEL:
        end, tested = (most, high) if most - high > low - least else (least, low)
        return f"{LEVEL} {end:.0f}{unit} (the fitted sites end at {tested:.0f})"
    is_strain = row.quantity in (SHEAR, COMPRESSION)
    part = f", over {100.0 * row.share:.0f} % of the volume" if is_strain else ""
    return f"{row.quantity}{of} {_format(most, 2)}{unit} (records: {_format(high, 2)}{part})"


def _format(value: float, digits: int = 3) -> str:
    """A number with so many digits, without an exponent where it has few more."""
    return f"{float(f'{value:.{digits}g}'):g}"
