"""The phases of an indentation: what the indenter does, told from its displacement alone.

Vocabulary
----------
approach  before the skin is met.
load      the indenter advances; two rates in a row are two phases.
hold      it stays where it is; a creep of micrometres is no advance.
unload    it goes back.

Any number of them follow one another, as in cycles. Everything that asks where loading ends asks here: the
largest of many values that are equal but for noise or creep may lie anywhere in a hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from .arrays import Array

Kind = Literal["approach", "load", "hold", "unload"]

# Of the points of a record those of its holds beside the others, and the power of its number that a point's
# time in a hold goes with.
_HELD, DENSER = 0.375, 2.5
SHARE = 0.005  # of the travel: a smaller change is none


@dataclass(frozen=True)
class MotionPhase:
    """What the indenter does from ``start_s`` to ``end_s``, and where it was then, mm."""

    kind: Kind
    start_s: float
    end_s: float
    start_mm: float
    end_mm: float

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s

    @property
    def rate_mm_s(self) -> float:
        """Mean speed, mm/s; negative on the way out."""
        return (self.end_mm - self.start_mm) / self.duration_s

    def later(self, seconds: float) -> MotionPhase:
        """The same, with times that count from so much earlier."""
        return replace(self, start_s=self.start_s + seconds, end_s=self.end_s + seconds)


def choose_tolerance_mm(displacement: Array) -> float:
    """The change of displacement (n,), mm, that counts as none: half a percent of the travel."""
    return SHARE * float(np.ptp(displacement))


def find_phases(
    times: Array, displacement: Array, *, tolerance: float | None = None
) -> tuple[MotionPhase, ...]:
    """The phases of a displacement: corners of a broken line, or as many samples as one likes.

    The displacement is reduced to the fewest straight pieces that follow it to the tolerance; a piece that
    changes it by no more than that is a hold. Noise of samples must be far smaller (a broken line is fitted
    to a record first, in ``traces.displacement``).

    ``times``, ``displacement``: (n,) s, growing, and mm, with n > 1. ``tolerance``: mm that count as nothing;
    ``choose_tolerance_mm`` by default.
    """
    times, displacement = np.asarray(times, dtype=float), np.asarray(displacement, dtype=float)
    allowed = choose_tolerance_mm(displacement) if tolerance is None else tolerance
    corners = _find_corners(times, displacement, allowed)
    found: list[MotionPhase] = []
    for a, b in pairwise(corners):
        start, end = float(displacement[a]), float(displacement[b])
        kind: Kind = "hold" if abs(end - start) <= allowed else "load" if end > start else "unload"
        piece = MotionPhase(kind, float(times[a]), float(times[b]), start, end)
        if found and piece.kind == found[-1].kind == "hold":
            piece = replace(found.pop(), end_s=piece.end_s, end_mm=piece.end_mm)
        found.append(piece)
    return tuple(found)


def find_loading_end(phases: Sequence[MotionPhase]) -> MotionPhase | None:
    """The loading that first reaches the largest displacement, to the tolerance; None where nothing advances.

    Its end is the peak that people mean: what creeps on afterwards is the hold.
    """
    ends = np.array([value for phase in phases for value in (phase.start_mm, phase.end_mm)])
    enough = ends.max() - choose_tolerance_mm(ends)
    return next((phase for phase in phases if phase.kind == "load" and phase.end_mm >= enough), None)


def find_way_in(phases: Sequence[MotionPhase]) -> MotionPhase | None:
    """The loading with which the first advance ends, holds and other rates before it; None where none is.

    An advance of less than a tenth of the travel that is taken back is not counted.
    """
    ends = np.array([value for phase in phases for value in (phase.start_mm, phase.end_mm)])
    enough = ends.min() + 0.1 * float(np.ptp(ends))
    last: MotionPhase | None = None
    for phase in phases:
        if phase.kind == "load":
            last = phase
        elif phase.kind == "unload" and last is not None:
            if last.end_mm >= enough:
                return last
            last = None
    return last


def find_boundaries(phases: Sequence[MotionPhase]) -> Array:
    """Times (k,) s at which phases begin or end: the kinks of the displacement, both its ends among them."""
    return np.array([phases[0].start_s, *(phase.end_s for phase in phases)])


def spread(phases: Sequence[MotionPhase], points: int, among: Array | None = None) -> Array:
    """About ``points`` times (k,) s, evenly over the phases, their boundaries and all ``among`` included.

    A phase that is short beside the others has ten steps nevertheless, or its part of half of the points.
    Holds have times of their own, the denser the nearer to their start: most of what relaxes does so there.
    """
    holds = sum(phase.kind == "hold" for phase in phases)
    moving = sum(phase.duration_s for phase in phases if phase.kind != "hold")
    least = min(10, max(points // (2 * len(phases)), 2))
    grid = [np.array([phases[0].start_s])]
    for phase in phases:
        a, b = phase.start_s, phase.end_s
        inner = np.array([]) if among is None else among[(among > a) & (among < b)]
        if phase.kind == "hold":
            count = max(round(_HELD * points / holds), 2 * least)
            part = a + (b - a) * (np.arange(1, count + 1) / count) ** DENSER
            grid.append(np.union1d(part, inner))
            continue
        steps = max(round((points - 1) * (b - a) / moving), least)
        for start, end in pairwise(np.r_[a, inner, b]):
            count = max(round(steps * (end - start) / (b - a)), 2)
            grid.append(np.linspace(start, end, count + 1)[1:])
    return np.concatenate(grid)


def describe_phases(phases: Sequence[MotionPhase]) -> str:
    """The phases from touch-down on as people say them, cycles that repeat within 5 % counted."""
    for length in range(1, len(phases) // 2 + 1):
        cycles = len(phases) // length
        if cycles * length == len(phases) and all(
            _is_alike(a, b) for a, b in zip(phases, phases[length:], strict=False)
        ):
            return f"{cycles} cycles of {', '.join(map(_describe_phase, phases[:length]))}"
    return ", ".join(map(_describe_phase, phases))


def _is_alike(one: MotionPhase, other: MotionPhase) -> bool:
    """Whether two phases are the same part of two cycles: the first one's way is from touch-down."""
    if one.kind != other.kind:
        return False
    a, b = (phase.duration_s if phase.kind == "hold" else phase.rate_mm_s for phase in (one, other))
    return abs(a - b) <= 0.05 * abs(a)


