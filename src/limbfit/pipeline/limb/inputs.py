"""The image, label map and surfaces that a study names, read and checked in one way for every verb."""

from pathlib import Path

import numpy as np

from ...anatomy.imaging import LabelMap, Volume, check_image, read_labels, read_volume
from ...anatomy.labels.labelcheck import clean_labels, place_on_grid
from ...anatomy.labels.labelfiles import read_contours
from ...anatomy.segmentation.body import check_one_limb
from ...anatomy.segmentation.segmentation import segment
from ...anatomy.surfaces.thickness import check_fat
from ...study import Study
from ..engine.files import find_hand_labels, find_labelled_file, name_file_in_errors
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
