"""Rectification: the inner face of a socket from the outer surface of a limb and a recipe.

The brim runs where planes and a closed line cross the limb's meridians. The face consists of even triangles
between rings of points around the limb.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from ..anatomy.grid import Frame, format_place
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array, Indices
from ..errors import SurfaceError
from .pressing import Area
from .rays import FOLD_MM, LimbProfile, Offsets, apply_clearance, compute_profile
from .shape import Socket

MIN_FACE_MM = 30.0  # of face between the distal end and the brim, along the limb
MAX_OFF_LIMB_MM = 30.0  # how far a point of a trimline may lie off the limb
FLARE_DEGREES = 60.0  # how far the brim turns outwards
FLARE_ROWS = 3
MIN_RING_POINTS = 6
DISTAL_SHARE = 1.0  # of the end's radius: over what height the clearance at the distal end fades out
MATCHING_ROUNDS, VOLUME_SHARE = 5, 1e-3  # of finding the reduction that leaves a volume
# Of that height: the largest clearance, so that no part of the face moves past another.
MAX_CLEARANCE_SHARE = 0.75


@dataclass(frozen=True)
class Trim:
    """The brim: below every plane, and below the line where there is one.

    Attributes
    ----------
    planes : points and normals (3,), LPS; normals point proximally.
    line : (k, 3) points of a closed line around the limb, LPS mm, on the limb or near it, in order.
    """

    planes: Sequence[tuple[Array, Array]] = ()
    line: Array | None = None

    def __post_init__(self) -> None:
        if not self.planes and self.line is None:
            raise SurfaceError("a socket without a trimline", remedy="state a plane or a line")


@dataclass(frozen=True, eq=False)
class TrimmedLimb:
    """The limb's meridians (limb frame) from the distal pole to the brim.

    Attributes
    ----------
    meridians : (angles, k, 3) points, from the pole on.
    ways : (angles, k) their lengths from the pole, mm.
    length : (angles,) of each up to the brim, mm.
    brim_station : (angles,) the station of the brim.
    """

    meridians: Array
    ways: Array
    length: Array
    brim_station: Array

    def find_points(self, way: Array) -> Array:
        """(angles, 3) the point of each meridian this far (angles,) from the pole."""
        rows = np.arange(len(way))
        after = np.clip((self.ways < way[:, None]).sum(axis=1), 1, self.ways.shape[1] - 1)
        low, high = self.ways[rows, after - 1], self.ways[rows, after]
        share = ((way - low) / (high - low))[:, None]
        return np.asarray((1 - share) * self.meridians[rows, after - 1] + share * self.meridians[rows, after])


def trim_limb(limb: LimbProfile, frame: Frame, trim: Trim) -> TrimmedLimb:
    """Cut the meridians of a limb at its trimline. Raises `SurfaceError` where the brim would lie beyond the
    limb's proximal cut, at its distal end, or a line does not go once around the limb.
    """
    stations, angles = limb.stations, limb.angles
    points = limb.rays.points(angles[:, None], stations[None, :], limb.radius.T)
    points[:, 0] = points[:, 0].mean(axis=0)  # one pole
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=2)
    ways = np.append(np.zeros((len(angles), 1)), np.cumsum(lengths, axis=1), axis=1)
    over = np.max(_measure_above_trimline(points, angles, limb, frame, trim), axis=0)
    after = np.argmax(over > 0.0, axis=1)
    rows = np.arange(len(angles))
    missed = ~(over > 0.0).any(axis=1)
    if missed.any():
        raise SurfaceError(
            f"the brim would lie beyond the limb's proximal cut on {100 * missed.mean():.0f} % of its way",
            remedy="move the trimline down, or the proximal cut up",
        )
    low, high = over[rows, after - 1], over[rows, after]
    share = np.where(after > 0, -low / (high - low), 0.0)
    length = ways[rows, after - 1] + share * (ways[rows, after] - ways[rows, after - 1])
    short = (after == 0) | (length < MIN_FACE_MM)
    if short.any():
        raise SurfaceError(
            f"the brim comes within {max(float(length[short].min()), 0.0):.0f} mm of the distal end, "
            f"and a socket needs {MIN_FACE_MM:g} mm of face",
            remedy="move the trimline up"
            + ("; the normals of its planes point proximally" * bool(trim.planes)),
        )
    station = stations[after - 1] + share * (stations[after] - stations[after - 1])
    return TrimmedLimb(points, ways, length, station)


def find_brim(limb: LimbProfile, frame: Frame, trim: Trim, count: int) -> Array:
    """Find points (count, 3) of the limb where the brim runs, evenly around it, LPS mm.

    Errors are those of `trim_limb`.
    """
    trimmed = trim_limb(limb, frame, trim)
    return frame.to_patient(trimmed.find_points(trimmed.length)[np.arange(count) * len(limb.angles) // count])


def wrap_trimline(limb: LimbProfile, frame: Frame, points: Array) -> Array:
    """Put points (k, 3), such as those of a trimline, on the limb along their rays, LPS mm."""
    angle, station, _ = limb.rays.coordinates(frame.to_limb(points))
    return frame.to_patient(limb.rays.points(angle, station, limb.find_radius(angle, station)))


def _measure_above_trimline(
    points: Array, angles: Array, limb: LimbProfile, frame: Frame, trim: Trim
) -> list[Array]:
    """Measure how far points (angles, k, 3) lie over each part of the trimline, mm."""
    heights = []
    for point, normal in trim.planes:
        direction = frame.rotation @ np.asarray(normal, dtype=float)
        if direction[2] <= 0.0:
            raise SurfaceError(
                "the normal of a trim plane points distally", remedy="turn it so that it points proximally"
            )
        heights.append((points - frame.to_limb(point)) @ (direction / np.linalg.norm(direction)))
    if trim.line is not None:
        height = _interpolate_line(frame.to_limb(trim.line), limb)
        heights.append(points[..., 2] - height(angles)[:, None])
    return heights


def _interpolate_line(points: Array, limb: LimbProfile) -> PchipInterpolator:
    """Interpolate the height of a closed line (k, 3) over the angle around the limb."""
    if np.array_equal(points[0], points[-1]):  # some state the end of a closed line, too
        points = points[:-1]
    angle, station, radius = limb.rays.coordinates(points)
    off = np.abs(radius - limb.find_radius(angle, station))
    if off.max() > MAX_OFF_LIMB_MM:
        raise SurfaceError(
            f"point {int(off.argmax()) + 1} of the trimline lies {off.max():.0f} mm off the limb",
            remedy="give points on the limb (LPS, mm)",
        )
    steps = np.mod(np.diff(angle, append=angle[0]) + np.pi, 2 * np.pi) - np.pi
    sign = np.sign(steps.sum())
    if len(points) < 3 or sign == 0 or np.any(sign * steps <= 0) or abs(abs(steps.sum()) - 2 * np.pi) > 0.1:
        raise SurfaceError(
            "the trimline does not go once around the limb", remedy="give its points in order around the limb"
        )
    order = np.argsort(angle)
    turns = np.concatenate([angle[order] + turn for turn in (-2 * np.pi, 0.0, 2 * np.pi)])
    return PchipInterpolator(turns, np.tile(points[order, 2], 3))


@dataclass(frozen=True)
class Recipe:
    """How a limb's shape becomes a socket's.

    Attributes
    ----------
    trim : where the brim runs.
    reduction_percent : by how much every circumference is less than the limb's.
    areas : pressed in or relieved besides.
    flare_mm : radius of the brim's rounding outwards; 0: none.
    distal : ``"clearance"`` leaves ``distal_clearance_mm`` free under the limb's end, ``"bearing"`` does not.
    edge_mm : edge length of the triangles.
    offsets : moves along the limb's rays, instead of the reduction.
    """

    trim: Trim
    reduction_percent: float = 3.0
    areas: Sequence[Area] = ()
    flare_mm: float = 6.0
    distal: Literal["clearance", "bearing"] = "clearance"
    distal_clearance_mm: float = 5.0
    edge_mm: float = 4.0
    offsets: Offsets | None = None


@dataclass(frozen=True, eq=False)
class SocketSurface:
    """Triangles on the limb; of each point how far it lies below the brim along the limb, mm, and the unit
    vector towards it.
    """

    points: Array
    faces: Indices
    below_brim: Array
    upwards: Array
    brim: Indices


def rectify_limb(outer: Surface, frame: Frame, recipe: Recipe) -> Socket:
    """Make the inner face of a socket for a limb.

    Raises `SurfaceError` where the limb is folded or its end is no end, the brim leaves the limb, an area
    misses it, or the face would fold: each with the remedy.

    Parameters
    ----------
    outer : the limb's closed outer surface (skin, or liner on skin), LPS mm, flat at its proximal cut.
    frame : of the limb, whose z axis points proximally from the cut.
    recipe : what is done to the shape.
    """
    limb = compute_profile(outer, frame)
    lines = trim_limb(limb, frame, recipe.trim)
    _refuse_folds(limb, lines, frame)
    surface = _draw_surface(lines, recipe)
    face = Surface(frame.to_patient(surface.points), surface.faces)
    recipe = replace(recipe, areas=[area.project_to(face) for area in recipe.areas])
    points = frame.to_patient(_rectify_points(surface, limb, frame, recipe))
    _refuse_crossing(Surface(points, surface.faces), recipe)
    clear = frame.to_patient(apply_clearance(frame.to_limb(points), surface.faces, limb, outer, frame))
    return Socket(points, surface.faces, clear, surface.brim)


def reduce_to_volume(volume_mm3: float, outer: Surface, frame: Frame, recipe: Recipe) -> tuple[Socket, float]:
    """Find the face without areas whose uniform reduction leaves a volume, and that reduction in percent.

    The volume is met within ``VOLUME_SHARE``. Raises `SurfaceError` as `rectify_limb`.
    """
    plain = replace(recipe, areas=(), offsets=None)
    reductions = [plain.reduction_percent]
    roots: list[float] = []  # of volumes: nearly linear in the reduction
    for _ in range(MATCHING_ROUNDS):
        face = rectify_limb(outer, frame, replace(plain, reduction_percent=reductions[-1]))
        roots.append(face.volume_mm3**0.5)
        short = volume_mm3**0.5 - roots[-1]
        if abs(short) < 0.5 * VOLUME_SHARE * roots[-1]:
            break
        if len(roots) == 1:
            slope = -roots[-1] / (100.0 - reductions[-1])
        else:
            slope = (roots[-1] - roots[-2]) / (reductions[-1] - reductions[-2])
        reductions.append(reductions[-1] + short / slope)
    return face, reductions[len(roots) - 1]


def _refuse_folds(limb: LimbProfile, lines: TrimmedLimb, frame: Frame) -> None:
    inside = limb.stations[:, None] <= lines.brim_station[None, :]
    folds = np.where(inside, limb.folds, 0.0)
    if folds.max() > FOLD_MM:
        k, j = np.unravel_index(np.argmax(folds), folds.shape)
        at = frame.to_patient(limb.rays.points(limb.angles[j], limb.stations[k], limb.radius[k, j]))
        raise SurfaceError(
            f"the limb is folded by {folds.max():.1f} mm at {format_place(at, 0)}, and a socket is "
            "drawn on rays from its middle line",
            remedy="smooth the fold, trim below it, or give the socket as a file",
        )


def _draw_surface(lines: TrimmedLimb, recipe: Recipe) -> SocketSurface:
    """Draw rings of even triangles between the distal pole and the brim; the last rows are the flare's."""
    flare = np.radians(FLARE_DEGREES) * recipe.flare_mm
    lengths = lines.length
    rows = max(4, round(float(lengths.mean() - flare) / recipe.edge_mm))
    shares = np.linspace(0.0, 1.0, rows + 1)[1:, None] * (lengths - flare)
    if flare:
        shares = np.vstack(
            [shares, lengths - flare + flare * np.arange(1, FLARE_ROWS + 1)[:, None] / FLARE_ROWS]
        )
    rings, at = [lines.meridians[0, :1]], [np.zeros(1)]
    below, up = [np.array([lengths.mean()])], [np.zeros((1, 3))]
    for number, way in enumerate(shares):
        dense = lines.find_points(way)
        closed = np.vstack([dense, dense[:1]])
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))
        share, count = length / length[-1], max(MIN_RING_POINTS, round(length[-1] / recipe.edge_mm))
        where = (np.arange(count) + 0.5 * (number % 2)) / count  # of every other ring half a step on
        at.append(where)
        rings.append(CubicSpline(share, closed, bc_type="periodic")(where))
        upwards = lines.find_points(way + 3.0) - lines.find_points(way - 3.0)
        upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
        fields = np.column_stack([lengths - way, upwards])
        values = [np.interp(where, share[:-1], field, period=1.0) for field in fields.T]
        below.append(values[0])
        up.append(np.column_stack(values[1:]))
    faces = _join_rings(at)
    count = sum(len(ring) for ring in rings)
    brim = np.arange(count - len(rings[-1]), count)
    return SocketSurface(np.vstack(rings), faces, np.concatenate(below), np.vstack(up), brim)


