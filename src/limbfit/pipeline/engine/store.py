"""Stage folders on disk: what is done, what is stale, who holds them.

A stage works in ``results/.work-<stage>-<key>`` and is renamed to ``results/<stage>`` when complete. The key
is a digest of everything the stage depends on, so a run that was killed finds its own unfinished folder again
and goes on in it. Of an unfinished folder of other inputs the simulations are kept, since some may serve.
"""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from filelock import FileLock, Timeout

from ...errors import InputError, RunError
from ...results.runs import StageStamp
from ...results.study_results import StudyResults
from .files import DRAFT, EARLIER, read_json, write_json, write_result

STAMP = "stage.json"
LOCK, HOLDER = ".lock", ".holder"
_LOCK_TIMEOUT_S = 0.5  # for one who only asks whether a study is held
RUNS = "runs"  # a stage's kept simulations
COARSE = "coarse"  # folder of the coarse meshes, in that of the mesh stage
_OLD = ".old-"


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
