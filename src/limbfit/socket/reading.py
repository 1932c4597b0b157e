"""A socket's inner face from a file, checked against the limb that it shall surround."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from ..anatomy.grid import Frame
from ..anatomy.surfaces.files import read_surface
from ..anatomy.surfaces.mending import count_turned, orient_faces
from ..anatomy.surfaces.triangles import (
    Surface,
    check_sides,
    find_bodies,
    find_half_edges,
    open_loops,
    remove_unused_points,
)
from ..arrays import Indices
from ..errors import SurfaceError, add_location
from .rays import Rays, apply_clearance, compute_profile
from .shape import Socket, refuse_bones

MIN_SIZE_RATIO, MAX_SIZE_RATIO = 0.25, 3.0  # of the limb's length, end to end: otherwise another unit
LOOSE_SHARE = 0.01  # of the faces: pieces that hold less are left out
MIN_COSINE = 0.5  # mean cosine between normals and rays from which a side is certain
WALL_SHARE = 0.15  # of the faces that another face hides, from which a closed surface is a wall


def read_socket(
    file: str | Path,
    unit: str = "mm",
    space: Literal["LPS", "RAS"] | None = None,
    *,
    outer: Surface,
    frame: Frame,
    bones: Mapping[str, Surface] | None = None,
) -> Socket:
    """The socket of a .stl, .ply, .vtp or .obj file, around a limb.

    Of a socket with a wall the inner face is taken, if it can be recognised. A face whose triangles look away
    from the tissue is turned. `Socket.notes` says so.

    Raises `SurfaceError` for a file that is no surface, is in another unit, has holes or no opening, opens
    distally, does not go around the limb, cuts into a bone or crosses itself: each with the remedy.

    Parameters
    ----------
    unit, space : of the file; by default mm and what it says itself, else LPS.
    outer : the limb's closed outer surface (skin, or liner on skin), LPS mm, flat at its proximal cut.
    frame : of the limb.
    bones : closed surfaces, LPS mm, that the socket must leave inside.
    """
    surface = read_surface(file, space, unit, key="socket.space")
    with add_location(file=file):
        return _build_socket(surface, outer, frame, bones or {})


def _build_socket(surface: Surface, outer: Surface, frame: Frame, bones: Mapping[str, Surface]) -> Socket:
    _check_size(surface, outer)
    limb = compute_profile(outer, frame)
    piece, notes = _keep_largest_piece(surface)
    whole = orient_faces(piece)
    if turned := count_turned(piece, whole):
        against = min(turned, len(whole.faces) - turned)
        notes.append(f"{against} of its triangles were oriented against their neighbours and were turned")
    check_sides(whole, "the socket")
    face = Surface(frame.to_limb(whole.points), whole.faces)
    _check_place(face, limb.rays, limb.stations[-1])
    if not len(open_loops(face)):
        if face.volume < 0.0:
            face = face.flipped_surface
            notes.append("its triangles looked into its wall and were turned")
        face, thick = _select_inner_face(face, limb.rays)
        notes.append(f"the inner face of a wall of about {thick:.1f} mm is taken")
    brim, open_distal = _find_brim(face, limb.rays)
    side = _compute_facing(face, limb.rays)
    if side > 0.0:
        face = face.flipped_surface
        brim = brim[::-1]
        notes.append("its triangles looked away from the tissue and were turned")
    crossing = face.self_intersections
    if len(crossing):
        raise SurfaceError(
            f"the socket crosses itself ({len(crossing)} pairs of faces)",
            remedy="remesh, smooth or repair it",
        )
    refuse_bones(
        Surface(frame.to_patient(face.points), face.faces),
        brim,
        frame,
        bones,
        remedy="check its unit and its place on the limb; a socket is larger than the bones in it",
    )
    clear = frame.to_patient(apply_clearance(face.points, face.faces, limb, outer, frame))
    return Socket(frame.to_patient(face.points), face.faces, clear, brim, open_distal, tuple(notes))


def _check_size(surface: Surface, outer: Surface) -> None:
    size, limb = (float(np.linalg.norm(np.ptp(s.points, axis=0))) for s in (surface, outer))
    if not MIN_SIZE_RATIO * limb <= size <= MAX_SIZE_RATIO * limb:
        unit = "metres, centimetres or inches" if size < limb else "another unit"
        raise SurfaceError(
            f"the socket is {size:.3g} mm from end to end, the limb {limb:.0f} mm",
            remedy=f"if it is in {unit}, say so (socket.unit)",
        )


def _keep_largest_piece(surface: Surface) -> tuple[Surface, list[str]]:
    parts = find_bodies(surface)
    loose = [part for part in parts[1:] if len(part.faces) < LOOSE_SHARE * len(surface.faces)]
    if len(parts) - len(loose) > 1:
        raise SurfaceError(
            f"the socket's file holds {len(parts) - len(loose)} separate pieces",
            remedy="keep the inner face alone in it",
        )
    return parts[0], [f"{len(loose)} loose pieces were left out"] if loose else []


def _check_place(face: Surface, rays: Rays, top: float) -> None:
    """Refuse what is not around the limb's middle line, or lies beside it."""
    middle = face.points.mean(axis=0)
    axis = rays.middle(np.clip(middle[2] - rays.centre_z, rays.bottom, top))
    apart = np.hypot(*(middle - axis)[:2])
    radius = float(np.median(np.linalg.norm((face.points - middle)[:, :2], axis=1)))
    beyond = max(middle[2] - rays.centre_z - top, rays.bottom + rays.centre_z - middle[2], 0.0)
    if apart > radius or beyond > 0.0:
        raise SurfaceError(
            f"the socket does not surround the limb: its middle is {max(apart, beyond):.0f} mm off",
            remedy="give it in the limb's space (socket.space: LPS or RAS), where the limb is in it",
        )