def _rectify_points(surface: SocketSurface, limb: LimbProfile, frame: Frame, recipe: Recipe) -> Array:
    """Rectify the drawn points (limb frame); distances add up along the limb's own normals."""
    points = surface.points
    normals = -Surface(points, surface.faces).vertex_normals
    middle = limb.rays.middle(points[:, 2] - limb.rays.centre_z)
    middle[:, 2] = points[:, 2]
    moves = -0.01 * recipe.reduction_percent * (points - middle)
    if recipe.offsets is not None:
        moves = recipe.offsets.moves(points)
    in_patient = frame.to_patient(points)
    for area in recipe.areas:
        moves -= area.depth(in_patient)[:, None] * normals
    if recipe.distal == "clearance":
        moves[:, 2] -= recipe.distal_clearance_mm * _compute_distal_share(points[:, 2], limb, recipe)
    return points + moves + _compute_flare(surface, normals, recipe.flare_mm)


def _compute_distal_share(z: Array, limb: LimbProfile, recipe: Recipe) -> Array:
    """(n,) share of the distal clearance at heights: 1 at the pole, 0 from the end's height on, smooth."""
    height = DISTAL_SHARE * limb.rays.end_radius
    if recipe.distal_clearance_mm > MAX_CLEARANCE_SHARE * height / 1.875:
        raise SurfaceError(
            f"a distal clearance of {recipe.distal_clearance_mm:g} mm is too much at this end of the limb",
            remedy=f"state {MAX_CLEARANCE_SHARE * height / 1.875:.0f} mm or less",
        )
    t = np.clip((z - z.min()) / height, 0.0, 1.0)
    return 1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t**2)  # slope and curvature are zero at both ends


