"""Repair of given surfaces, as scans and atlases need it: one open end is capped, small holes are filled.

Each change is reported in words.

Vocabulary
----------
loop   a closed line of edges that have a face on one side only.
cap    the flat end of a surface that was open: the surface is cut by the plane that fits the loop, moved
       inward to the loop's lowest point, and closed there, so that the cap cannot cross what it closes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import manifold3d
import numpy as np
from numpy.typing import ArrayLike

from ...arrays import Array, Indices
from ...errors import SurfaceError, add_location
from ..grid import format_place
from . import triangles
from .extraction import untangle_surface
from .surfaces import Anatomy, check_anatomy
from .triangles import Surface, open_loops

SMALL_HOLE_MM = 10.0  # a hole that is no wider is filled
SMALL_HOLE_EDGES, SMALL_HOLE_SHARE = 6, 0.02  # so is one of few edges that is a small share of the surface
MAX_TURNED_SHARE = 0.75  # of the faces: a surface of which more look inward is inverted, as a mirrored one
MAX_LOOSE_SHARE = 0.01  # of the faces: open pieces that hold less are left out
MAX_CROSSINGS, MAX_SMOOTHING_MM = 200, 4.0  # pairs of faces that are smoothed until they do not cross
GENTLE_SHARE, FIRM_SHARE = 0.1, 0.5  # of the way to the neighbours' mean, each time
END_SHARE = 0.03  # of the skin's area: a smaller opening, or flat part, is not its proximal end
FLAT_MM = 0.05  # within which a flat end lies in its plane
LEVEL_RAD = 3e-3  # between neighbours in it
MAX_CAP_RATIO = 2.0  # a cap so much larger than the opening cuts through the body
INSIDE_MM = 0.5  # of the loop's lowest point, where the cap lies
JOIN_MM = 1e-6
BELOW_MM = 2.0  # the lowest cap of the proximal end, where the default cut is
PROXIMAL_MM = 25.0  # of the skin's cap: a bone that ends farther below it ends within the limb


@dataclass(frozen=True)
class Cap:
    """Where an open end was closed: the cap's outline (n, 3), LPS mm, and its outward unit normal."""

    outline: Array
    normal: Array


@dataclass(frozen=True)
class RepairReport:
    """A surface after mending, the cap of its open end if it had one, and what was done, in words."""

    surface: Surface
    cap: Cap | None
    notes: tuple[str, ...]


def repair_surface(surface: Surface, name: str) -> RepairReport:
    """A surface whose faces look outward, without loose pieces and small holes, its one open end capped.

    Few crossing faces are smoothed.

    Whatever else keeps it from bounding a body is left for `triangles.check_closed`. Raises `SurfaceError`
    for more than one open loop of notable size, or one whose outline crosses itself.
    """
    surface, loose = _remove_loose_pieces(surface, name)
    surface, turned = orient_outward(surface, name)
    notes = loose + turned
    loops = open_loops(surface)
    small = [loop for loop in loops if _is_small(surface, loop)]
    large = [loop for loop in loops if not _is_small(surface, loop)]
    if len(large) > 1:
        places = " and ".join(format_place(surface.points[loop].mean(axis=0)) for loop in large[:3])
        raise SurfaceError(
            f"{name}: {len(large)} open ends or large holes, at {places}",
            remedy="close all but the proximal end",
        )
    for loop in small:
        surface, area = _fill_hole(surface, loop)
        where = format_place(surface.points[loop].mean(axis=0))
        notes += (f"{name}: a hole of {len(loop)} edges at {where} filled, {area:.1f} mm2",)
    surface, crossing = _smooth_crossings(surface, name)
    notes += crossing
    if not large:
        return RepairReport(surface, None, notes)
    rim = surface.points[large[0]]
    surface, cap, area = _cap_open_end(surface, rim, name)
    note = (
        f"{name}: open at one end, cut flat {np.ptp(rim @ cap.normal) + INSIDE_MM:.1f} mm below its highest "
        f"edge and closed by a cap at {format_place(cap.outline.mean(axis=0))}, {area:.0f} mm2"
    )
    return RepairReport(surface, cap, (*notes, note))