def _compute_facing(face: Surface, rays: Rays) -> float:
    """Compute the mean cosine between the faces' normals and the rays through them, by area."""
    angle, station, _ = rays.coordinates(face.triangles.mean(axis=1))
    cosine = np.einsum("ij,ij->i", face.face_normals, rays.direction(angle, station))
    mean = float(np.average(cosine, weights=face.face_areas))
    if abs(mean) < MIN_COSINE:
        raise SurfaceError(
            "the socket's triangles look both at the limb and away from it",
            remedy="keep the inner face alone, its normals all on one side",
        )
    return mean


def _find_brim(face: Surface, rays: Rays) -> tuple[Indices, bool]:
    """Find the proximal edge, and whether the distal end is open too."""
    around, holes = list[Indices](), list[Indices]()
    for loop in open_loops(face):
        angle = rays.coordinates(face.points[loop])[0]
        steps = np.mod(np.diff(angle, append=angle[0]) + np.pi, 2 * np.pi) - np.pi
        (around if round(float(steps.sum()) / (2 * np.pi)) else holes).append(loop)
    if holes:
        raise SurfaceError(
            f"the socket has a hole of {len(holes[0])} edges in its side",
            remedy="close it; only brim and end may be open",
        )
    if not around or len(around) > 2:
        raise SurfaceError(
            f"{len(around)} edges of the socket go around the limb", remedy="leave it open at the brim alone"
        )
    heights = [float(face.points[loop, 2].mean()) for loop in around]
    if max(heights) < face.points[:, 2].mean():
        raise SurfaceError(
            "the socket opens towards the distal end of the limb and is closed above",
            remedy="turn it around, or open it at the brim",
        )
    return around[int(np.argmax(heights))], len(around) == 2


def _select_inner_face(wall: Surface, rays: Rays) -> tuple[Surface, float]:
    """Select the faces of a closed wall that the middle line sees; also return its median thickness, mm."""
    middles = wall.triangles.mean(axis=1)
    angle, station, radius = rays.coordinates(middles)
    hits = wall.find_ray_hits(rays.middle(station), rays.direction(angle, station))
    first = np.array([met[0] if len(met) else np.inf for met in hits])
    facing = np.einsum("ij,ij->i", wall.face_normals, rays.direction(angle, station)) < 0.0
    is_inner = facing & (np.abs(first - radius) < 1e-2)
    if is_inner.sum() < WALL_SHARE * len(is_inner) or (~is_inner).sum() < WALL_SHARE * len(is_inner):
        raise SurfaceError(
            "the socket is closed: it has no opening for the limb", remedy="cut it open at the brim"
        )
    thick = float(np.median([met[1] - met[0] for met, s in zip(hits, is_inner) if s and len(met) > 1]))
    inner = find_bodies(remove_unused_points(Surface(wall.points, wall.faces[is_inner])))[0]
    inner = _remove_ears(inner)
    if len(inner.faces) < 0.9 * is_inner.sum():
        raise SurfaceError(
            "which of the socket's faces are its inner side cannot be told",
            remedy="delete the outer side of its wall, and give the inner face alone",
        )
    return inner, thick


def _remove_ears(surface: Surface) -> Surface:
    """Remove faces that hang on by one edge or a corner, so that the edge is one clean line."""
    faces = surface.faces
    while True:
        edges = np.sort(find_half_edges(faces), axis=1)
        _, inverse, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        alone = (counts[inverse.ravel()] == 1).reshape(3, -1).sum(axis=0)
        if not (alone >= 2).any():
            return find_bodies(remove_unused_points(Surface(surface.points, faces)))[0]
        faces = faces[alone < 2]
