"""The operator's settings of a session, as a study states them."""

from __future__ import annotations

from dataclasses import dataclass

from .events import PINS


@dataclass(frozen=True)
class Settings:
    """Speeds mm/s, forces N, lengths mm, times s; documented with the study's table ``[acquire]``."""

    pin: int
    clamp_N: float
    clamp_tolerance_N: float
    clamp_speed_mm_s: float
    settle_s: float
    approach_speed_mm_s: float
    touch_N: float
    start_gap_mm: float
    search_speed_mm_s: float
    search_force_N: float
    search_depth_mm: float
    min_depth_mm: float
    pause_s: float
    precondition: int
    repeats: int
    ramp_speed_mm_s: float
    hold_s: float
    retract_speed_mm_s: float
    force_limit_N: float
    clamp_limit_N: float
    depth_limit_mm: float
    speed_limit_mm_s: float
    time_limit_s: float
    operator_limit_s: float
    watchdog_ms: float
    key_gap_ms: float

    @property
    def withdrawn(self) -> tuple[int, ...]:
        """The two neighbours of the test pin, which stay off the skin so that it can bulge."""
        return tuple((self.pin - 1 + step) % PINS + 1 for step in (-1, 1))

    @property
    def clamps(self) -> tuple[int, ...]:
        """The pins that hold the limb."""
        return tuple(pin for pin in range(1, PINS + 1) if pin != self.pin and pin not in self.withdrawn)

    @property
    def cycles(self) -> int:
        """Ramps in all, those of preconditioning included."""
        return self.precondition + self.repeats


def to_thousandths(value: float) -> int:
    """mm as um, N as mN, s as ms: a thousandth."""
    return round(1000 * value)
