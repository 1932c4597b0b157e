"""Files that one stage writes and another reads, labels corrected by hand, and files that errors name.

A label map that someone corrected by hand and saved over what the segment stage wrote is moved to
``results/by-hand/labels.seg.nrrd`` before anything runs. From there on it is an input of the study like any
other, until it is deleted; the stage never writes there.
"""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...errors import InputError
from ...study import Study
from .digests import compute_file_digest
from .storage import read_json, write_atomically

THICKNESS = "fat-depth.vtp"
MARKED_SKIN = "skin-markers.stl"
SMOOTHING = "{}-smoothing.npy"  # of a record, as a matrix
WAVES = "{}-waves.csv"  # of a record: how fast shear waves were
LAYERS = "{}-layers.csv"  # of a record: how its tissues gave way
LABELS = "labels.seg.nrrd"
_BY_HAND = Path("results") / "by-hand" / LABELS


def find_hand_labels(study: Study) -> Path | None:
    """The label map corrected by hand, relative to the study; None where the study names its own labels."""
    if study.segmentation.is_given:
        return None
    if _is_edited(study):
        return Path("results") / "segment" / LABELS
    return _BY_HAND if study.path(_BY_HAND).is_file() else None


def keep_hand_labels(study: Study) -> Path | None:
    """Copy a label map that was edited in place to where no stage writes; where to, if there was one."""
    if not _is_edited(study):
        return None
    kept = study.path(_BY_HAND)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with (study.results / "segment" / LABELS).open("rb") as edited, write_atomically(kept) as stream:
        shutil.copyfileobj(edited, stream)
    return kept


def _is_edited(study: Study) -> bool:
    """Whether the stored label map is not the one that the stage wrote."""
    labels, facts = study.results / "segment" / LABELS, study.results / "segment" / "segment.json"
    if not labels.is_file() or not facts.is_file():
        return False
    written = read_json(facts).get("labels_sha256")  # not by its model: a run makes older results anew
    if written is None or compute_file_digest(labels) == written:
        return False
    kept = study.path(_BY_HAND)
    return not (kept.is_file() and compute_file_digest(kept) == compute_file_digest(labels))


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
