"""Shapes as slices around an axis: AOP files, by which programs of prosthetists exchange limbs and sockets.

The layout (docs/fabrication.md) is that of the readers of ampscan (Steer et al., JOSS 2020, 02060), with its
example, and of aaop-utils (J. Watt, 2018).  These count spokes in opposite senses: ampscan clockwise, seen
from the proximal end, until the last looks along -y; aaop-utils the other way from x on.  limbfit writes as
ampscan reads, and a comment says so with the frame, so that a shape comes back where it was.
"""

import re
from collections.abc import Sequence
from typing import Literal

import numpy as np

from ...arrays import Array, Indices
from ...errors import SurfaceError
from ..grid import Frame, build_limb_frame, format_place
from .triangles import Surface, close_by_fans, open_loops

Sense = Literal["clockwise", "counter-clockwise"]
TOLERANCE_MM = 0.1
SPOKES, SLICE_MM = 360, 1.0
MAX_ROUNDS = 5  # of closer slices
GOES_ON_MM = 1.0  # above the brim a flare goes on so far
MAX_VALUES = 20_000_000
MIN_LENGTH_MM, MAX_LENGTH_MM = 10.0, 3000.0  # of a shape: otherwise another unit
MAX_GAP = 3.0  # between spokes, of the mean
_END_MM = 0.05  # the height of the second slice; steps grow from there, as a round end asks for
_LEVEL_MM = 0.02  # above the lowest point: what is as low
_FRAME = "LIMBFIT FRAME LPS mm, clockwise:"
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.I)


def read_slices(text: str, sense: Sense | None = None) -> tuple[Surface, bool]:
    """The surface of an AOP file, open proximally, and whether the file says where it lies (LPS, mm).

    Without that the origin is on the axis at the distal end, and z is proximal. Raises `SurfaceError` for
    another layout, with the line at fault, and for an unstated sense of the spokes.
    """
    lines = [line.strip() for line in re.split("\r\n|\r|\n", text)]
    at = lines.index("END COMMENTS") + 1 if "END COMMENTS" in lines else len(lines)
    if not lines[0].startswith("AAOP") or lines[at : at + 1] != ["CYLINDRICAL"]:
        what = "no AOP file: AAOP1, END COMMENTS and CYLINDRICAL are not there in this order"
        raise SurfaceError(what, remedy="export it again as AAOP1, cylindrical")
    comments, at = lines[:at], at + 2

    def take(what: str, count: int = 1, least: float = 0.0) -> Array:
        nonlocal at
        words = [line.partition(" ")[0] for line in lines[at : at + count]]
        values = np.array([float(word) if _NUMBER.fullmatch(word) else np.nan for word in words])
        fine = (values >= least) & (values <= MAX_VALUES)
        if not fine.all() or len(words) < count:
            at += int(np.append(fine, False).argmin())
            text = repr(lines[at][:20]) if at < len(lines) else "the end of the file"
            raise SurfaceError(f"{text} instead of {what}", place=f"line {at + 1}", remedy="export it again")
        at += count
        return values

    def take_ladder(what: str) -> Array:
        """So many values: one by one after a zero, or by their step."""
        count, step = int(take(f"the number of {what}", least=2.0)[0]), take(f"the step of {what}")[0]
        return step * np.arange(count) if step else take(f"{what}, {count} in all", count, -np.inf)

    for _ in range(int(take("the number of landmarks")[0])):
        at += 1  # its name
        take("a landmark's place", 3 * int(take("the number of a landmark's points")[0]), -np.inf)
    frame = next((_parse_frame(line) for line in comments if line.startswith(_FRAME)), None)
    if sense is None and frame is None:
        raise SurfaceError(
            "does not say in which sense its spokes are counted, and the wrong one mirrors the shape",
            remedy="state it: limbfit shapes convert --spokes clockwise, or counter-clockwise",
        )
    turns, heights = take_ladder("spokes"), take_ladder("slices")
    is_turned = sense == "counter-clockwise" and frame is None
    angles = np.mod(turns if is_turned else -90.0 - turns[1] - turns, 360.0)
    order = np.argsort(angles)
    gaps = np.diff(angles[order], append=angles[order[0]] + 360.0)
    stated = f"a radius in mm, {len(heights)} slices of {len(turns)} in all"
    radii = take(stated, len(heights) * len(turns)).reshape(len(heights), -1)
    is_even = gaps.min() > 0.0 and gaps.max() < MAX_GAP * gaps.mean() and (np.diff(heights) > 0.0).all()
    if not is_even or any(lines[at:]):
        what = "spokes do not go around once, slices do not rise from the end, or more lines follow"
        raise SurfaceError(what, remedy="export it again")
    surface = _build_rings(np.radians(angles[order]), heights, radii[:, order])
    return (Surface(frame.to_patient(surface.points), surface.faces), True) if frame else (surface, False)


