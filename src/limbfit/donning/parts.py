"""What a socket's simulation found so far as facts and arrays, so that one that was killed goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ..arrays import Array
from ..fe import Snapshot
from .inside import Strains
from .outcome import DonnedPart, Held, Patch, SocketStep

Facts = dict[str, Any]

SOLVER = "solver."  # its arrays begin with it
FIELDS = ("pressure", "shear", "displacement")
STRAINS = ("shear", "compression", "energy_kPa", "volume_mm3")


def pack(part: DonnedPart) -> tuple[Facts, dict[str, Array]]:
    """As facts that JSON can hold, and arrays by name."""
    arrays = {f"{SOLVER}{name}": array for name, array in part.snapshot.arrays.items()}
    held: Facts = {}
    for i, (name, one) in enumerate(part.held.items()):
        arrays |= {f"{i}.{field}": getattr(one, field) for field in FIELDS}
        arrays |= {f"{i}.strains.{field}": getattr(one.strains, field) for field in STRAINS}
        arrays |= {f"{i}.slopes.{patch}": slopes for patch, slopes in one.slopes.items()}
        held[name] = {"row": asdict(one.row), "slopes": list(one.slopes)}
    rows = [asdict(row) for row in part.rows]
    return {"solver": dict(part.snapshot.facts), "rows": rows, "held": held}, arrays


def unpack(facts: Facts, arrays: Mapping[str, Array]) -> DonnedPart:
    """From what `pack` gave."""
    own = {name.removeprefix(SOLVER): array for name, array in arrays.items() if name.startswith(SOLVER)}
    held = {}
    for i, (name, one) in enumerate(facts["held"].items()):
        slopes = {patch: arrays[f"{i}.slopes.{patch}"] for patch in one["slopes"]}
        strains = Strains(**{field: arrays[f"{i}.strains.{field}"] for field in STRAINS})
        fields = {field: arrays[f"{i}.{field}"] for field in FIELDS}
        held[name] = Held(row=_to_row(one["row"]), strains=strains, slopes=slopes, **fields)
    return DonnedPart(Snapshot(facts["solver"], own), tuple(map(_to_row, facts["rows"])), held)


def _to_row(told: Facts) -> SocketStep:
    vectors = {name: np.array(told[name]) for name in ("force", "moment", "move", "turn")}
    regions = {name: Patch(**patch) for name, patch in told["regions"].items()}
    return SocketStep(**{**told, **vectors, "whole": Patch(**told["whole"]), "regions": regions})
