"""The record of a session: plain CSV with a checksum every 50 ms, written as it comes.

    #limbfit-recording 1
    #head {"device": {...}, "settings": {...}, ...}
    host_us,device_us,number,flags,moving,p1_um,...,f1_mN,...,c1_fF,...
    10321,8000,5,8,0,0,...
    #event {"at_us": 12001, "event": "phase", "phase": "clamp"}
    #block 0 6210 9D1C06AB

A ``#block`` line closes all bytes since the one before: its index, their number, and their CRC-32 continued
from the block before.  What a crash leaves after the last of them is not believed; that is less than 0.1 s.
Comments start with ``#``, so a table reader that skips them reads the rows.

The record is checked while the limb is still in the device.
"""

import io
import json
import os
import re
import sys
import threading
import time
from binascii import crc32
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, BinaryIO

import numpy as np

from ..arrays import Indices
from ..errors import RunError, TraceError, add_location
from ..traces import RegularisedCurve, Trace, find_touch_down, regularise
from .line_protocol import PINS, RATE_HZ, Sample

FIRST_LINE = "#limbfit-recording 1"
ROWS_PER_BLOCK = 25  # per block: 50 ms
SYNC_INTERVAL_S = 1.0  # how often the disk is asked to keep what was written
MAX_BYTES = 2_000_000_000
FOLLOWED_BYTES = 1 << 22  # read at once by who follows a record: half a minute of it
_HEAD_BYTES = 1 << 16  # the first block and a closing line are shorter than these
_CLOSING_BYTES = 64
_NAMES = ("host_us", "device_us", "number", "flags", "moving")
_CHANNELS = (("p", "um"), ("f", "mN"), ("c", "fF"))  # position, force, capacitance
_CLOSING = re.compile(rb"#block ([0-9]{1,9}) ([0-9]{1,9}) ([0-9A-F]{8})\n")
SPEED_TOLERANCE = 0.5 / 0.96  # of the ramp's speed; paper, section 2.1.2: 0.96 +- 0.5 mm/s
MAX_TOUCH_SD_MM = 0.3
MAX_DIFFERENCE_PERCENT = 5.0
MAX_DRIFT_N = 0.2
MAX_LOST_PERCENT = 0.1
REST_US = 200_000  # of rest on either side of a ramp that belongs to its record


def list_columns(pins: int) -> tuple[str, ...]:
    """The columns of a record of a device with so many pins."""
    channels = (f"{letter}{pin}_{unit}" for letter, unit in _CHANNELS for pin in range(1, pins + 1))
    return (*_NAMES, *channels)


class Recorder:
    """Writes a session's record; rows are given in one thread, and written in another. Raises `RunError` from
    `sample` or `close`, once the file could not be written (a full disk).
    """

    def __init__(self, file: Path, head: dict[str, Any], pins: int = PINS) -> None:
        self.file = file
        self._lines = [FIRST_LINE, f"#head {json.dumps(head, allow_nan=False)}"]
        self._lines.append(",".join(list_columns(pins)))
        self._rows = self._index = self._crc = 0
        self._failed = ""
        self._finished_blocks: SimpleQueue[bytes | None] = SimpleQueue()
        self._handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        self._close_block()
        self._writer = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._writer.start()

    def sample(self, sample: Sample, host_us: int) -> None:
        channels = (*sample.position_um, *sample.force_mN, *sample.capacitance_fF)
        self._lines.append(
            f"{host_us},{sample.time_us},{sample.number},{sample.flags},{sample.moving},"
            + ",".join(map(str, channels))
        )
        self._rows += 1
        if self._rows >= ROWS_PER_BLOCK:
            self._close_block()

    def event(self, name: str, host_us: int, **facts: Any) -> None:
        """Something that happened; kept with the next block, or at once where it ends one."""
        content = json.dumps({"at_us": host_us, "event": name, **facts}, allow_nan=False)
        self._lines.append(f"#event {content}")

    def close(self) -> None:
        self._close_block()
        self._finished_blocks.put(None)
        self._writer.join()
        if self._failed:
            raise RunError(f"{self.file}: the record is not complete: {self._failed}")

    def _close_block(self) -> None:
        if self._failed:
            raise RunError(f"{self.file}: cannot be written: {self._failed}")
        data = ("\n".join(self._lines) + "\n").encode("ascii")
        self._crc = crc32(data, self._crc)
        self._finished_blocks.put(data + b"#block %d %d %08X\n" % (self._index, len(data), self._crc))
        self._lines, self._rows, self._index = [], 0, self._index + 1

    def _write(self) -> None:
        kept = time.monotonic()
        try:
            while (data := self._finished_blocks.get()) is not None:
                while data:
                    data = data[os.write(self._handle, data) :]
                if time.monotonic() - kept > SYNC_INTERVAL_S:
                    os.fdatasync(self._handle) if hasattr(os, "fdatasync") else os.fsync(self._handle)
                    kept = time.monotonic()
            os.fsync(self._handle)
        except OSError as error:
            self._failed = error.strerror or type(error).__name__
        finally:
            os.close(self._handle)


