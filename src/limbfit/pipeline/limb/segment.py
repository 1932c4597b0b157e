"""The stage ``segment``, image to label map; and how every verb reads and checks image and labels."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...anatomy.imaging import LabelMap, Volume, check_image, read_labels, read_volume, write_labels
from ...anatomy.labels.labelcheck import assess_labels, clean_labels, place_on_grid
from ...anatomy.labels.labelfiles import read_contours, write_contours
from ...anatomy.segmentation.body import check_one_limb
from ...anatomy.segmentation.segmentation import segment
from ...anatomy.sites.marked import extract_marked_skin, register_limb, remove_markers
from ...anatomy.surfaces.surfaces import write_surface
from ...anatomy.surfaces.thickness import check_fat
from ...report.drawing.sheet import draw_sheet
from ...results.limb import MarkerImageMotion, SegmentResult
from ...study import Study
from ..engine.context import Context, name_file_in_errors
from ..engine.digests import compute_file_digest
from ..engine.store import LABELS, MARKED_SKIN, find_hand_labels, find_labelled_file, write_result
from .surfaces import has_mapped_fat, list_labelled_regions


def read_study_image(study: Study) -> Volume:
    """The study's image; of one limb, unless its labels are given too."""
    volume = read_plain_image(study)
    if not study.segmentation.is_given:
        assert study.image is not None
        with name_file_in_errors(study.path(study.image.path)):
            check_one_limb(volume)
    return volume


def read_plain_image(study: Study) -> Volume:
    """The study's image, however many limbs it shows."""
    assert study.image is not None
    return _read_image(study.path(study.image.path), study.image.series)


def read_marked_image(study: Study) -> Volume | None:
    """The second image of the limb, with markers on, if the study has one."""
    assert study.image is not None
    if study.image.marked is None:
        return None
    return _read_image(study.path(study.image.marked), study.image.markers_series)


def _read_image(path: Path, series: str | None) -> Volume:
    volume = read_volume(path, series)
    check_image(volume, path)
    return volume


def read_study_labels(study: Study, volume: Volume) -> tuple[LabelMap, list[str]] | None:
    """The label map or contours that the study gives, on the image's grid, and what was repaired in it.

    A label map that was corrected by hand in the results counts, unless the study names one of its own.
    """
    table = study.segmentation
    given = table.contours or table.labels or find_hand_labels(study)
    if given is None:
        return None
    path = study.path(given)
    read = read_contours if table.contours is not None else read_labels
    return clean_labels(read(path, volume), path)


def segment_automatically(study: Study, volume: Volume) -> LabelMap:
    """The automatic segmentation, on the image's grid.

    It is made in a frame that does not depend on the order of the axes in the file nor on its rounding: near
    a threshold either would decide about voxels.
    """
    assert study.image is not None
    path, table = study.path(study.image.path), study.segmentation
    near = volume.align_with_lps()
    with name_file_in_errors(path):
        found = segment(
            near.move_to_own_frame(),
            bias_correction=table.bias_correction,
            min_bone_volume_mm3=table.min_bone_volume_mm3,
            contrast=table.contrast,
            seeds={
                name: (np.array(points) - near.origin) @ near.direction
                for name, points in table.seeds.items()
            },
        )
    labels = LabelMap(found.array, *near.geometry, found.names)
    return place_on_grid(labels, volume)


def check_labels(study: Study, labels: LabelMap) -> None:
    """Refuse a given map without a label that ``[geometry]`` needs.

    Raises `LabelError`.
    """
    with name_file_in_errors(find_labelled_file(study)):
        labels.with_regions(list_labelled_regions(study))
        if has_mapped_fat(study):
            check_fat(labels)


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