def _parse_frame(line: str) -> Frame:
    words = line.removeprefix(_FRAME).split()
    values = np.array([float(word) if _NUMBER.fullmatch(word) else np.nan for word in words])
    turn = values[3:].reshape(3, 3) if len(values) == 12 else np.zeros((3, 3))
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.isnan(values).any():
        raise SurfaceError(f"its comment {_FRAME!r} is broken", remedy="delete that line, or export it again")
    return Frame(turn, values[:3])


def _build_rings(angles: Array, heights: Array, radii: Array) -> Surface:
    """The outward surface of radii (slices, spokes) at ascending angles (rad) and heights."""
    count, around = radii.shape
    up = np.broadcast_to(heights[:, None], radii.shape)
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles), up], axis=-1)
    here = np.arange((count - 1) * around).reshape(-1, around)
    there = np.roll(here, -1, axis=1)
    halves = [here, there, there + around], [here, there + around, here + around]
    return Surface(points.reshape(-1, 3), np.vstack([np.stack(h, axis=-1).reshape(-1, 3) for h in halves]))


def format_slices(
    surface: Surface, proximal: Array, side: str = "NONE", tolerance_mm: float = TOLERANCE_MM
) -> tuple[str, float]:
    """An AOP file of a surface across an axis through its distal end, and how far it deviates at most, mm.

    Above an open brim the radii go on straight, as those of a positive model above the trim line. Raises
    `SurfaceError` for a surface that is open elsewhere, or that slices cannot hold within the tolerance, as
    one that is not star-shaped about the axis.

    Parameters
    ----------
    proximal : (3,) unit vector along the axis.
    side : of the limb: LEFT, RIGHT or NONE.
    """
    loops, height = open_loops(surface), surface.points @ proximal
    if not MIN_LENGTH_MM < np.ptp(height) < MAX_LENGTH_MM:
        raise SurfaceError(f"it is {np.ptp(height):.3g} mm long", remedy="state its unit (--unit)")
    if len(loops) > 1 or any(height[loop].min() < np.median(height) for loop in loops):
        what = f"the surface has {len(loops)} open ends or holes" if loops[1:] else "it opens distally"
        raise SurfaceError(what, remedy="close all but its proximal end, or state --proximal")
    middle = surface.points[height < height.min() + _LEVEL_MM].mean(axis=0)
    frame = build_limb_frame(middle + (height.min() - middle @ proximal) * proximal, proximal)
    samples = np.vstack([surface.points, surface.triangles.mean(axis=1)])
    samples = samples[samples @ proximal < height.max() - _END_MM]  # a flat end is in no slice
    local = Surface(frame.to_limb(surface.points), surface.faces)
    heights, radii = _choose_slices(local, loops, frame.to_limb(samples), tolerance_mm)
    stated = " ".join(f"{value:.9g}" for value in (*frame.origin, *frame.rotation.ravel()))
    head = ["AAOP1", "AAOP1", "Made by limbfit; no medical device", f"{_FRAME} {stated}", "END COMMENTS"]
    head += ["CYLINDRICAL", side, "0", f"{SPOKES}", f"{360.0 / SPOKES:g}", f"{len(heights)}", "0"]
    text = "\n".join([*head, *(f"{value:.3f}" for value in (*heights, *radii.ravel())), ""])
    apart = np.sqrt(close_by_fans(read_slices(text)[0]).find_nearest(samples)[0])
    if (worst := float(apart.max())) > tolerance_mm:
        raise SurfaceError(
            f"slices deviate by {worst:.2f} mm at {format_place(samples[apart.argmax()])}, more than "
            f"{tolerance_mm:g} mm: AOP holds one skin around one axis",
            remedy="give a wall's inner face, state --proximal or --body, or allow more (--tolerance-mm)",
        )
    return text, worst


