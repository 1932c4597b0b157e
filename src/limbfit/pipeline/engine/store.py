"""The results of a study on disk: files, stage folders, what is done, what is stale, who holds them.

A stage works in ``results/.work-<stage>-<key>`` and is renamed to ``results/<stage>`` when complete. The key
is a digest of everything the stage depends on, so a run that was killed finds its own unfinished folder again
and goes on in it. Of an unfinished folder of other inputs the simulations are kept, since some may serve.

A label map that someone corrected by hand and saved over what the segment stage wrote is moved to
``results/by-hand/labels.seg.nrrd`` before anything runs. From there on it is an input of the study like any
other, until it is deleted; the stage never writes there.
"""

import csv
import errno
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any, BinaryIO
from zipfile import BadZipFile

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from ...errors import InputError, RunError
from ...results.base import ResultPart
from ...results.runs import StageStamp
from ...results.study_results import StudyResults
from ...study import Study
from .digests import compute_file_digest, to_plain

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
STAMP = "stage.json"
LOCK, HOLDER = ".lock", ".holder"
_LOCK_TIMEOUT_S = 0.5  # for one who only asks whether a study is held
RUNS = "runs"  # a stage's kept simulations
COARSE = "coarse"  # folder of the coarse meshes, in that of the mesh stage
_OLD = ".old-"


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


@dataclass(frozen=True)
class StageState:
    """What the disk says of a stage: ``done``, ``stale`` (of other inputs), ``begun`` or ``missing``."""

    stage: str
    state: str
    seconds: float | None = None
    finished: str | None = None


