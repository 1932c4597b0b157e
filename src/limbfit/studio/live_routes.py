"""The session that is being recorded, read from its record while it is written; nothing is commanded here."""

import math
import re
import time
from pathlib import Path
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Query
from pydantic import BaseModel, ValidationError

from ..acquire import Recording, follow_recording
from ..acquire.protocol import FINAL
from ..acquire.recording import Check
from ..errors import TraceError
from ..pipeline.commands.acquire import FOLDER as ACQUIRED
from ..pipeline.commands.acquire import RECORD, VERDICT
from .folder import Json, resolve_inside
from .study_routes import Folder

router = APIRouter(prefix="/api/live")
SAMPLE_STRIDE = 5  # samples: 100 a second
SILENT_S = 3.0  # blocks come every 50 ms: a record that has not grown for so long is not being written
RECENT_S = 600.0  # a session that ended longer ago is not shown by itself
Offset = Annotated[int, Query(ge=0, le=1 << 40)]
_STAMP = re.compile(r"[0-9]{8}T[0-9]{6}\.[0-9]{3}")
_PENDING = 1 << 16  # bytes: more than is written between two requests
_MAX_VERDICT = 1 << 20


class StoredVerdict(BaseModel):
    """A stored verdict; ``trace`` is the file of the site's record, None where the session made none."""

    good: bool
    checks: list[Check]
    trace: str | None = None


@router.get("")
def get_session(folder: Folder) -> Json:
    """The newest session that is being recorded, else the newest that ended lately; null if none."""
    begun = (folder.folder / ACQUIRED).glob(f"*/*/{RECORD}")
    files = [file for file in begun if _STAMP.fullmatch(file.parent.name)]
    recent = [(age, file.parent) for file in files if (age := _compute_age(file)) < RECENT_S]
    if not recent:
        return {"session": None}
    _, newest = max(recent, key=lambda session: (session[0] < SILENT_S, session[1].name))
    return {"session": {"site": newest.parent.name, "time": newest.name}}


@router.get("/{site}/{stamp}")
def get_part(folder: Folder, site: str, stamp: str, offset: Offset = 0) -> Json:
    """What the record of a session holds beyond ``offset`` (bytes), at most half a minute of it.

    Times in s of limbfit's clock, positions in mm from the pin's home, forces in N, of the test pin.
    ``offset`` is where to go on, at once where ``more`` is true; ``age_s`` is how long ago the record grew.
    """
    file = resolve_inside(folder.folder, ACQUIRED, site, stamp, RECORD)
    age = _compute_age(file)
    part, following = follow_recording(file, offset, every=SAMPLE_STRIDE)
    return {
        "site": site,
        "time": stamp,
        "offset": following,
        "more": file.stat().st_size - following > _PENDING,
        "age_s": age,
        "silent": age > SILENT_S,
        **_read(part, file, first=offset == 0),
        "verdict": _read_verdict(file.with_name(VERDICT)),
    }


def _compute_age(file: Path) -> float:
    return max(time.time() - file.stat().st_mtime, 0.0)


def _read(part: Recording, file: Path, first: bool) -> Json:
    try:
        settings = part.head["settings"]
        pin = range(part.position_um.shape[1])[int(settings["pin"]) - 1]
        limit_N = float(settings["force_limit_N"])
        ramps = int(settings["precondition"]) + int(settings["repeats"])
        phases = [_describe_phase(event) for event in part.events if event["event"] == "phase"]
        if not math.isfinite(limit_N):
            raise ValueError
    except (KeyError, TypeError, ValueError, IndexError, OverflowError):
        raise TraceError("its head or its events lack what a session has", file=file) from None
    ended = [phase for phase in phases if phase["phase"] in FINAL]
    return {
        "head": {"pin": pin + 1, "force_limit_N": limit_N, "ramps": ramps} if first else None,
        "phases": phases,
        "ended": ended[-1] if ended else None,
        "time_s": _shorten(part.host_us / 1e6),
        "position_mm": _shorten(part.position_um[:, pin] / 1e3),
        "force_N": _shorten(part.force_mN[:, pin] / 1e3),
    }


def _describe_phase(event: Json) -> Json:
    touch = event.get("touch_um")
    return {
        "at_s": event["at_us"] / 1e6,
        "phase": str(event["phase"]),
        "cycle": int(event["cycle"]),
        "touch_mm": None if touch is None else int(touch) / 1e3,
        "reason": str(event.get("reason", "")),
    }


def _read_verdict(file: Path) -> Json | None:
    if not file.is_file():
        return None
    try:
        if file.stat().st_size > _MAX_VERDICT:
            raise ValueError
        return StoredVerdict.model_validate_json(file.read_bytes()).model_dump()
    except (ValidationError, ValueError):
        raise TraceError("not a verdict of limbfit acquire", file=file) from None


def _shorten(values: np.ndarray) -> list[float]:
    return np.round(values, 4).tolist()