def build_closed_anatomy(
    skin: Surface,
    bones: Mapping[str, Surface],
    cut: tuple[ArrayLike, ArrayLike] | None = None,
    files: Mapping[str, Path] | None = None,
) -> tuple[Anatomy, tuple[str, ...]]:
    """The checked anatomy of given surfaces, mended, and what was mended, in words.

    Raises `SurfaceError` for a surface that cannot be mended, or an anatomy that :func:`check_anatomy`
    refuses.

    Parameters
    ----------
    skin, bones : LPS mm.
    cut : point and proximal normal of the proximal cut; by default just inside the caps of skin and bones,
        across the skin's; of a skin that is closed its flat end, or its highest (z).
    files : by the surfaces' names, for the text of errors.
    """
    files = files or {}
    mended = {}
    for name, surface in {"skin": skin, **bones}.items():
        with add_location(file=files.get(name)):
            mended[name] = repair_surface(surface, name)
    outer, inner = mended.pop("skin"), mended
    found: tuple[str, ...] = ()
    if cut is None:
        cut, found = _choose_default_cut(outer, list(inner.values()))
    closed = {name: part.surface for name, part in inner.items()}
    anatomy = Anatomy(outer.surface, closed, np.asarray(cut[0]), np.asarray(cut[1]))
    check_anatomy(anatomy, files)
    return anatomy, (*(note for part in (outer, *inner.values()) for note in part.notes), *found)


def _choose_default_cut(
    skin: RepairReport, bones: Sequence[RepairReport]
) -> tuple[tuple[Array, Array], tuple[str, ...]]:
    """Point and normal below all caps at the proximal end, so that bones stick out of it; notes on it.

    Of a closed skin it is the plane of its one flat end (of several: of the one that bones reach out of), or
    its highest (z).
    """
    if skin.cap is not None and _compute_area(skin.cap.outline) >= END_SHARE * skin.surface.area:
        normal, middle = skin.cap.normal, skin.cap.outline.mean(axis=0)
        caps = [bone.cap for bone in bones if bone.cap is not None and bone.cap.normal @ normal > 0]
        heights = [((cap.outline - middle) @ normal).min() for cap in (skin.cap, *caps)]
        return (middle + (min(h for h in heights if h > -PROXIMAL_MM) - BELOW_MM) * normal, normal), ()
    ends = find_flat_ends(skin.surface)
    beyond = [
        (point, normal)
        for point, normal in ends
        if any(((bone.surface.points - point) @ normal).max() > FLAT_MM for bone in bones)
    ]
    up = np.array([0.0, 0.0, 1.0])
    chosen = beyond or ends
    if len(chosen) != 1 or chosen[0][1] @ up > 1.0 - 1e-6:
        return (skin.surface.points[:, 2].max() * up, up), ()
    point, normal = chosen[0]
    place = format_place(point)
    note = f"skin: the proximal cut is its flat end at {place}, as geometry.proximal_cut does not say it"
    return (point, normal), (note,)


def find_flat_ends(surface: Surface) -> list[tuple[Array, Array]]:
    """Point and outward unit normal of planes that hold a notable part of a surface, the rest behind."""
    normals, areas, middles = surface.face_normals, surface.face_areas, surface.triangles.mean(axis=1)
    edges = np.sort(triangles.find_half_edges(surface.faces), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(axis=1)
    first, second = order[:-1][same] % len(areas), order[1:][same] % len(areas)
    level = np.einsum("ij,ij->i", normals[first], normals[second]) > np.cos(LEVEL_RAD)
    patch = triangles.number_components(np.column_stack([first[level], second[level]]), len(areas))
    ends = []
    for which in np.flatnonzero(np.bincount(patch, areas) > END_SHARE * surface.area):
        weights = areas * (patch == which)
        normal = weights @ normals / np.linalg.norm(weights @ normals)
        point = weights @ middles / weights.sum()
        inside = ((surface.points - point) @ normal).max() < FLAT_MM
        if inside and np.abs((middles[patch == which] - point) @ normal).max() < FLAT_MM:
            ends.append((point, normal))
    return ends


def orient_outward(surface: Surface, name: str) -> tuple[Surface, tuple[str, ...]]:
    """Turn the faces outward if neighbours are oriented against each other; else change nothing."""
    alike = orient_faces(surface)
    outward = alike.outward_surface
    count = count_turned(surface, outward)
    if alike is surface or count > MAX_TURNED_SHARE * len(surface.faces):
        return surface, ()
    return outward, (f"{name}: {count} of {len(surface.faces)} triangles looked inward and were turned",)


def orient_faces(surface: Surface) -> Surface:
    """Turn all faces to one side, whichever; return the surface itself if they are, or if none is
    possible."""
    if not triangles.has_turned_faces(surface.faces):
        return surface
    faces, patches = igl.bfs_orient(surface.faces)
    return (
        surface if patches.max() > 0 or triangles.has_turned_faces(faces) else Surface(surface.points, faces)
    )


def count_turned(before: Surface, after: Surface) -> int:
    """Count the faces that look the other way."""
    return int((np.einsum("ij,ij->i", before.face_normals, after.face_normals) < 0.0).sum())


def _remove_loose_pieces(surface: Surface, name: str) -> tuple[Surface, tuple[str, ...]]:
    """Leave out small open pieces beside the largest body; a small closed one may be meant and stays."""
    main, *others = triangles.find_bodies(surface)
    few = MAX_LOOSE_SHARE * len(surface.faces)
    loose = [part for part in others if len(part.faces) < few and len(triangles.find_open_edges(part.faces))]
    if not loose:
        return surface, ()
    kept = [main, *(part for part in others if not any(part is piece for piece in loose))]
    count, where = sum(len(part.faces) for part in loose), format_place(loose[0].points.mean(axis=0))
    note = f"{name}: {len(loose)} loose pieces of {count} triangles left out, the first at {where}"
    return triangles.stack_surfaces(kept), (note,)


def _is_small(surface: Surface, loop: Indices) -> bool:
    points = surface.points[loop]
    if np.linalg.norm(np.ptp(points, axis=0)) <= SMALL_HOLE_MM:
        return True
    return len(loop) <= SMALL_HOLE_EDGES and _compute_area(points) < SMALL_HOLE_SHARE * surface.area


def _compute_area_vector(loop: Array) -> Array:
    """Area vector of a loop (n, 3), mm2, against the sense of its faces: it points out of the body."""
    spokes = loop - loop.mean(axis=0)
    return np.asarray(-0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0))


