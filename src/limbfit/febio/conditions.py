"""What drives a problem, written as FEBio's load curves, rigid conditions and steps of the analysis."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from ..arrays import Array, Mask
from ..errors import ProblemError
from ..fe import Motion
from .reading.rigid import FREEDOMS, find_straight_line, has_same_rotation

FIXED_SET = "held"
FRAME_BODY = "frame"  # the rigid body that rails are fixed to


@dataclass(frozen=True)
class WrittenCurve:
    """A load curve: ``points (n, 2)``, time in s and value."""

    name: str
    interpolate: str
    points: Array


class CurveList(list[WrittenCurve]):
    """The load curves of a file; `add` gives a curve its number."""

    def add(self, name: str, points: Array, interpolate: str = "LINEAR") -> int:
        """Add points (n, 2), time in s and value; return the number of the curve."""
        self.append(WrittenCurve(name, interpolate, points))
        return len(self)


def to_space(name: str, motion: Motion, frame: Array) -> Motion:
    """Return a body's motion along and about the axes of space, from that in its ``frame (3, 3)``.

    Raises `ProblemError` if a force drives it along, or about, an axis between those of space, because
    FEBio holds and drives along its own; if it turns about several axes, grows, or leaves a force open.
    """
    if motion.grows:
        raise ProblemError(f"{name}: a body that grows is not written for FEBio, which has none")
    if np.isnan(motion.values).any():
        raise ProblemError(
            f"{name}: a force that takes over what held the body is not written for FEBio",
            remedy="state the force, as Result.reactions tell it",
        )
    turn, forced = np.kron(np.eye(2), frame), np.asarray(motion.forced)
    own = forced.copy()
    for block in (slice(0, 3), slice(3, 6)):
        mixed = forced[:, block].any(axis=1) & ~forced[:, block].all(axis=1)
        if not mixed.any():
            continue
        main = np.abs(frame).argmax(axis=0)  # of each axis of space, that of the frame
        if not np.allclose(np.abs(frame[main, range(3)]), 1.0, atol=1e-12):
            raise ProblemError(
                f"{name}: a force along an axis that lies between x, y and z is not written for FEBio",
                remedy="turn the problem first (limbfit.febio.turn_to_indenter_frame)",
            )
        own[:, block] = forced[:, block][:, main]
    values = motion.values @ turn
    values[:, :3] = np.where(np.abs(values[:, :3]) < 1e-15 * np.abs(values).max(), 0.0, values[:, :3])
    if not has_same_rotation(values, own):
        raise ProblemError(
            f"{name}: a turn about several axes is not written for FEBio, which adds it up another way"
        )
    return Motion(motion.times, values, own)


def find_rail(motion: Motion, frame: Array) -> Array | None:
    """Return the direction (3,) along which a rail guides a body, or None for any other motion.

    A rail is needed if nothing but a force drives the body, along one axis of its ``frame (3, 3)`` that lies
    between the axes of space.
    """
    (own,) = np.nonzero(motion.free)
    if len(own) != 1 or own[0] > 2 or motion.grows or np.isnan(motion.values).any():
        return None
    along = np.asarray(frame[own[0]])
    askew = not np.isclose(np.abs(along).max(), 1.0, rtol=0.0, atol=1e-12)
    return along if askew and not np.delete(motion.values, own[0], axis=1).any() else None


def to_rail_motion(motion: Motion, along: Array) -> Motion:
    """Return the motion in space of a body guided ``along (3,)`` by a rail, which bears all but the force."""
    values = np.zeros((len(motion.times), 6))
    values[:, :3] = motion.values[:, :3].sum(axis=1)[:, None] * along
    under = np.asarray(np.asarray(motion.forced).any(axis=1))
    return Motion(motion.times, values, under[:, None].repeat(6, axis=1))


def find_step_ends(motions: Iterable[Motion], end: float, settled: float = 0.0) -> list[float]:
    """Return the times at which FEBio must begin another step, s, and the end.

    These are the times at which the kind of drive changes, and at which pre-strained tissue has ``settled``.
    """
    found = {end} | ({settled} if settled else set())
    for motion in motions:
        times = np.asarray(motion.times)
        found |= {float(t) for t in times[1:][np.diff(times) == 0.0] if t < end}
    return sorted(found)


def list_conditions(
    name: str, motion: Motion, ends: list[float], curves: CurveList
) -> list[list[dict[str, Any]]]:
    """List the conditions of a rigid body in every step, from its motion in space, for the template."""
    steps: list[list[dict[str, Any]]] = []
    for begin, end in pairwise([0.0, *ends]):
        label = name if len(ends) == 1 else f"{name}_{len(steps) + 1}"
        conditions = _list_step_conditions(label, *_cut_motion(motion, begin, end), curves)
        steps.append([{"body": name, "label": label, **one} for one in conditions])
    return steps


def _cut_motion(motion: Motion, begin: float, end: float) -> tuple[Array, Array, Mask]:
    """Return times (k,), values (k, 6) and drives of a motion between two ends of steps."""
    times = np.asarray(motion.times)
    inner = times[(times > begin) & (times < end)]
    # Of two values at the start of a step the later one holds, at its end the earlier.
    last = int(np.searchsorted(times, begin, side="right")) - 1
    first = motion.values[last] if times[last] == begin else motion.at(begin)[0]
    values = np.array([first, *(motion.at(t)[0] for t in inner), motion.at(end)[0]])
    return np.array([begin, *inner, end]), values, motion.at(end)[1]


def _list_step_conditions(
    label: str, times: Array, values: Array, forced: Mask, curves: CurveList
) -> Iterator[dict[str, Any]]:
    moving = np.asarray(values.any(axis=0))
    free = forced | moving
    if not free.all():
        yield {"kind": "rigid_fixed", "held": dict(zip(FREEDOMS, ~free))}
    on_line = None if forced.any() else find_straight_line(Motion(times - times[0], values))
    if on_line is not None:  # one curve, and its share along each axis
        direction, advance = on_line
        number = curves.add(f"{label}_advance", np.column_stack([times, advance]))
        for i in np.flatnonzero(direction):
            share = float(direction[i])
            yield {"kind": "rigid_displacement", "freedom": FREEDOMS[i], "curve": number, "factor": share}
        return
    for i in np.flatnonzero(moving):
        turn, letter = i > 2, FREEDOMS[i]
        kind = ("rigid_displacement", "rigid_rotation", "rigid_force", "rigid_moment")[2 * forced[i] + turn]
        number = curves.add(f"{label}_{kind[6:]}_{letter}", np.column_stack([times, values[:, i]]))
        yield {"kind": kind, "freedom": letter, "curve": number, "factor": 1.0}
