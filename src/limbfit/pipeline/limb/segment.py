"""The stage ``segment``: image to label map."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...anatomy.imaging import LabelMap, Volume, write_labels
from ...anatomy.labels.labelcheck import assess_labels
from ...anatomy.labels.labelfiles import write_contours
from ...anatomy.sites.marked import extract_marked_skin, register_limb, remove_markers
from ...anatomy.surfaces.surfaces import write_surface
from ...report.drawing.sheet import draw_sheet
from ...results.limb import MarkerImageMotion, SegmentResult
from ...study import Study
from ..engine.context import Context
from ..engine.digests import compute_file_digest
from ..engine.files import LABELS, MARKED_SKIN, name_file_in_errors
from ..engine.storage import write_result
from .inputs import read_marked_image, read_study_image, read_study_labels, segment_automatically


def run_segment(context: Context, folder: Path) -> None:
    """Image to label map; a corrected label map of the study wins over the automatic one."""
    study = context.study
    assert study.image is not None
    context.tell("segment", 0, 3, "reading the image")
    volume, removed = remove_own_markers(study, read_study_image(study), folder)
    for note in volume.notes:
        context.tell("segment", 0, 3, f"warning: image: {note}")
    context.tell("segment", 1, 3, "labelling tissues")
    given = read_study_labels(study, volume)
    if given is not None:
        (labels, notes), method = given, "corrected by hand"
        for note in notes:
            context.tell("segment", 1, 3, f"label map: {note}")
    else:
        labels, notes, method = segment_automatically(study, volume), [], "automatic"
    write_labels(folder / LABELS, labels)
    write_contours(folder / "contours.csv", labels)
    quality = assess_labels(labels)
    write_result(folder / "quality.json", quality)
    draw_sheet(folder / "quality.png", volume, labels, quality)
    voxel_cm3 = float(np.prod(labels.spacing)) / 1000
    voxels = {name: float((labels.array == value).sum()) for value, name in labels.names.items()}
    context.tell("segment", 2, 3, "outlining the skin with markers")
    found = SegmentResult(
        method=method,
        volumes_cm3={name: round(number * voxel_cm3, 2) for name, number in voxels.items()},
        repairs=notes,
        warnings=[f"image: {note}" for note in volume.notes],
        labels_sha256=compute_file_digest(folder / LABELS),
        markers_removed=removed,
        motion=store_second_skin(study, volume, labels, folder),
    )
    write_result(folder / "segment.json", found)


def remove_own_markers(study: Study, volume: Volume, folder: Path) -> tuple[Volume, int | None]:
    """The image without the markers on its skin, if the study says that there are some; else as it is.

    The skin with them on is stored in ``folder``. The number says how many were taken off.
    """
    assert study.image is not None
    if study.image.markers != "same":
        return volume, None
    with name_file_in_errors(study.path(study.image.path)):
        skin, _ = extract_marked_skin(volume)
        plain, count = remove_markers(volume, skin)
    write_surface(folder / MARKED_SKIN, skin)
    return plain, count


def store_second_skin(
    study: Study, volume: Volume, labels: LabelMap, folder: Path
) -> MarkerImageMotion | None:
    """Store the skin of the second image, moved to where the limb lies in the first; how it was moved."""
    marked = read_marked_image(study)
    if marked is None:
        return None
    assert study.image is not None
    assert study.image.marked is not None
    with name_file_in_errors(study.path(study.image.marked)):
        skin, _ = extract_marked_skin(marked)
        motion = register_limb(volume, marked, labels.limb)
    write_surface(folder / MARKED_SKIN, replace(skin, points=motion.apply(skin.points)))
    return MarkerImageMotion(
        shift_mm=round(motion.shift_mm, 3),
        turn_deg=round(motion.turn_deg, 3),
        correlation=round(motion.correlation, 3),
    )
