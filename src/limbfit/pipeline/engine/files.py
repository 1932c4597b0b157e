"""Files of results: their names, how they are written, never half done, and labels corrected by hand.

A label map that someone corrected by hand and saved over what the segment stage wrote is moved to
``results/by-hand/labels.seg.nrrd`` before anything runs. From there on it is an input of the study like any
other, until it is deleted; the stage never writes there.
"""

import csv
import json
import os
import shutil
import uuid
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...results.base import ResultPart
from ...study import Study
from .digests import compute_file_digest

Facts = dict[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
Made = tuple[Facts, Arrays]

THICKNESS = "fat-depth.vtp"
MARKED_SKIN = "skin-markers.stl"
SMOOTHING = "{}-smoothing.npy"  # of a record, as a matrix
WAVES = "{}-waves.csv"  # of a record: how fast shear waves were
LAYERS = "{}-layers.csv"  # of a record: how its tissues gave way
LABELS = "labels.seg.nrrd"
_BY_HAND = Path("results") / "by-hand" / LABELS
DRAFT = ".part"
EARLIER = ".earlier"  # simulations of attempts with other inputs, while the stage is not complete


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that a reader sees the old file or the new one, never half of it."""
    text = json.dumps(content, indent=1, allow_nan=False, default=to_plain)
    with write_atomically(path) as stream:
        stream.write(text.encode())


def write_result(path: Path, result: ResultPart) -> None:
    """Write a result as JSON; its model has checked it."""
    write_json(path, result.to_plain())


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def to_plain(value: Any) -> Any:
    """NumPy scalars and arrays, and collections such as ranges, as what JSON knows."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, Collection) else str(value)


@contextmanager
def write_atomically(path: Path) -> Iterator[BinaryIO]:
    """A binary stream whose content appears at ``path`` only when the block ends well."""
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}{DRAFT}")
    try:
        with draft.open("xb") as stream:
            yield stream
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_table(file: Path, heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file with a line of heads; numbers to nine digits, nothing where a value is None."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(heads)
        writer.writerows([_format_cell(value) for value in row] for row in rows)


def write_rows(file: Path, rows: Sequence[ResultPart], leave_out: Sequence[str] = ()) -> None:
    """A CSV file of parts of a result whose keys are its columns, but for some."""
    heads = [key for key in (type(rows[0]).model_fields if rows else ()) if key not in leave_out]
    write_table(file, heads, [[getattr(row, key) for key in heads] for row in rows])


def _format_cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def write_curves(file: Path, **columns: NDArray[np.float64]) -> None:
    """A CSV with named columns of numbers."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


class ResultFiles:
    """One file for each key, in ``folder``.

    ``also`` are folders of earlier results, beside that of interrupted attempts: what is found there is
    copied, since they may be replaced.
    """

    def __init__(self, folder: Path, also: Iterable[Path] = ()) -> None:
        self.folder = folder
        self.places = (folder, folder.parent / EARLIER, *also)
        folder.mkdir(parents=True, exist_ok=True)

    def find(self, key: str) -> Made | None:
        """What is kept whole under a key; facts are those that JSON gives back."""
        own = self._place(key)
        for file in (place / own.name for place in self.places):
            found = read_made(file)
            if found is not None:
                if file != own:
                    with write_atomically(own) as stream:
                        stream.write(file.read_bytes())
                return found
        return None

    def get(self, key: str, make: Callable[[], Made]) -> Made:
        """What is kept under a key, or is made now."""
        found = self.find(key)
        if found is None:
            self.put(key, make())
            found = self.find(key)
            assert found is not None
        return found

    def put(self, key: str, made: Made) -> None:
        """Keep it under a key, in the place of what was there."""
        facts, arrays = made
        with write_atomically(self._place(key)) as stream:
            np.savez(stream, facts=json.dumps(facts, default=to_plain), **arrays)  # type: ignore[arg-type]

    def drop(self, key: str) -> None:
        """Keep nothing under a key."""
        self._place(key).unlink(missing_ok=True)

    def _place(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def read_made(file: Path) -> Made | None:
    """Facts and arrays of a file of `ResultFiles`; None where there is none, or one that was cut short."""
    try:
        with np.load(file) as stored:
            arrays = {part: stored[part] for part in stored.files if part != "facts"}
            return json.loads(str(stored["facts"])), arrays
    except (FileNotFoundError, EOFError, ValueError, KeyError, BadZipFile):
        return None


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
