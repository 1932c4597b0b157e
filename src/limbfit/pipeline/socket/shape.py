"""The socket of a study: its table ``[socket]`` and a limb's anatomy to a face around that limb."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...anatomy.surfaces.surfaces import Anatomy
from ...anatomy.surfaces.triangles import Surface
from ...arrays import Array
from ...errors import StudyError, SurfaceError
from ...laws import FIBRED
from ...socket import Area, Recipe, Socket, read_socket, rectify_limb
from ...socket.landmarks import (
    STANDARD_LOADS,
    SkinRegion,
    build_default_regions,
    build_stated_region,
    find_directions,
    find_load_point,
    find_top,
)
from ...socket.pressing import Target
from ...socket.rectify import Trim
from ...socket.shape import refuse_bones
from ...socket.wall import build_wall
from ...study import Study
from ...study.socket import SocketLoadTable

LINER = "liner"  # its name among the tissues
BELOW_KNEE_MM = 10.0  # of the top of the tibia: the brim, where nothing is stated
BELOW_CUT_MM = 30.0  # of the proximal cut, where no tibia ends below that
# Edges of a limb's mesh under a socket whose face is no larger than this; larger ones have as many edges.
EDGE_MM, FACE_MM2 = 10.0, 8e4


def build_socket(study: Study, anatomy: Anatomy, outer: Surface) -> Socket:
    """The study's socket around a limb: read from its file, or rectified from the limb.

    Raises `StudyError` with the key and the remedy.

    ``anatomy``: of the limb. ``outer``: the closed surface that the socket touches, skin or liner on skin;
    flat at the same proximal cut. Around the bare skin, a rectified face may come nearer to the bones by the
    liner's thickness.
    """
    table, frame = study.socket, anatomy.frame
    with place_errors(study):
        if table.file is not None:
            return read_socket(
                study.path(table.file), table.unit, table.space, outer=outer, frame=frame, bones=anatomy.bones
            )
        regions = build_regions(study, anatomy)
        areas = []
        for area in table.areas:
            if area.position is None:
                name = area.region or ""
                check_regions(study, [name], f"socket.areas.{area.name}.region", regions)
            position = regions[name].position if area.position is None else np.array(area.position)
            areas.append(Area(area.name, position, area.radius_mm, area.depth_mm))
        socket = rectify_limb(outer, frame, replace(build_recipe(study, anatomy), areas=areas))
        refuse_bones(
            socket.surface,
            socket.brim,
            frame,
            anatomy.bones,
            remedy="lower reduction_percent, or the depths of the areas there",
            spare_mm=table.liner.thickness_mm if outer is anatomy.skin else 0.0,
        )
        return socket


def mesh_edge_mm(study: Study, socket: Socket) -> float:
    """Edge length of the limb's mesh under a socket: as stated, else 10 mm, and longer under a large socket.

    A factorisation costs about the fourth power of the number of edges along a limb, and a thigh has up to
    three times the skin of a shank: so it has as many elements, not elements of the same size.
    """
    stated = study.socket.edge_mm
    return EDGE_MM * max(1.0, socket.surface.area / FACE_MM2) ** 0.5 if stated is None else stated


def build_recipe(study: Study, anatomy: Anatomy) -> Recipe:
    """The study's rectification but for its areas."""
    table = study.socket
    return Recipe(
        trim=trim_of(study, anatomy),
        reduction_percent=table.reduction_percent,
        flare_mm=table.flare_mm,
        distal=table.distal,
        distal_clearance_mm=table.distal_clearance_mm,
        edge_mm=table.face_edge_mm,
    )


def trim_of(study: Study, anatomy: Anatomy) -> Trim:
    """Where the brim runs: as stated, else a plane across the limb below the knee or the proximal cut."""
    table = study.socket
    planes = [(np.array(plane.point), np.array(plane.normal)) for plane in table.trim_planes]
    line = np.array(table.trimline) if table.trimline else None
    if planes or line is not None:
        return Trim(planes, line)
    top = find_top(anatomy, "tibia")
    below = BELOW_CUT_MM if top is None else BELOW_KNEE_MM
    height = 0.0 if top is None else float(anatomy.height(top).max())
    height -= below if table.trim_mm is None else table.trim_mm
    return Trim([(anatomy.cut_point + height * anatomy.cut_normal, anatomy.cut_normal)])


def build_regions(study: Study, anatomy: Anatomy) -> dict[str, SkinRegion]:
    """Named regions of the skin: those of any limb, and the study's own, which win."""
    known = find_directions(anatomy, study.socket.side)
    regions = build_default_regions(anatomy, known)
    with place_errors(study):
        for one in study.socket.regions:
            regions[one.name] = build_stated_region(anatomy, one.name, np.array(one.position), one.radius_mm)
    return regions


def check_regions(study: Study, names: Sequence[str], place: str, known: Collection[str]) -> None:
    """Raise `StudyError` for a region that is named and not among the ``known`` ones, with those."""
    wrong = next((name for name in names if name not in known), None)
    if wrong is not None:
        what, remedy = f"no region is named {wrong!r}", f"there are {', '.join(known)}"
        raise StudyError(what, file=study.file, place=place, remedy=remedy)


