"""Checks of a session's record, made while the limb is still in the device."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Indices
from ..errors import TraceError
from ..traces import Regularised, Trace, find_touch_down, regularise
from .events import PERIOD_US
from .recording import Recording

SPEED_TOLERANCE = 0.5 / 0.96  # of the ramp's speed; paper, section 2.1.2: 0.96 +- 0.5 mm/s
MAX_TOUCH_SD_MM = 0.3
MAX_DIFFERENCE_PERCENT = 5.0
MAX_DRIFT_N = 0.2
MAX_LOST_PERCENT = 0.1
REST_US = 200_000  # of rest on either side of a ramp that belongs to its record


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
        inside = _find_near_rows(position, start_um)
        time = recording.device_us[rows][inside]
        trace = Trace(
            (time - time[0]) / 1e6,
            (position[inside] - start_um) / 1000,
            recording.force_mN[rows, pin][inside] / 1000,
        )
        found.append(RecordedRamp(int(load["cycle"]), trace))
    return found


def _find_near_rows(position: Indices, start_um: int) -> slice:
    """Rows from the last that is far before the deepest to the first that is far after it."""
    deepest = int(position.argmax())
    far = np.flatnonzero(position < start_um - 50)
    before, after = far[far < deepest], far[far > deepest]
    return slice(int(before[-1]) + 1 if before.size else 0, int(after[0]) if after.size else len(position))


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
    smooth: list[Regularised] = []
    checks = []
    for ramp in counted:
        try:
            touch = find_touch_down(ramp.trace)
            curve = regularise(ramp.trace, touch)
        except TraceError as error:
            checks.append(Check("touch-down", False, f"none is found: {error.what}", "record the site again"))
            continue
        smooth.append(curve)
        checks += [_check_speed(curve, speed_mm_s), _check_touch(touch.displacement_mm, touch.uncertainty_mm)]
    return [*checks, _check_repeatability(smooth)]


def _check_speed(curve: Regularised, stated_mm_s: float) -> Check:
    low, high = stated_mm_s * (1.0 - SPEED_TOLERANCE), stated_mm_s * (1.0 + SPEED_TOLERANCE)
    speeds = (curve.speed_load_mm_s, curve.speed_unload_mm_s)
    found = f"{speeds[0]:.3f} mm/s in, {speeds[1]:.3f} mm/s out ({low:.3g} to {high:.3g})"
    remedy = "see acquire.ramp_speed_mm_s, and the device's drive"
    return Check("speed", all(low <= speed <= high for speed in speeds), found, remedy)


def _check_touch(place_mm: float, uncertainty_mm: float) -> Check:
    found = f"{place_mm:.2f} +- {uncertainty_mm:.2f} mm from the start (at most {MAX_TOUCH_SD_MM:g})"
    remedy = "give the ramps a larger acquire.start_gap_mm, or clean the force sensor"
    return Check("touch-down", uncertainty_mm <= MAX_TOUCH_SD_MM, found, remedy)


def _check_repeatability(curves: list[Regularised]) -> Check:
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
    steps = np.diff(recording.device_us)
    lost = int(np.maximum(np.rint(steps / PERIOD_US) - 1, 0).sum()) if steps.size else 0
    share = 100 * lost / max(len(recording.device_us) + lost, 1)
    found = f"{lost} of {len(recording.device_us) + lost} samples never came"
    return Check(
        "samples", share <= MAX_LOST_PERCENT, found, "see the wire, and what else runs on this machine"
    )