def _compute_flare(surface: SocketSurface, normals: Array, radius: float) -> Array:
    """Moves (n, 3) that bend what is near the brim along an arc outwards; lengths along it stay."""
    if radius == 0.0:
        return np.zeros_like(normals)
    beyond_brim = np.maximum(np.radians(FLARE_DEGREES) * radius - surface.below_brim, 0.0)
    turned = beyond_brim / radius
    out = normals - np.einsum("ij,ij->i", normals, surface.upwards)[:, None] * surface.upwards
    length = np.linalg.norm(out, axis=1, keepdims=True)
    out = np.divide(out, length, out=np.zeros_like(out), where=length > 0)
    return radius * (
        (1.0 - np.cos(turned))[:, None] * out + (np.sin(turned) - turned)[:, None] * surface.upwards
    )


def _refuse_crossing(face: Surface, recipe: Recipe) -> None:
    crossing = face.self_intersections
    if not len(crossing):
        return
    place = face.triangles[crossing[0, 0]].mean(axis=0)
    near = min(recipe.areas, key=lambda area: float(area.relative_distance(place)), default=None)
    remedy = "lower reduction_percent or flare_mm"
    if near is not None:
        remedy = f"lower the depth of {near.name!r} or make it wider"
    raise SurfaceError(f"the socket's face would cross itself at {format_place(place, 0)}", remedy=remedy)


def _join_rings(shares: Sequence[Array]) -> Indices:
    """Triangles between rings whose points lie at these shares of each; the first ring is a point.

    Points are numbered one ring after the other. Seen from inside, where shares grow clockwise about the
    upward axis from without, the triangles run counter-clockwise.
    """
    starts = np.cumsum([len(ring) for ring in shares])
    around = np.arange(len(shares[1]))
    faces = [np.column_stack([np.zeros_like(around), 1 + around, 1 + np.roll(around, -1)])]
    for (first, lower), (second, upper) in pairwise(zip(starts, shares[1:])):
        a, b = len(lower), len(upper)
        # Both rings are walked at once: the one whose next point comes first goes on to it.
        ends = np.concatenate([lower[1:], lower[:1] + 1.0, upper[1:], upper[:1] + 1.0])
        is_lower = np.argsort(ends, kind="stable") < a
        i: Indices = np.cumsum(is_lower) - is_lower
        j: Indices = np.arange(a + b) - i
        ahead = np.where(is_lower, first + (i + 1) % a, second + (j + 1) % b)
        faces.append(np.column_stack([first + i % a, second + j % b, ahead]))
    return np.vstack(faces)