@dataclass(frozen=True)
class Recording:
    """A record that was read: one row per sample; (n,) or (n, pins) integers in units of `line_protocol`.

    ``lost_bytes`` stand after the last block that is whole.
    """

    head: dict[str, Any]
    events: tuple[dict[str, Any], ...]
    host_us: Indices
    device_us: Indices
    number: Indices
    flags: Indices
    moving: Indices
    position_um: Indices
    force_mN: Indices
    capacitance_fF: Indices
    lost_bytes: int

    def phases(self) -> list[tuple[str, int, int]]:
        """Each phase with the host times (us) at which it began and ended."""
        marks = [(e["phase"], int(e["at_us"])) for e in self.events if e.get("event") == "phase"]
        last = int(self.host_us[-1]) + 1 if self.host_us.size else 0
        ends = [at for _, at in marks[1:]] + [max(last, marks[-1][1] if marks else 0)]
        return [(phase, start, end) for (phase, start), end in zip(marks, ends, strict=True)]


def read_recording(file: str | Path) -> Recording:
    """Read a record, finished or not, up to the last block that is whole. Raises `TraceError` where it is no
    record, or its first block is damaged.
    """
    path = Path(file)
    with add_location(file=path):
        if not path.is_file():
            raise TraceError("no such record")
        if path.stat().st_size > MAX_BYTES:
            raise TraceError(f"larger than {MAX_BYTES:g} bytes")
        data = path.read_bytes()
        blocks = _read_first_block(data)
        whole = _read_whole_blocks(data, blocks)
        return _parse_content(blocks.content + whole.content, len(data) - whole.end)


def follow_recording(file: str | Path, offset: int = 0, *, every: int = 1) -> tuple[Recording, int]:
    """What a record that is being written holds beyond an offset, and the offset to go on from.

    At most `FOLLOWED_BYTES` are read; ``lost_bytes`` are those read that are not a whole block yet. Raises
    `TraceError` where it is no record, no block ends at the offset, or what follows is damaged, not only
    unfinished.

    ``offset``: where a block ends, as an earlier call gave it; 0: from the start. ``every``: only each so
    many-th sample (a divisor of `ROWS_PER_BLOCK`: then they stay even over the calls).
    """
    path = Path(file)
    with add_location(file=path):
        if not path.is_file():
            raise TraceError("no such record")
        with path.open("rb") as stream:
            first = _read_first_block(stream.read(_HEAD_BYTES))
            before = _read_block_before(stream, offset) if offset else first
            stream.seek(before.end)
            data = stream.read(FOLLOWED_BYTES)
        found = _read_whole_blocks(data, replace(before, content=b"", end=0))
        end = before.end + found.end
        if found.is_damaged or (not found.content and len(data) == FOLLOWED_BYTES):
            remedy = "limbfit recording says what can be read of it"
            raise TraceError("this part is damaged", place=f"byte {end}", remedy=remedy)
        # The first block holds the head alone.
        return _parse_content(first.content + found.content, len(data) - found.end, every), end


@dataclass(frozen=True)
class _WholeBlocks:
    """Blocks that are whole: their content, where the last ends, its CRC, and the index of the next."""

    content: bytes
    end: int
    crc: int
    next: int
    is_damaged: bool = False  # what follows is closed, and yet not whole


def _read_first_block(data: bytes) -> _WholeBlocks:
    """The block that holds the head."""
    if not data.startswith(FIRST_LINE.encode()):
        raise TraceError("not a record of limbfit acquire", place="line 1")
    first = _read_whole_blocks(data, _WholeBlocks(b"", 0, 0, 0), most=1)
    if not first.content:
        raise TraceError("its first block is damaged", remedy="nothing can be read from it")
    return first


def _read_block_before(stream: BinaryIO, offset: int) -> _WholeBlocks:
    """What the closing line of the block that ends at an offset says."""
    stream.seek(max(offset - _CLOSING_BYTES, 0))
    line = stream.read(min(offset, _CLOSING_BYTES))
    closing = _CLOSING.fullmatch(line, line.rfind(b"\n", 0, -1) + 1)
    if closing is None:
        raise TraceError("no block ends here", place=f"byte {offset}", remedy="read it anew")
    return _WholeBlocks(b"", offset, int(closing[3], 16), int(closing[1]) + 1)


