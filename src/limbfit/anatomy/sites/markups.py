"""Site positions from 3D Slicer: the control points of a markups file (``.mrk.json``).

https://slicer.readthedocs.io/en/latest/developer_guide/modules/markups.html
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import SiteError

# Slicer writes names; its older files numbers.
_SIGNS = {
    "LPS": np.ones(3),
    "1": np.ones(3),
    "RAS": np.array([-1.0, -1.0, 1.0]),
    "0": np.array([-1.0, -1.0, 1.0]),
}


def read_markups(path: str | Path) -> dict[str, Array]:
    """The placed control points of a markups file by their labels, (3,) LPS mm. Raises `SiteError` for a file
    that is no markups file, does not state its coordinates as LPS or RAS, is not in millimetres, or gives a
    label to two points.
    """
    path = Path(path)
    try:
        lists = json.loads(path.read_text(encoding="utf-8"))["markups"]
        found = [pair for markup in lists for pair in _read_points(markup, path)]
    except SiteError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise SiteError(
            "not a readable markups file", file=path, remedy="save the points from 3D Slicer as .mrk.json"
        ) from None
    labels = [label for label, _ in found]
    doubled = sorted({label for label in labels if labels.count(label) > 1})
    if doubled:
        raise SiteError(
            f"control points labelled alike: {', '.join(doubled)}",
            file=path,
            remedy="give each control point its own label",
        )
    return dict(found)


def _read_points(markup: dict[str, Any], path: Path) -> list[tuple[str, Array]]:
    """Label and place of the placed points of one list; points that were only planned are left out."""
    sign = _SIGNS.get(str(markup.get("coordinateSystem")).upper())
    if sign is None:
        raise SiteError(
            "the file does not say whether its coordinates are LPS or RAS",
            file=path,
            place="coordinateSystem",
            remedy="save it again from 3D Slicer",
        )
    unit = markup.get("coordinateUnits", "mm")
    if (unit[0] if isinstance(unit, list) else unit) != "mm":
        raise SiteError("coordinates that are not in millimetres", file=path, place="coordinateUnits")
    found = []
    for point in markup["controlPoints"]:
        if point.get("positionStatus", "defined") != "defined":
            continue
        place = np.array([float(x) for x in point["position"]])
        if place.shape != (3,) or not np.all(np.isfinite(place)):
            raise SiteError("a control point without three coordinates", file=path)
        found.append((str(point.get("label", "")).strip(), sign * place))
    return found
