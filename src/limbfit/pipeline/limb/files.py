"""Files that one stage writes and another reads, and those of the study that errors name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...errors import InputError
from ...study import Study
from ..engine.hand_labels import find_hand_labels

THICKNESS = "fat-depth.vtp"
MARKED_SKIN = "skin-markers.stl"
SMOOTHING = "{}-smoothing.npy"  # of a record, as a matrix
WAVES = "{}-waves.csv"  # of a record: how fast shear waves were
LAYERS = "{}-layers.csv"  # of a record: how its tissues gave way


def find_labelled_file(study: Study) -> Path:
    """What the labels of a study come from: its label map, or the image."""
    assert study.image is not None
    table = study.segmentation
    return study.path(table.labels or table.contours or find_hand_labels(study) or study.image.path)


@contextmanager
def name_file_in_errors(file: Path | None, place: str | None = None, about: str = "") -> Iterator[None]:
    """Say which file, and place in it, an error is about, where it names none itself; and what ``about``."""
    try:
        yield
    except InputError as error:
        if error.file is not None:
            raise
        what, place = about + error.what, place or error.place
        raise type(error)(what, file=file, place=place, remedy=error.remedy) from None