def _read_whole_blocks(data: bytes, before: _WholeBlocks, most: int = sys.maxsize) -> _WholeBlocks:
    """The blocks after ``before``, which ends at its ``end`` in ``data``, up to one that is not whole."""
    parts: list[bytes] = []
    at, crc, is_damaged = before.end, before.crc, False
    while len(parts) < most and (mark := data.find(b"\n#block ", at)) >= 0:
        part, closing = data[at : mark + 1], _CLOSING.match(data, mark + 1)
        next_crc = crc32(part, crc)
        wanted = (before.next + len(parts), len(part), next_crc)
        if closing is None or (int(closing[1]), int(closing[2]), int(closing[3], 16)) != wanted:
            is_damaged = closing is not None or data.find(b"\n", mark + 1) >= 0
            break
        parts.append(part)
        at, crc = closing.end(), next_crc
    return _WholeBlocks(b"".join(parts), at, crc, before.next + len(parts), is_damaged)


def _parse_content(content: bytes, lost_bytes: int, every: int = 1) -> Recording:
    """Head, events and each ``every``-th sample of whole blocks."""
    head: dict[str, Any] = {}
    events, rows, columns = [], [], len(list_columns(PINS))
    try:
        for line in content.decode("ascii").split("\n"):
            if line.startswith("#head "):
                head = json.loads(line[6:])
            elif line.startswith("#event "):
                events.append(json.loads(line[7:]))
            elif line[:1].isdigit():
                rows.append(line)
            elif line.startswith(_NAMES[0]):
                columns = line.count(",") + 1
        for event in events:
            event["at_us"], event["event"] = int(event["at_us"]), str(event["event"])
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        raise TraceError("it has a line that no record holds") from None
    if not isinstance(head, dict):
        raise TraceError("its head is not a table")
    table = _read_table(rows[every - 1 :: every], columns)
    host_us, device_us, number, flags, moving = table[:, : len(_NAMES)].T
    position, force, capacitance = np.split(table[:, len(_NAMES) :], 3, axis=1)
    series = host_us, device_us, number, flags, moving, position, force, capacitance
    return Recording(head, tuple(events), *series, lost_bytes)


def _read_table(rows: list[str], columns: int) -> Indices:
    if not rows:
        return np.zeros((0, columns), dtype=np.int64)
    try:
        table = np.loadtxt(io.StringIO("\n".join(rows)), delimiter=",", dtype=np.int64, ndmin=2)
    except (ValueError, OverflowError):
        raise TraceError("its rows are not integers in columns") from None
    if table.shape[1] != columns:
        raise TraceError(f"{table.shape[1]} columns instead of {columns}")
    return table


@dataclass(frozen=True)
class Check:
    """One thing that was looked at; ``passed`` is None where there was nothing to judge by."""

    name: str
    passed: bool | None
    found: str
    remedy: str = ""


@dataclass(frozen=True)
class Verdict:
    """All checks; good where none failed."""

    checks: tuple[Check, ...]

    @property
    def is_good(self) -> bool:
        return all(check.passed is not False for check in self.checks)

    def to_dict(self) -> dict[str, Any]:
        return {"good": self.is_good, "checks": [vars(check) for check in self.checks]}


@dataclass(frozen=True)
class RecordedRamp:
    """One ramp of a record, as a trace; ``cycle`` counts from 1, those of preconditioning included."""

    cycle: int
    trace: Trace


def find_ramps(recording: Recording) -> list[RecordedRamp]:
    """The complete ramps of a record: in, held or not, out, and a moment of rest around."""
    pin = int(recording.head["settings"]["pin"]) - 1
    marks = [event for event in recording.events if event["event"] == "phase" and event["phase"] != "hold"]
    found = []
    for load, unload, after in zip(marks, marks[1:], marks[2:]):
        if (load["phase"], unload["phase"]) != ("load", "unload") or after["phase"] == "stopping":
            continue
        start, end = load["at_us"] - REST_US, after["at_us"] + REST_US
        rows = (recording.host_us >= start) & (recording.host_us <= end)
        # The rest around it belongs to a ramp; the way there and the way home do not.
        start_um = int(load.get("start_um", 0))
        position = recording.position_um[rows, pin]
        deepest, far = int(position.argmax()), np.flatnonzero(position < start_um - 50)
        before, beyond = far[far < deepest], far[far > deepest]
        inside = slice(before[-1] + 1 if before.size else 0, beyond[0] if beyond.size else None)
        time = recording.device_us[rows][inside]
        trace = Trace(
            (time - time[0]) / 1e6,
            (position[inside] - start_um) / 1000,
            recording.force_mN[rows, pin][inside] / 1000,
        )
        found.append(RecordedRamp(int(load["cycle"]), trace))
    return found


