"""The log of a run: ``results/log/<time>.jsonl``, one JSON object per line, written as things happen.

Paths of inputs stand in it by their keys in the study file, since names of files may be a patient's, and what
lies outside the study is not named at all.
"""

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

from ..._version import __version__
from ...study import Study
from .context import Listener, Progress
from .store import translate_disk_errors

FOLDER = "log"
MAX_LOGS = 50  # logs of a study; older ones go
_PATH = re.compile(r"(?<![\w.<])(?:[A-Za-z]:)?[/\\](?!\s)(?:[^/\\:;,'\"]+[/\\])+[^\s:;,'\"]*")


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
        text = redact_paths(event.text, study)
        write(
            "fit" if event.fit else "progress",
            stage=event.stage,
            done=event.done,
            total=event.total,
            text=text,
            **({} if event.facts is None else {"facts": dict(event.facts)}),
        )
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