def _compute_area(loop: Array) -> float:
    """Area that a loop (n, 3) spans, mm2."""
    return float(np.linalg.norm(_compute_area_vector(loop)))


def _fill_hole(surface: Surface, loop: Indices) -> tuple[Surface, float]:
    """A small hole closed, by one triangle or a fan about its middle; the area of the fan (mm2)."""
    points, back = surface.points, loop[::-1]
    if len(loop) == 3:
        fan = back[None]
    else:
        points = np.vstack([points, points[loop].mean(axis=0)])
        middle = np.full(len(loop), len(points) - 1)
        fan = np.column_stack([back, np.roll(back, -1), middle])
    area = Surface(points, fan).area
    return Surface(points, np.vstack([surface.faces, fan])), area


def _cap_open_end(surface: Surface, rim: Array, name: str) -> tuple[Surface, Cap, float]:
    """Cut off just inside an open end with the points ``rim`` and closed there; the area of the cap (mm2)."""
    vector = _compute_area_vector(rim)
    normal = vector / np.linalg.norm(vector)
    point = rim.mean(axis=0)
    point = point + (((rim - point) @ normal).min() - INSIDE_MM) * normal
    cut = surface.to_pyvista().clip(normal=normal, origin=point).extract_surface(algorithm="dataset_surface")
    joined = cut.triangulate().clean(tolerance=JOIN_MM, absolute=True).triangulate()
    body = triangles.find_bodies(triangles.from_pyvista(joined))[0]
    loops = open_loops(body)
    faces = _triangulate_loop(body.points, loops[0][::-1], normal) if len(loops) == 1 else None
    if faces is None or Surface(body.points, faces).area > MAX_CAP_RATIO * _compute_area(rim):
        raise SurfaceError(
            f"{name}: its open end at {format_place(rim.mean(axis=0))} cannot be closed by a plane",
            remedy="cut the end off straight, or close it",
        )
    area = Surface(body.points, faces).area
    cap = Cap(body.points[loops[0]], normal)
    return Surface(body.points, np.vstack([body.faces, faces])), cap, area


def _triangulate_loop(points: Array, loop: Indices, normal: Array) -> Indices | None:
    """Faces (n - 2, 3) that fill a flat loop (n,) of points, seen from ``normal``; None where none do."""
    polygon = points[loop]
    along = np.linalg.svd(normal[None])[2][1]
    flat = polygon @ np.column_stack([along, np.cross(normal, along)])
    faces = manifold3d.triangulate([flat]).astype(np.int64)
    # Of a simple outline the triangles' areas add up to that of the outline.
    if not np.isclose(Surface(polygon, faces).area, np.linalg.norm(_compute_area_vector(polygon)), rtol=1e-6):
        return None
    return loop[faces]


def _smooth_crossings(surface: Surface, name: str) -> tuple[Surface, tuple[str, ...]]:
    """Smooth a few crossing faces; a surface that crosses itself more often is left as it is."""
    crossing = surface.self_intersections
    if not 0 < len(crossing) <= MAX_CROSSINGS:
        return surface, ()
    for share in (GENTLE_SHARE, FIRM_SHARE):
        smooth = untangle_surface(surface, share)
        moved = np.linalg.norm(smooth.points - surface.points, axis=1).max()
        if moved <= MAX_SMOOTHING_MM and not len(smooth.self_intersections):
            break
    else:
        return surface, ()
    where = format_place(surface.triangles[crossing[0, 0]].mean(axis=0))
    note = (
        f"{name}: {len(crossing)} pairs of crossing faces, the first at {where}, smoothed by {moved:.1f} mm"
    )
    return smooth, (note,)