def _describe_phase(phase: MotionPhase) -> str:
    if phase.kind == "hold":
        return f"hold for {phase.duration_s:.3g} s"
    return f"{phase.kind} at {abs(phase.rate_mm_s):.3g} mm/s"


def _find_corners(times: Array, values: Array, allowed: float) -> list[int]:
    """Indices of the fewest samples between which straight lines follow all others to ``allowed``.

    Split where the misfit is largest (Douglas and Peucker, Cartographica 10, 1973, here along the
    displacement), then leave out what later corners have made unnecessary.
    """
    corners, open_pieces = {0, len(times) - 1}, [(0, len(times) - 1)]
    while open_pieces:
        a, b = open_pieces.pop()
        miss = _compute_misfit(times, values, a, b)
        if miss.size and miss.max() > allowed:
            middle = a + 1 + int(np.argmax(miss))
            corners.add(middle)
            open_pieces += [(a, middle), (middle, b)]
    kept = sorted(corners)
    while len(kept) > 2:
        without = [_compute_misfit(times, values, a, b).max() for a, b in zip(kept, kept[2:])]
        least = int(np.argmin(without))
        if without[least] > allowed:
            break
        del kept[least + 1]
    return kept


def _compute_misfit(times: Array, values: Array, a: int, b: int) -> Array:
    """How far the samples between two are from the straight line through those, mm."""
    inside = slice(a + 1, b)
    straight = np.interp(times[inside], [times[a], times[b]], [values[a], values[b]])
    return np.abs(values[inside] - straight)