def load_of(
    study: Study, load: SocketLoadTable, anatomy: Anatomy, socket: Socket
) -> tuple[Array, Array, Array]:
    """Force (3,) N and moment (3,) N mm on the socket about a point (3,) mm, all LPS.

    Raises `StudyError` where the knee centre or the side of the limb must be known and is not.
    """
    check_load(study, load, anatomy.bones, find_top(anatomy, "tibia") is None)
    brim = socket.points[socket.brim]
    point = find_load_point(anatomy, brim) if load.point is None else np.array(load.point)
    if load.preset is None:
        return np.array(load.force_N), np.array(load.moment_Nmm), point
    standard, weight = STANDARD_LOADS[load.preset], study.socket.body_weight_N
    with place_errors(study):
        known = find_directions(anatomy, study.socket.side)
        return standard.force(weight, known), standard.moment(weight, known), point


def check_load(study: Study, load: SocketLoadTable, bones: Collection[str], is_cut: bool = False) -> None:
    """That what a preset needs is known of a limb whose bones have these names.

    The proximal cut may go through the tibia, so that its top is not there. Raises `StudyError` where the
    knee centre or the side of the limb must be known and is not.
    """
    if load.preset is None:
        return
    standard, place = STANDARD_LOADS[load.preset], f"socket.loads.{load.name}.preset"
    named = [any(bone in name.lower() for name in bones) for bone in ("tibia", "fibula")]
    if (standard.ahead_mm or standard.inside_mm) and load.point is None and (is_cut or not named[0]):
        why = "the proximal cut goes through the tibia" if named[0] else "no bone is named tibia"
        what = f"{load.preset!r} passes beside the knee centre, which is not known: {why}"
        remedy = 'state point, beside which it passes (LPS, mm), or force_N, or take "single stance"'
        raise StudyError(what, file=study.file, place=place, remedy=remedy)
    if (standard.medial or standard.inside_mm) and study.socket.side is None and not all(named):
        what = "medial and lateral are not known: no bones are named tibia and fibula"
        remedy = 'state socket.side ("left" or "right")'
        raise StudyError(what, file=study.file, place=place, remedy=remedy)


def check_tissues(study: Study) -> None:
    """Raise `StudyError` for tissues that contract or are stretched at rest, and one called as the liner."""
    rest = "the limb in a socket is at rest, without contraction and pre-stretch"
    named = f"a tissue is named {LINER!r}, as what is put over the skin"
    for place, is_refused, what, remedy in (
        ("material.law", study.material.course, rest, f'give a study of its own with the law "{FIBRED}"'),
        ("material.prestretch", study.material.prestretch, rest, "give a study of its own without it"),
        ("geometry", LINER in study.tissues, named, "give it another name"),
    ):
        if is_refused:
            raise StudyError(what, file=study.file, place=place, remedy=remedy)


def build_loadable_socket(study: Study, anatomy: Anatomy, outer: Surface) -> Socket:
    """`build_socket` a limb on which the study's loads are known, too; errors likewise."""
    socket = build_socket(study, anatomy, outer)
    for load in study.socket.loads:
        load_of(study, load, anatomy, socket)
    return socket


def find_covered_regions(
    middles: Array, skin: Surface, regions: Mapping[str, SkinRegion], socket: Socket
) -> dict[str, NDArray[np.bool_]]:
    """Which faces (f,) of an outer surface, with ``middles`` (f, 3) mm, are each region's under a socket.

    A face belongs to a region where the nearest skin does; a region that is smaller than the faces has the
    one nearest to its middle. Regions that no socket reaches are left out.
    """
    below, covered = skin.find_nearest(middles)[1], socket.find_covered(middles)
    masks = {}
    for name, region in regions.items():
        inside = region.faces[below]
        if not inside.any():
            inside[np.linalg.norm(middles - region.position, axis=1).argmin()] = True
        masks[name] = inside & covered
    return {name: mask for name, mask in masks.items() if mask.any()}


def build_target(study: Study) -> Target:
    """The pressure that the limb is to bear."""
    table = study.socket.design
    stated = {one.region: one.pressure_kPa for one in table.regions if one.pressure_kPa is not None}
    return Target(table.pressure, table.pressure_kPa, stated)


def build_socket_wall(study: Study, anatomy: Anatomy, face: Socket) -> Surface:
    """A face with the wall and the adapter of the study."""
    table = study.socket.design
    return build_wall(
        face,
        anatomy.cut_normal,
        table.wall_mm,
        adapter_diameter_mm=table.adapter_diameter_mm,
        adapter_mm=table.adapter_mm,
    )


@contextmanager
def place_errors(study: Study, place: str = "socket") -> Iterator[None]:
    """What is wrong with the shape is said of the study's table."""
    try:
        yield
    except SurfaceError as error:
        place = place if error.file is None else "socket.file"
        what = error.what if error.file is None else f"{error.file}: {error.what}"
        raise StudyError(what, file=study.file, place=place, remedy=error.remedy) from None
