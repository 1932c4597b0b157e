"""Records that could be made: as they are simulated, and as the tables of a study that makes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomlkit

from ...indentation import SiteModel
from ...results.planning import ProtocolRecord

# Standard deviations of what can be read beside the force, and how their files end.
SEEN = {
    "ultrasound_sd_mm": "layers",  # of a thickness
    "surface_sd_mm": "surface",  # of a component of a move of the skin
    "shear_waves_sd_m_s": "waves",  # of a speed, of which there is one in `READING_S`
}


@dataclass(frozen=True)
class PlannedRecord:
    """A record that could be made: the indenter pressed in at one rate, held, and taken back at that rate.

    ``usual``: as deep as the site was recorded or is planned, or nearest to that.
    """

    site: str
    indenter: str | None
    depth_mm: float
    speed_mm_s: float
    hold_s: float
    model: SiteModel
    usual: bool

    @property
    def tool(self) -> str:
        return self.indenter or "indenter"

    @property
    def seconds(self) -> float:
        """From the first touch to the last."""
        return 2.0 * self.depth_mm / self.speed_mm_s + self.hold_s

    @property
    def told(self) -> str:
        held = f", held for {self.hold_s:g} s" if self.hold_s else ""
        return f"site {self.site}, {self.tool}, {self.depth_mm:.1f} mm at {self.speed_mm_s:g} mm/s{held}"


def press(model: SiteModel, depth: float, speed: float, hold: float) -> SiteModel:
    """In to ``depth`` mm at ``speed`` mm/s, held for ``hold`` s, and out."""
    ramp = depth / speed
    knots = [(0.0, 0.0), (ramp, depth)] + ([(ramp + hold, depth)] if hold else [])
    knots.append((knots[-1][0] + ramp, 0.0))
    times, depths = zip(*knots)
    return replace(model, knots_s=times, knots_mm=depths)


def write_records(file: Path, records: Sequence[ProtocolRecord], seen: Mapping[str, Any]) -> None:
    """The tables ``[[records]]`` of a study that makes them."""
    tables, number = tomlkit.aot(), dict.fromkeys((row.site for row in records), 0)
    for row in records:
        number[row.site] += 1
        table = tomlkit.table()
        name = f"{number[row.site]}"
        table.update({"site": row.site, "name": name, "trace": f"records/{row.site}-{name}.csv"})
        if row.indenter != "indenter":
            table["indenter"] = row.indenter
        for key, end in SEEN.items():
            if seen[key] is not None:
                table[key.partition("_sd")[0]] = f"records/{row.site}-{name}-{end}.csv"
                table[key] = seen[key]
        table.update({key: round(getattr(row, key), 3) for key in ("depth_mm", "speed_mm_s", "hold_s")})
        tables.append(table)
    document = tomlkit.document()
    document["records"] = tables
    file.write_text(tomlkit.dumps(document), encoding="utf-8")
