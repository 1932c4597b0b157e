"""What every stage is given: the study, where to store, what to run on, whom to tell; and the log of that.

The log of a run is ``results/log/<time>.jsonl``, one JSON object per line, written as things happen. Paths of
inputs stand in it by their keys in the study file, since names of files may be a patient's, and what lies
outside the study is not named at all.
"""

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from ..._version import __version__
from ...errors import InputError
from ...execution import Executor, Limits, make_executor
from ...laws import Parameters
from ...results.study_results import StudyResults
from ...study import Study
from .store import Store, translate_disk_errors

NO_PARAMETERS: Parameters = {}  # an experiment's, where its command states none
FOLDER = "log"
MAX_LOGS = 50  # logs of a study; older ones go
_PATH = re.compile(r"(?<![\w.<])(?:[A-Za-z]:)?[/\\](?!\s)(?:[^/\\:;,'\"]+[/\\])+[^\s:;,'\"]*")


@dataclass(frozen=True)
class Progress:
    """One step of a stage: ``done`` of ``total`` (``total`` 0: not known), and what is going on in words.

    ``fit``: the words are the identified parameters and their error so far, ``facts`` the same as numbers.
    """

    stage: str
    done: float = 0.0
    total: float = 0.0
    text: str = ""
    fit: bool = False
    facts: Mapping[str, Any] | None = None

    def __str__(self) -> str:
        """One line, as ``listener=print`` shows it."""
        count = f" {round(self.done, 1):g} of {self.total:g}" if self.total else ""
        return f"{self.stage}{count}: {self.text}" if self.text else f"{self.stage}{count}"


Listener = Callable[[Progress], None]


def ignore_progress(progress: Progress) -> None:
    """The listener of a call that names none: progress is not shown."""


@dataclass(frozen=True)
class Context:
    """One run of one study."""

    study: Study
    store: Store
    executor: Executor
    listener: Listener

    def tell(self, stage: str, done: float, total: float, text: str = "", **more: Any) -> None:
        """Tell the listener of a step: a `Progress`."""
        self.listener(Progress(stage, done, total, text, **more))

    @property
    def results(self) -> StudyResults:
        """What the finished stages have stored."""
        return self.store.results


def build_executor(study: Study) -> Executor:
    """What a study's jobs run on, with its limits."""
    table = study.execution
    return make_executor(table.workers, Limits(table.time_limit_s, table.memory_limit_GB))


@contextmanager
def write_journal(study: Study, what: str, listener: Listener) -> Iterator[Listener]:
    """A listener that also writes the log; the way the block ends is its last line."""
    folder, start = study.results / FOLDER, perf_counter()
    with translate_disk_errors(study.results):
        folder.mkdir(parents=True, exist_ok=True)
        for old in sorted(folder.glob("*.jsonl"))[: -MAX_LOGS + 1]:
            old.unlink()
        file = folder / f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}.jsonl"
        stream = file.open("x", encoding="utf-8")

    def write(event: str, **more: Any) -> None:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        row = {"time": now, "seconds": round(perf_counter() - start, 3), "event": event, **more}
        with translate_disk_errors(study.results):
            stream.write(json.dumps(row) + "\n")
            stream.flush()

    def listen(event: Progress) -> None:
        kept = {key: getattr(event, key) for key in ("stage", "done", "total")}
        facts = {} if event.facts is None else {"facts": dict(event.facts)}
        write("fit" if event.fit else "progress", **kept, text=redact_paths(event.text, study), **facts)
        listener(event)

    try:
        write("begin", what=what, limbfit=__version__, process=os.getpid())
        yield listen
        write("end")
    except BaseException as error:
        with suppress(Exception):  # the error itself matters more, such as that the disk is full
            kind = "interrupted" if isinstance(error, KeyboardInterrupt | GeneratorExit) else "failed"
            write(kind, error=type(error).__name__, text=redact_paths(str(error), study))
        raise
    finally:
        with suppress(OSError):  # a full disk would be told of once more
            stream.close()


def redact_paths(text: str, study: Study) -> str:
    """A text without the names of input files, and without paths outside the study."""
    for key, path in sorted(study.inputs.items(), key=lambda item: -len(str(item[1]))):
        for name in (str(study.path(path)), str(path)):
            text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", f"<{key}>", text)
    for folder in (study.folder, study.folder.resolve()):
        if folder != Path("."):
            text = text.replace(f"{folder}{os.sep}", "").replace(str(folder), "<study>")
    return _PATH.sub("<path>", text)


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
