"""The stage ``segment``: image to label map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.imaging import LabelMap, write_labels
from ...anatomy.labels.contours import write_contours
from ...anatomy.labels.quality import assess
from ...report.drawing.sheet import draw_sheet
from ..shared.artefacts import file_digest, write_json
from ..shared.context import Context
from ..shared.hand_labels import DIGEST, LABELS
from .inputs import automatic_labels, study_image, study_labels
from .marked_images import second_skin, without_own_markers


def run_segment(context: Context, folder: Path) -> dict[str, Any]:
    """Image to label map; a corrected label map of the study wins over the automatic one."""
    study = context.study
    assert study.image is not None
    context.tell("segment", 0, 3, "reading the image")
    volume, removed = without_own_markers(study, study_image(study), folder)
    for note in volume.notes:
        context.tell("segment", 0, 3, f"warning: image: {note}")
    context.tell("segment", 1, 3, "labelling tissues")
    given = study_labels(study, volume)
    if given is not None:
        (labels, notes), method = given, "corrected by hand"
        for note in notes:
            context.tell("segment", 1, 3, f"label map: {note}")
    else:
        labels, notes, method = automatic_labels(study, volume), [], "automatic"
    write_labels(folder / LABELS, labels)
    write_contours(folder / "contours.csv", labels)
    quality = assess(labels)
    write_json(folder / "quality.json", quality.as_json())
    draw_sheet(folder / "quality.png", volume, labels, quality)
    context.tell("segment", 2, 3, "outlining the skin with markers")
    facts = {"method": method, "volumes_cm3": label_volumes(labels), "repairs": notes}
    facts["warnings"] = [f"image: {note}" for note in volume.notes]
    facts[DIGEST] = file_digest(folder / LABELS)
    write_json(folder / "segment.json", facts | removed | second_skin(study, volume, labels, folder))
    return {}


def label_volumes(labels: LabelMap) -> dict[str, float]:
    """Volume of each label in cubic centimetres."""
    voxel_cm3 = float(np.prod(labels.spacing)) / 1000
    return {
        name: round(float((labels.array == value).sum()) * voxel_cm3, 2)
        for value, name in labels.names.items()
    }