def _choose_slices(
    local: Surface, loops: Sequence[Indices], samples: Array, tolerance: float
) -> tuple[Array, Array]:
    """Heights (k,) and radii (k, SPOKES): closer slices where a surface along z asks for them."""
    length = float(local.points[:, 2].max()) - _LEVEL_MM  # below a flat end
    ramp = _END_MM * np.arange(round(SLICE_MM / _END_MM / 2)) ** 2
    rest = np.linspace(ramp[-1], length, max(2, round((length - ramp[-1]) / SLICE_MM)))
    added, heights, radii = np.round(np.concatenate([ramp, rest[1:]]), 3), np.zeros(0), np.zeros((0, SPOKES))
    angles = np.radians(-90.0 - 360.0 / SPOKES * np.arange(1, SPOKES + 1))
    for _ in range(MAX_ROUNDS):
        heights, radii = np.append(heights, added), np.vstack([radii, _measure_radii(local, angles, added)])
        order = np.argsort(heights)
        heights, radii = heights[order], radii[order]
        full = _fill_radii(heights, radii, angles, [local.points[loop] for loop in loops])
        rings = _build_rings(angles[::-1], heights, full[:, ::-1])
        apart = np.sqrt(close_by_fans(rings).find_nearest(samples)[0])
        above = np.searchsorted(heights, samples[apart > tolerance / 2, 2])
        above = np.unique(above[(above > 0) & (above < len(heights))])
        low, high = heights[above - 1], heights[above]
        added = np.round((low + high)[high - low > _END_MM] / 2, 3)
        if not len(added) or apart.max() > SLICE_MM:  # no slice would help
            break
    return heights, full


def _measure_radii(local: Surface, angles: Array, heights: Array) -> Array:
    """Radii (k, SPOKES) at which rays across z leave a surface for good; NaN where they never meet it."""
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(SPOKES)], axis=-1)
    starts = np.repeat(np.column_stack([np.zeros((len(heights), 2)), heights]), SPOKES, axis=0)
    hits = local.find_ray_hits(starts, np.tile(ways, (len(heights), 1)))
    return np.array([met[-1] if len(met) else np.nan for met in hits]).reshape(-1, SPOKES)


def _fill_radii(heights: Array, radii: Array, angles: Array, brims: Sequence[Array]) -> Array:
    """Radii with a closed distal end, which go on above a brim (k, 3) as they end there, then straight up."""
    filled, end, edge = radii.copy(), np.full(SPOKES, np.inf), np.zeros(SPOKES)
    filled[0] = 0.0
    for brim in brims:
        turn = np.arctan2(brim[:, 1], brim[:, 0])
        end = np.interp(angles, turn, brim[:, 2], period=2 * np.pi)
        edge = np.interp(angles, turn, np.hypot(brim[:, 0], brim[:, 1]), period=2 * np.pi)
    filled[heights[:, None] > end] = np.nan
    for j, column in enumerate(filled.T):
        known = np.flatnonzero(~np.isnan(column))
        if len(known) < 3:
            raise SurfaceError("the surface does not go around its axis", remedy="state --proximal")
        top = known[-1]
        column[:top] = np.interp(heights[:top], heights[known], column[known])
        rise, out = heights[top] - heights[top - 1], column[top] - column[top - 1]
        if _LEVEL_MM < end[j] - heights[top] < np.inf:
            rise, out = end[j] - heights[top], edge[j] - column[top]
        higher = np.minimum(heights[top + 1 :] - heights[top], rise + GOES_ON_MM)
        column[top + 1 :] = column[top] + out / rise * higher
    return filled
