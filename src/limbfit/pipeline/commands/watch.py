"""Records judged as a rig writes them, so that a bad one is made again while the person is still there."""

import time
from collections.abc import Iterator
from pathlib import Path

from ...acquire.recording import MAX_TOUCH_SD_MM
from ...errors import InputError
from ...results.limb import RecordVerdict
from ...study import Record, Study, TracesTable
from ...traces.formats import BINARY_SUFFIXES, TEXT_SUFFIXES
from ..records.traces import read_trace_file

SETTLING_S = 0.5  # a file that has not grown for so long is taken to be whole; it is judged anew if it grows
POLLING_S = 0.1

State = tuple[int, int]  # size in bytes, time of the last change in ns


def watch_records(
    folder: str | Path, study: Study | None = None, *, once: bool = False
) -> Iterator[RecordVerdict]:
    """Judge every record in a folder and below it, and each that comes or changes, as soon as it rests.

    Without a ``study``, columns have limbfit's own names. What a study names beside a record's force
    (ultrasound, surface, shear waves) and hidden files are passed over. ``once``: judge what is there,
    whether it rests or not, and end. Raises `InputError` where there is no such folder.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError("no such folder", file=place, remedy="name the folder into which the rig writes")
    records = {} if study is None else {study.path(one.trace).resolve(): one for one in study.recorded}
    others = () if study is None else [study.path(file) for one in study.recorded for file in one.files]
    passed = {file.resolve() for file in others} - set(records)
    judged: dict[Path, State] = {}
    growing: dict[Path, tuple[State, float]] = {}
    while True:
        for file, state in _list_files(place):
            if judged.get(file) == state or file.resolve() in passed:
                continue
            before, since = growing.get(file, (None, 0.0))
            if before != state:
                growing[file] = state, time.monotonic()
            if once or (before == state and time.monotonic() - since >= SETTLING_S):
                judged[file] = state
                table = TracesTable() if study is None else study.traces
                yield _judge_record(file, place, table, records.get(file.resolve()))
        if once:
            return
        time.sleep(POLLING_S)


def _list_files(folder: Path) -> Iterator[tuple[Path, State]]:
    """Files that may hold records and are not empty, by name, each with its state."""
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in (*TEXT_SUFFIXES, *BINARY_SUFFIXES):
            continue
        if any(part.startswith((".", "~")) for part in file.relative_to(folder).parts):
            continue
        try:
            found = file.stat()
        except OSError:  # it has just been moved or removed
            continue
        if found.st_size and file.is_file():
            yield file, (found.st_size, found.st_mtime_ns)


def _judge_record(file: Path, folder: Path, table: TracesTable, record: Record | None) -> RecordVerdict:
    facts, reasons, is_bad = None, [], True
    try:
        _, _, facts = read_trace_file(file, table, record)
    except InputError as error:
        where = f" ({error.place})" if error.place else ""
        reasons = [f"{error.what}{where}; {error.remedy or 'record it again'}"]
    except OSError as error:
        reasons = [f"it cannot be read: {error.strerror}"]
    else:
        reasons = [f"{remark.what} ({remark.cause}); {remark.remedy}" for remark in facts.remarks]
        is_bad = facts.touch_down_uncertainty_mm > MAX_TOUCH_SD_MM
        if is_bad:
            reasons.append(
                f"the touch-down is known within {facts.touch_down_uncertainty_mm:.2f} mm only (at most "
                f"{MAX_TOUCH_SD_MM:g}); begin farther from the skin, or clean the force sensor"
            )
    return RecordVerdict(
        file=file.relative_to(folder).as_posix(),
        record=None if record is None else record.name,
        verdict="bad" if is_bad else "look" if reasons else "good",
        reasons=reasons,
        facts=facts,
    )