class Store:
    """The results folder of one study."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __getitem__(self, stage: str) -> Path:
        return self.folder / stage

    @property
    def results(self) -> StudyResults:
        """What is stored now."""
        return StudyResults(self.folder)

    def stamp(self, stage: str) -> StageStamp | None:
        """The stamp of a stage; None also for one that is not readable: then the stage is made anew."""
        try:
            return StageStamp.find(self.folder, stage)
        except InputError:
            return None

    def work_folder(self, stage: str, key: str) -> Path:
        return self.folder / f".work-{stage}-{key}"

    def state(self, stage: str, key: str) -> StageState:
        stamp = self.stamp(stage)
        if stamp and stamp.key == key and self._is_whole(stage):
            return StageState(stage, "done", stamp.seconds, stamp.finished)
        if (stamp and stamp.key == key) or self.work_folder(stage, key).is_dir():
            return StageState(stage, "begun")
        return StageState(stage, "stale" if stamp else "missing")

    def _is_whole(self, stage: str) -> bool:
        """False if a power cut, or a copy that was ended, has left a part of what the stage says in JSON."""
        try:
            return bool([read_json(file) for file in self[stage].glob("*.json")])
        except ValueError:
            return False

    def make(self, stage: str, key: str, produce: Callable[[Path], dict[str, Any]]) -> StageStamp:
        """Run ``produce(folder)`` in the stage's work folder and put the folder in its place.

        ``produce`` returns facts for the stamp. Seconds add up over interrupted attempts. A folder that was
        complete when a run was killed is only put in its place.
        """
        work = self.work_folder(stage, key)
        with translate_disk_errors(self.folder):
            work.mkdir(parents=True, exist_ok=True)
            if self.stamp(work.name) is None:  # a power cut may have left a part of it
                self._take_over_others(stage, work)
                self._complete(stage, key, work, produce)
            self._put_in_place(work, self[stage])
        return StageStamp.read(self.folder, stage)

    def _complete(self, stage: str, key: str, work: Path, produce: Callable[[Path], dict[str, Any]]) -> None:
        clock, start = work / ".seconds", perf_counter()  # seconds add up over attempts
        before = 0.0
        with suppress(OSError, ValueError):  # none there, or a part that a power cut has left
            before = float(read_json(clock))
        try:
            facts = produce(work)
        finally:
            seconds = before + perf_counter() - start
            if work.is_dir():
                write_json(clock, round(seconds, 3))
        clock.unlink(missing_ok=True)
        shutil.rmtree(work / EARLIER, ignore_errors=True)
        for draft in work.rglob(f".*{DRAFT}"):  # of attempts that were killed while writing
            draft.unlink()
        stamp = StageStamp(
            stage=stage,
            key=key,
            seconds=round(seconds, 3),
            finished=datetime.now(UTC).isoformat(timespec="seconds"),
            **facts,
        )
        write_result(work / STAMP, stamp)

    def _take_over_others(self, stage: str, work: Path) -> None:
        """Drop unfinished folders of other inputs, but for their simulations."""
        earlier = work / EARLIER
        for folder in self.folder.glob(f".work-{stage}-*"):
            if folder != work:
                for file in (*folder.glob(f"{EARLIER}/*.npz"), *folder.glob(f"{RUNS}/*.npz")):
                    earlier.mkdir(exist_ok=True)
                    file.rename(earlier / file.name)
                shutil.rmtree(folder, ignore_errors=True)

    def mend(self) -> None:
        """Put right what a run that was killed while it wrote or renamed has left."""
        for draft in self.folder.glob(f".*{DRAFT}"):
            draft.unlink()
        for old in self.folder.glob(f"{_OLD}*"):
            place = self.folder / old.name.removeprefix(_OLD)
            if place.exists():
                _remove(old)
            else:
                old.rename(place)

    def _put_in_place(self, work: Path, place: Path) -> None:
        """Renames only: at each moment the old folder, none, or the new one stands there, never a mixture."""
        old = self.folder / f"{_OLD}{place.name}"
        _remove(old)
        if os.path.lexists(place):
            place.rename(old)
        work.rename(place)
        _remove(old)


def _remove(old: Path) -> None:
    """Remove a folder; of a link, or a file in its place, itself alone."""
    if old.is_symlink() or old.is_file():
        old.unlink()
    else:
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def translate_disk_errors(folder: Path) -> Iterator[None]:
    """Turn a full or read-only disk into one clear line."""
    remedies = {
        errno.ENOSPC: "the disk is full; free some space and run again: finished work is kept",
        errno.EROFS: "the file system is read-only; copy the study to a folder that can be written",
        errno.EACCES: "no permission to write; check the folder's owner and mode",
        errno.EDQUOT: "the disk quota is used up; free some space and run again: finished work is kept",
        errno.EFBIG: "a file is larger than may be written here (ulimit -f); raise the limit and run again",
        errno.EPERM: "writing is not permitted; check the folder's owner and mode",
    }
    try:
        yield
    except OSError as error:
        if error.errno in remedies:
            raise RunError(f"{folder}: {remedies[error.errno]}") from error
        if error.errno is None and "failed to write" in str(error):  # VTK does not say why
            raise RunError(
                f"{folder}: a file could not be written; see whether the disk is full and run again: "
                "finished work is kept"
            ) from error
        raise


@contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Hold a study for one run; a second run is refused while the first lives.

    The lock is the operating system's, on ``results/.lock``, so it goes with the process however that ends;
    ``results/.holder`` says whose it is.
    """
    if folder.is_symlink():
        raise RunError(f"{folder}: is a link, and nothing outside the study is written; make it a folder")
    own = FileLock(folder / LOCK, timeout=_LOCK_TIMEOUT_S)
    with translate_disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            own.acquire()
        except Timeout:
            holder = find_holder(folder) or "another process"
            raise RunError(
                f"{folder}: {holder} is running this study; wait for it or end it (kill PID): its lock "
                "ends with it, and the next run continues where it stopped"
            ) from None
    try:
        with translate_disk_errors(folder):
            since = f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
            (folder / HOLDER).write_text(f"process {os.getpid()} (since {since})", encoding="utf-8")
            Store(folder).mend()
        yield
    finally:
        (folder / HOLDER).unlink(missing_ok=True)
        own.release()


def find_holder(folder: Path) -> str:
    """Which process says that it holds a study, and since when; empty where none does."""
    try:
        return (folder / HOLDER).read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def is_held(folder: Path) -> bool:
    """Whether a run holds a study now."""
    if not (folder / LOCK).is_file():
        return False
    try:
        with FileLock(folder / LOCK, timeout=0):
            return False
    except (Timeout, PermissionError):  # of somebody else's run, or one that was killed
        return True
