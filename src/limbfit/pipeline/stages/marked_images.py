"""The images of a study that have markers on the skin: what they add to the stage ``segment``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ...anatomy.imaging import LabelMap, Volume
from ...anatomy.sites.marked import marked_skin, without_markers
from ...anatomy.sites.registration import limb_motion
from ...anatomy.surfaces.surfaces import write_surface
from ...study import Study
from .files import MARKED_SKIN, naming
from .inputs import marked_image


def without_own_markers(study: Study, volume: Volume, folder: Path) -> tuple[Volume, dict[str, Any]]:
    """The image without the markers on its skin, if the study says that there are some; else as it is.

    The skin with them on is stored in ``folder``. The facts say how many were taken off.
    """
    assert study.image is not None
    if study.image.markers != "same":
        return volume, {}
    with naming(study.path(study.image.path)):
        skin, _ = marked_skin(volume)
        plain, count = without_markers(volume, skin)
    write_surface(folder / MARKED_SKIN, skin)
    return plain, {"markers_removed": count}


def second_skin(study: Study, volume: Volume, labels: LabelMap, folder: Path) -> dict[str, Any]:
    """Store the skin of the second image, moved to where the limb lies in the first; how it was moved."""
    marked = marked_image(study)
    if marked is None:
        return {}
    assert study.image is not None
    assert study.image.marked is not None
    with naming(study.path(study.image.marked)):
        skin, _ = marked_skin(marked)
        motion = limb_motion(volume, marked, labels.limb)
    write_surface(folder / MARKED_SKIN, replace(skin, points=motion.apply(skin.points)))
    measures = {"shift_mm": motion.shift_mm, "turn_deg": motion.turn_deg, "correlation": motion.correlation}
    return {"motion": {name: round(value, 3) for name, value in measures.items()}}
