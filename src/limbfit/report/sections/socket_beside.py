"""Beside a socket's pressures: which parameters their intervals come from, and what others found there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..formats import NOTHING, fixed, heading, numeric, symbol
from ..page import Block, Cell, Prose, Row, Table
from ..store import Json

# What counts as known, and how its change is headed.
KNOWN = {
    "liner.c_kPa": f"Change, liner {symbol('c')} 10 % larger",
    "friction": "Change, friction 10 % larger",
}
PAPERS = (
    "Measured pressures depend on sensor, socket and activity: see the cited papers, the review by Al-Fakih "
    "et al. (Sensors 2016, 16:1119), and for thresholds of pain by region Lee et al. (Arch Phys Med Rehabil "
    "2005, 86:641)."
)


def mostly(shares: Mapping[str, float] | None) -> str:
    """The parameter that most of an interval comes from: ``muscle c 84 %``."""
    if not shares:
        return NOTHING
    name, percent = next(iter(shares.items()))
    return f"{parameter(name)} {fixed(percent, 0)} %"


def parameter(name: str) -> str:
    """``skin.tau_s`` as tables say it: skin τ."""
    tissue, _, key = name.partition(".")
    return f"{tissue} {symbol(key)}"


def interval_blocks(held: Mapping[str, Any], title: str) -> tuple[Block, ...]:
    """How much of each interval goes with every identified parameter; what liner and friction change."""
    rows = [(row["region"], "kPa", "", row["mean_kPa"], row) for row in held["regions"]]
    if "settling_mm" in held:
        rows.append(("settling", "mm", "settling_", held["settling_mm"], held))
    if rows[0][-1]["interval_from"] is None:
        return ()
    names = sorted(rows[0][-1]["interval_from"])
    told = [name for name in KNOWN if name in rows[0][-1]["change_kPa"]]
    head = ["", "Value", "95 %, half", *(f"{parameter(name)} (%)" for name in names)]
    head += [KNOWN[name] for name in told]
    lines = []
    for name, unit, begin, value, row in rows:
        low, high = row[f"{begin}interval_{unit}"]
        decimals = 2 if unit == "mm" else 1
        cells = [f"{fixed(value)} {unit}", f"{fixed(max(value - low, high - value), 2)} {unit}"]
        cells += [fixed(row[f"{begin}interval_from"][one], 0) for one in names]
        changes = row[f"{begin}change_{unit}"]
        cells += [f"{fixed(changes[one], decimals)} {unit}" for one in told]
        lines.append(Row((heading(name), *map(numeric, cells))))
    caption = (
        f"What the intervals of means and settling come from, {title}: the share of the variance that would "
        "go if a parameter were known, to first order. Parameters are correlated, so that shares do not add "
        "up to 100 %. Liner and friction count as known; the last columns say what they change (friction "
        "with --samples)."
    )
    return (Table("socket-intervals", caption, tuple(head), tuple(lines)),)


def published_blocks(content: Json, held: Mapping[str, Any], title: str) -> tuple[Block, ...]:
    """What others found over the regions of this result, beside its pressures when a part has been held."""
    found = content["published"]
    if not found:
        return ()
    here = {row["region"]: row for row in held["regions"]}
    regions = dict.fromkeys(name for one in found for name in one["regions"])
    head = ("Region", "Here: mean (kPa)", "Here: peak (kPa)", "Found by others", "How", "Source")
    rows = []
    for name in regions:
        own = [numeric(fixed(here.get(name, held)[key])) for key in ("mean_kPa", "peak_kPa")]
        for one in found:
            if name in one["regions"]:
                told = (Cell(one[key]) for key in ("found", "method", "source"))
                rows.append(Row((heading(name), *own, *told)))
    caption = (
        f"Pressures of this simulation, {title}, and what others found over these regions. No limit and no "
        "verdict is implied."
    )
    return (Table("socket-published", caption, head, tuple(rows)), Prose(PAPERS))