def check_record(recording: Recording) -> Verdict:
    """Judge the record of a session that came to its end."""
    precondition, repeats = (int(recording.head["settings"][key]) for key in ("precondition", "repeats"))
    counted = [ramp for ramp in find_ramps(recording) if ramp.cycle > precondition]
    found = f"{len(counted)} of {repeats} ramps"
    checks = [
        Check("ramps", len(counted) == repeats, found, "record the site again"),
        *_check_curves(counted, float(recording.head["settings"]["ramp_speed_mm_s"])),
        _check_drift(recording),
        _check_saturation(recording),
        _check_losses(recording),
    ]
    return Verdict(tuple(checks))


def _check_curves(counted: list[RecordedRamp], speed_mm_s: float) -> list[Check]:
    low, high = speed_mm_s * (1.0 - SPEED_TOLERANCE), speed_mm_s * (1.0 + SPEED_TOLERANCE)
    smooth: list[RegularisedCurve] = []
    checks = []
    for ramp in counted:
        try:
            touch = find_touch_down(ramp.trace)
            curve = regularise(ramp.trace, touch)
        except TraceError as error:
            checks.append(Check("touch-down", False, f"none is found: {error.what}", "record the site again"))
            continue
        smooth.append(curve)
        speeds = (curve.speed_load_mm_s, curve.speed_unload_mm_s)
        found = f"{speeds[0]:.3f} mm/s in, {speeds[1]:.3f} mm/s out ({low:.3g} to {high:.3g})"
        remedy = "see acquire.ramp_speed_mm_s, and the device's drive"
        checks.append(Check("speed", all(low <= speed <= high for speed in speeds), found, remedy))
        place, sd = touch.displacement_mm, touch.uncertainty_mm
        found = f"{place:.2f} +- {sd:.2f} mm from the start (at most {MAX_TOUCH_SD_MM:g})"
        remedy = "give the ramps a larger acquire.start_gap_mm, or clean the force sensor"
        checks.append(Check("touch-down", sd <= MAX_TOUCH_SD_MM, found, remedy))
    return [*checks, _check_repeatability(smooth)]


def _check_repeatability(curves: list[RegularisedCurve]) -> Check:
    if len(curves) < 2:
        return Check("repeatability", None, "one ramp: nothing to compare")
    depth = min(curve.depth_mm for curve in curves)
    at = np.linspace(0, depth, 50)
    ways = [
        np.interp(at, c.displacement_mm[: c.peak_index + 1], c.force_N[: c.peak_index + 1]) for c in curves
    ]
    spread = float(np.ptp(ways, axis=0).max() / max(curve.peak_force_N for curve in curves) * 100)
    found = f"ramps differ by up to {spread:.1f} % of the largest force (at most {MAX_DIFFERENCE_PERCENT:g})"
    return Check(
        "repeatability", spread <= MAX_DIFFERENCE_PERCENT, found, "precondition more, or pause longer"
    )


def _check_drift(recording: Recording) -> Check:
    """Compare the test pin's force off the skin before and after."""
    pin = int(recording.head["settings"]["pin"]) - 1
    spans = recording.phases()
    rests = []
    for phase in ("settle", "release"):
        span = next(((a, b) for name, a, b in spans if name == phase), None)
        if span is None:
            return Check("drift", None, "the test pin was not off the skin both before and after")
        rows = (recording.host_us >= span[0]) & (recording.host_us < span[1])
        if not rows.any():
            return Check("drift", None, "no samples off the skin")
        rests.append(float(recording.force_mN[rows, pin].mean()) / 1000)
    drift = rests[1] - rests[0]
    found = f"the force off the skin changed by {drift:+.3f} N (at most {MAX_DRIFT_N:g})"
    return Check("drift", abs(drift) <= MAX_DRIFT_N, found, "let the device warm up, zero its sensors")


def _check_saturation(recording: Recording) -> Check:
    range_mN = int(recording.head["device"]["range_mN"])
    count = int((np.abs(recording.force_mN) >= range_mN).any(axis=1).sum())
    return Check(
        "saturation", count == 0, f"{count} samples at the end of a force sensor's range", "see the sensor"
    )


def _check_losses(recording: Recording) -> Check:
    steps = np.diff(recording.device_us) * (int(recording.head["device"].get("rate_hz", RATE_HZ)) / 1e6)
    lost = int(np.maximum(np.rint(steps) - 1, 0).sum()) if steps.size else 0
    share = 100 * lost / max(len(recording.device_us) + lost, 1)
    found = f"{lost} of {len(recording.device_us) + lost} samples never came"
    return Check(
        "samples", share <= MAX_LOST_PERCENT, found, "see the wire, and what else runs on this machine"
    )
