"""The operator: a key that is held, seen through a terminal; or nobody."""

from queue import SimpleQueue

from .events import Abort, Event, Signal
from .protocol import Phase
from .session import PhaseUpdate, Update

FIRST_REPEAT_S = 0.75  # a keyboard waits before a held key repeats


class Keyboard:
    """Characters of a terminal to events: Enter confirms, the space bar is the key, anything else stops.

    A terminal tells of no release: a key that is held repeats, one that is released does not. The key counts
    as held from its second character on, so that a touch moves nothing, and as released once ``gap_s`` has
    passed without another.
    """

    def __init__(self, gap_s: float) -> None:
        self.gap_s = gap_s
        self.is_held = False
        self._last: float | None = None

    def read(self, characters: bytes, now: float) -> list[Event]:
        found: list[Event] = []
        for one in characters:
            if one in b"\r\n":
                found.append(Signal.CONFIRM)
            elif one == 0x20:
                before, self._last = self._last, now
                if not self.is_held and before is not None and now - before <= FIRST_REPEAT_S:
                    self.is_held = True
                    found.append(Signal.KEY_DOWN)
            else:
                found.append(Abort("the operator stopped it by a key"))
        return found

    def check_release(self, now: float) -> list[Event]:
        """The release of the key, reported once; ask often."""
        if self._last is None or not self.is_held or now - self._last <= self.gap_s:
            return []
        self.is_held, self._last = False, None
        return [Signal.KEY_UP]


class NoOperator:
    """No operator: the limb counts as in place, and the key as held until the search ends by itself."""

    def __init__(self, events: SimpleQueue[Event]) -> None:
        self.events = events
        self._has_searched = False

    def __call__(self, update: Update) -> None:
        if not isinstance(update, PhaseUpdate):
            return
        if update.phase == Phase.POSITION:
            self.events.put(Signal.CONFIRM)
        elif update.phase == Phase.READY and self._has_searched:  # it would end there again, and again
            reason = "the depth search ended at acquire.search_force_N before acquire.min_depth_mm"
            self.events.put(Abort(f"{reason}; change one of them"))
        elif update.phase == Phase.READY:
            self._has_searched = True
            self.events.put(Signal.KEY_DOWN)
