"""Label maps that someone corrected by hand and saved over what the segment stage wrote.

Such a file is moved to ``results/by-hand/labels.seg.nrrd`` before anything runs. From there on it is an input
of the study like any other, until it is deleted; the stage never writes there.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from ...study import Study
from .digests import compute_file_digest
from .storage import read_json, write_atomically

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
