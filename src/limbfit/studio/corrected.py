"""Which label map the page shows, and where one that was corrected on it is saved.

A map that the stage ``segment`` made is saved over, as 3D Slicer would: the pipeline takes it as corrected by
hand from then on. Where the study names labels of its own, the corrected map is put beside the study file,
which then names that one: the given file stays as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ..anatomy.imaging import LabelMap, read_labels, write_labels
from ..pipeline.shared.store import file_digest
from ..study import Study
from .editing import set_key
from .folder import StudyFolder

LABELS = "labels.seg.nrrd"
BESIDE = "corrected.seg.nrrd"


@dataclass(frozen=True)
class Shown:
    """The label map on the page: its file and the digest of its content."""

    file: Path
    digest: str

    def saved_to(self, study: Study) -> str:
        """Where a correction goes, relative to the study."""
        return BESIDE if study.segmentation.is_given else f"results/segment/{LABELS}"


def shown_labels(folder: StudyFolder) -> Shown | None:
    """The corrected map beside the study where the study names it, else that of the stage ``segment``."""
    given = folder.load().segmentation.labels
    file = folder.results / "segment" / LABELS
    if given == Path(BESIDE) and (folder.folder / BESIDE).is_file():
        file = folder.folder / BESIDE
    return Shown(file, file_digest(file)) if file.is_file() else None


@lru_cache(maxsize=1)
def labels_of(shown: Shown) -> LabelMap:
    """The label map on the page; the last one is kept: a page asks for its names, then for its voxels."""
    return read_labels(shown.file)


def save_labels(folder: StudyFolder, study: Study, shown: Shown, labels: LabelMap) -> None:
    """Write a corrected map to where the pipeline takes it from, in one piece."""
    place = folder.folder / shown.saved_to(study)
    written = place.with_name(f".new-{place.name}")
    try:
        write_labels(written, labels)
        written.replace(place)
    finally:
        written.unlink(missing_ok=True)
    if study.segmentation.is_given and study.segmentation.labels != Path(BESIDE):
        set_key(folder.file, "segmentation", "contours", None)
        set_key(folder.file, "segmentation", "labels", BESIDE)
