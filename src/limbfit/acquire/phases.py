"""The protocol as a table: phases, what can come of each, and where that leads."""

from __future__ import annotations

from enum import StrEnum


class Phase(StrEnum):
    """Where a session is."""

    IDLE = "idle"
    POSITION = "position"  # all pins home, the operator puts the limb in place
    CLAMP = "clamp"
    SETTLE = "settle"
    APPROACH = "approach"
    BACK = "back"  # from the skin to the start of the ramps
    READY = "ready"  # waits for the operator's key
    SEARCH = "search"  # the depth search, while the key is held
    RETURN = "return"
    PAUSE = "pause"
    LOAD = "load"
    DWELL = "hold"  # at the deepest point
    UNLOAD = "unload"
    RETRACT = "retract"
    RELEASE = "release"
    DONE = "done"
    STOPPING = "stopping"
    STOPPED = "stopped"
    UNREACHABLE = "unreachable"


class Outcome(StrEnum):
    """How a phase ends."""

    BEGUN = "begun"
    IN_PLACE = "in place"
    FORCES_REACHED = "forces reached"
    SLACKENED = "slackened"
    HELD = "held"
    TOUCHED = "touched"
    AT_START = "at start"
    KEY_HELD = "key held"
    DEPTH_FOUND = "depth found"
    TOO_SHALLOW = "too shallow"
    RESTED = "rested"
    AT_DEPTH = "at depth"
    TO_HOLD = "to hold"
    HELD_OUT = "held out"
    NEXT_CYCLE = "next cycle"
    REST = "rest"
    CYCLES_DONE = "cycles done"
    HOME = "home"
    STOP = "stop"
    RETRACTED = "retracted"
    OUT_OF_REACH = "out of reach"


FINAL = frozenset({Phase.DONE, Phase.STOPPED, Phase.UNREACHABLE})
WAITS_FOR_OPERATOR = frozenset({Phase.POSITION, Phase.READY})
CLAMPED = frozenset(
    {
        Phase.APPROACH,
        Phase.BACK,
        Phase.READY,
        Phase.SEARCH,
        Phase.RETURN,
        Phase.PAUSE,
        Phase.LOAD,
        Phase.DWELL,
        Phase.UNLOAD,
    }
)

_WAY: dict[tuple[Phase, Outcome], Phase] = {
    (Phase.IDLE, Outcome.BEGUN): Phase.POSITION,
    (Phase.POSITION, Outcome.IN_PLACE): Phase.CLAMP,
    (Phase.CLAMP, Outcome.FORCES_REACHED): Phase.SETTLE,
    (Phase.SETTLE, Outcome.SLACKENED): Phase.CLAMP,
    (Phase.SETTLE, Outcome.HELD): Phase.APPROACH,
    (Phase.APPROACH, Outcome.TOUCHED): Phase.BACK,
    (Phase.BACK, Outcome.AT_START): Phase.READY,
    (Phase.READY, Outcome.KEY_HELD): Phase.SEARCH,
    (Phase.SEARCH, Outcome.DEPTH_FOUND): Phase.RETURN,
    (Phase.SEARCH, Outcome.TOO_SHALLOW): Phase.BACK,
    (Phase.RETURN, Outcome.AT_START): Phase.PAUSE,
    (Phase.PAUSE, Outcome.RESTED): Phase.LOAD,
    (Phase.LOAD, Outcome.AT_DEPTH): Phase.UNLOAD,
    (Phase.LOAD, Outcome.TO_HOLD): Phase.DWELL,
    (Phase.DWELL, Outcome.HELD_OUT): Phase.UNLOAD,
    (Phase.UNLOAD, Outcome.NEXT_CYCLE): Phase.LOAD,
    (Phase.UNLOAD, Outcome.REST): Phase.PAUSE,
    (Phase.UNLOAD, Outcome.CYCLES_DONE): Phase.RETRACT,
    (Phase.RETRACT, Outcome.HOME): Phase.RELEASE,
    (Phase.RELEASE, Outcome.HOME): Phase.DONE,
    (Phase.STOPPING, Outcome.RETRACTED): Phase.STOPPED,
    (Phase.STOPPING, Outcome.OUT_OF_REACH): Phase.UNREACHABLE,
}
# A stop is possible everywhere but where it has happened or nothing is left to stop.
TRANSITIONS = _WAY | {
    (phase, Outcome.STOP): Phase.STOPPING for phase in Phase if phase not in FINAL | {Phase.STOPPING}
}
