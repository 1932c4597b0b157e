"""Directions, landmarks and named regions of a limb, and loads along those directions.

Regions are sides and levels of the skin, places over bones, and what the user states.

Loads are those of standing and walking as forces on the socket, in multiples of body weight. Sizes of the
forces: peaks and valley of the vertical ground reaction in level walking (Winter, The Biomechanics and Motor
Control of Human Gait, 2nd ed. 1991; a prosthetic side is loaded a little less). Lines of heel strike and
toe-off: after the loading conditions I and II of ISO 10328, rounded to 10 mm at the knee and to a tenth in
their slope. They combine the largest moments of stance: for judging sockets side by side.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from ..anatomy.surfaces.surfaces import ON_CUT_MM, Anatomy
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array, Mask
from ..errors import SurfaceError
from .shape import measure_section

PLATEAU_MM = 8.0  # of the tibia's top: its mean is the knee centre
LEVELS = ("proximal", "middle", "distal")
CREST_MM = 12.0  # half the width of the strip over the tibial crest
CREST_SHARE = (0.15, 0.85)  # of the tibia's length, from its top
BONE_END_MM = 15.0  # of a bone's end that its prominence belongs to
PROMINENCE_MM = 20.0  # radius of the regions over ends of bones
MIN_FACING = 0.3  # cosine: what a round region holds looks its way
MAX_OFFSET_MM = 20.0  # a stated position so far off the skin is a mistake


@dataclass(frozen=True, eq=False)
class Directions:
    """Unit vectors (3,) in LPS, at right angles; ``lateral`` is None where the side is not known."""

    proximal: Array
    anterior: Array
    lateral: Array | None

    @property
    def medial_axis(self) -> Array:
        """Towards the other leg. Raises `SurfaceError` where the side of the limb is not known."""
        if self.lateral is None:
            raise SurfaceError(
                "medial and lateral are not known: no bones are named tibia and fibula",
                remedy='state socket.side ("left" or "right")',
            )
        return -self.lateral


def find_directions(anatomy: Anatomy, side: Literal["left", "right"] | None = None) -> Directions:
    """Find a limb's directions: proximal by its cut, anterior by patient space, lateral by fibula or side.

    Raises `SurfaceError` for a limb that lies along the anterior axis of patient space, or whose fibula lies
    on the other side than ``side`` has it.

    Parameters
    ----------
    side : of the patient; by default lateral is where the fibula lies beside the tibia.
    """
    proximal = anatomy.cut_normal
    anterior = np.array([0.0, -1.0, 0.0])
    anterior = anterior - (anterior @ proximal) * proximal
    if np.linalg.norm(anterior) < 0.3:
        raise SurfaceError(
            "the limb lies along the anterior axis of patient space, so its front is not known",
            remedy="check that the surfaces are in LPS or RAS, as the study says",
        )
    anterior /= np.linalg.norm(anterior)
    across = np.cross(proximal, anterior)  # to the patient's left
    tibia, fibula = find_bone(anatomy, "tibia"), find_bone(anatomy, "fibula")
    found = side
    if tibia is not None and fibula is not None:
        distance = float((fibula.points.mean(axis=0) - tibia.points.mean(axis=0)) @ across)
        found = "left" if distance > 0.0 else "right"
        if side not in (None, found):
            raise SurfaceError(
                f'the fibula lies where that of a {found} leg does, but socket.side is "{side}"',
                remedy="state the other side, or check the names of the bones, and that no file is mirrored",
            )
    lateral = None if found is None else across if found == "left" else -across
    return Directions(proximal, anterior, lateral)


def find_bone(anatomy: Anatomy, name: str) -> Surface | None:
    """Find the bone of a name, however it is spelled: ``Tibia left`` is a tibia."""
    return next((b for key, b in anatomy.bones.items() if name in key.lower()), None)


def find_top(anatomy: Anatomy, name: str) -> Array | None:
    """Find the points (k, 3) of a bone's proximal end, LPS mm.

    None where no bone has that name, or where the proximal cut goes through it.
    """
    bone = find_bone(anatomy, name)
    if bone is None:
        return None
    height = anatomy.height(bone.points)
    return bone.points[height > height.max() - PLATEAU_MM] if height.max() < -ON_CUT_MM else None


def find_knee_centre(anatomy: Anatomy) -> Array | None:
    """(3,) LPS mm, the middle of the tibia's top; None where that is not known."""
    top = find_top(anatomy, "tibia")
    return None if top is None else (top.min(axis=0) + top.max(axis=0)) / 2


def find_load_point(anatomy: Anatomy, brim: Array) -> Array:
    """Find the point (3,), LPS mm, about which loads act where none is stated.

    It is the knee centre; where that is not known, the centre of the limb's section at the height of the
    brim, whose points are ``brim`` (k, 3).
    """
    knee = find_knee_centre(anatomy)
    if knee is not None:
        return knee
    frame, skin = anatomy.frame, anatomy.skin
    z = min(float(frame.to_limb(brim)[:, 2].mean()), -1.0)  # below the cut, which closes the skin
    local = Surface(frame.to_limb(skin.points), skin.faces)
    x, y, _ = measure_section(local, z)
    return frame.to_patient(np.array([x, y, z]))


@dataclass(frozen=True, eq=False)
class SkinRegion:
    """A part of the skin: its middle on the skin (LPS mm) and the skin's faces that belong to it (m,)."""

    position: Array
    faces: Mask


def build_default_regions(anatomy: Anatomy, directions: Directions) -> dict[str, SkinRegion]:
    """Build the regions of a limb by name, where nothing is stated.

    Four sides in three levels between the knee centre, or 30 mm below the proximal cut, and the distal end;
    over the bones that have these names, the tibial crest, the fibular head, the ends of tibia and fibula and
    the patellar tendon.

    Parameters
    ----------
    directions : where anterior and medial are; where medial is not, the sides are ``left`` and ``right``.
    """
    knee = find_knee_centre(anatomy)
    top = -30.0 if knee is None else float(anatomy.height(knee))
    masks = _select_levels(anatomy, directions, top) | _select_skin_over_bones(anatomy, directions)
    skin, middles = anatomy.skin, anatomy.skin.triangles.mean(axis=1)
    regions = {}
    for name, mask in masks.items():
        if mask.any():
            centre = np.average(middles[mask], axis=0, weights=skin.face_areas[mask])
            nearest = np.flatnonzero(mask)[np.linalg.norm(middles[mask] - centre, axis=1).argmin()]
            regions[name] = SkinRegion(middles[nearest], mask)
    return regions


def build_stated_region(anatomy: Anatomy, name: str, position: Array, radius_mm: float) -> SkinRegion:
    """Build a round region: faces of the skin within a radius that look the way of the middle. Raises
    `SurfaceError` where the position is off the skin.
    """
    skin = anatomy.skin
    squared, face, foot = skin.find_nearest(np.atleast_2d(position))
    if squared[0] > MAX_OFFSET_MM**2:
        raise SurfaceError(
            f"region {name!r} lies {np.sqrt(squared[0]):.0f} mm off the skin",
            remedy="give a position on the skin (LPS, mm)",
        )
    return SkinRegion(foot[0], _select_disc(skin, foot[0], radius_mm, skin.face_normals[face[0]]))


def _select_disc(skin: Surface, middle: Array, radius_mm: float, outward: Array) -> Mask:
    """Select the faces within a radius that look outward, the nearest face among them."""
    distance = np.linalg.norm(skin.triangles.mean(axis=1) - middle, axis=1)
    near = distance <= radius_mm
    near[distance.argmin()] = True
    return near & (skin.face_normals @ outward > MIN_FACING)


def _select_levels(anatomy: Anatomy, directions: Directions, top: float) -> dict[str, Mask]:
    middles = anatomy.skin.triangles.mean(axis=1)
    height = anatomy.height(middles)
    bottom = float(height.min())
    level = np.floor(3.0 * (top - height) / (top - bottom + 1e-9)).astype(int)
    left = np.cross(directions.proximal, directions.anterior)
    forwards, towards_left = np.zeros(len(middles)), np.zeros(len(middles))
    for k in range(len(LEVELS)):  # sides are counted from the middle of their level
        here = level == k
        spokes = middles[here] - middles[here].mean(axis=0) if here.any() else middles[here]
        forwards[here], towards_left[here] = spokes @ directions.anterior, spokes @ left
    if directions.lateral is None:
        names = ("anterior", "left", "posterior", "right")
    else:
        sides = ("lateral", "medial") if float(directions.lateral @ left) > 0.0 else ("medial", "lateral")
        names = ("anterior", sides[0], "posterior", sides[1])
    quarter = np.round(np.arctan2(towards_left, forwards) / (np.pi / 2)).astype(int) % 4
    return {
        f"{side} {word}": (quarter == q) & (level == k)
        for q, side in enumerate(names)
        for k, word in enumerate(LEVELS)
    }


def _select_skin_over_bones(anatomy: Anatomy, directions: Directions) -> dict[str, Mask]:
    found: dict[str, Mask] = {}
    tibia, fibula, patella = (find_bone(anatomy, name) for name in ("tibia", "fibula", "patella"))
    if tibia is not None:
        found["tibial crest"] = _select_crest(anatomy, directions, tibia)
        found["distal tibia"] = _select_skin_over_end(anatomy, tibia, distal=True)
        if patella is not None:
            found["patellar tendon"] = _select_tendon(anatomy, directions, patella, tibia)
    if fibula is not None:
        if find_top(anatomy, "fibula") is not None:
            found["fibular head"] = _select_skin_over_end(anatomy, fibula, distal=False)
        found["distal fibula"] = _select_skin_over_end(anatomy, fibula, distal=True)
    return found


def _select_skin_over_end(anatomy: Anatomy, surface: Surface, *, distal: bool) -> Mask:
    """Select the skin around the place with the least tissue over an end of a bone."""
    skin, height = anatomy.skin, anatomy.height(surface.points)
    near = height < height.min() + BONE_END_MM if distal else height > height.max() - BONE_END_MM
    middles = skin.triangles.mean(axis=1)
    distance = np.linalg.norm(middles[:, None] - surface.points[near][None], axis=2).min(axis=1)
    best = np.where(anatomy.height(middles) < -1.0, distance, np.inf).argmin()
    return _select_disc(skin, middles[best], PROMINENCE_MM, skin.face_normals[best])


def _select_crest(anatomy: Anatomy, directions: Directions, tibia: Surface) -> Mask:
    """Select faces near the line along which the tissue ahead of the tibia's shaft is thinnest."""
    middles = anatomy.skin.triangles.mean(axis=1)
    height, ends = anatomy.height(middles), anatomy.height(tibia.points)
    length = float(np.ptp(ends))
    upper, lower = (ends.max() - share * length for share in CREST_SHARE)
    axis = tibia.points.mean(axis=0)
    front = (middles - axis) @ directions.anterior > 0.0
    shaft = front & (height < upper) & (height > lower)
    if not shaft.any():
        return shaft
    depth = np.full(len(middles), np.inf)
    depth[shaft] = np.sqrt(tibia.find_nearest(middles[shaft])[0])
    slabs = np.linspace(lower, upper, max(2, round((upper - lower) / 5.0)) + 1)
    line = []
    for low, high in pairwise(slabs):
        here = np.flatnonzero(shaft & (height >= low) & (height <= high))
        if len(here):
            line.append(middles[here[depth[here].argmin()]])
    distance = np.linalg.norm(middles[:, None] - np.array(line)[None], axis=2).min(axis=1)
    return shaft & (distance <= CREST_MM)


def _select_tendon(anatomy: Anatomy, directions: Directions, patella: Surface, tibia: Surface) -> Mask:
    """Select faces ahead of the gap between the patella's lower pole and the tibia's upper fifth."""
    middles = anatomy.skin.triangles.mean(axis=1)
    pole = patella.points[anatomy.height(patella.points).argmin()]
    ends = anatomy.height(tibia.points)
    tuberosity = ends.max() - 0.2 * float(np.ptp(ends))
    height = anatomy.height(middles)
    across = np.abs((middles - pole) @ np.cross(directions.proximal, directions.anterior))
    forwards = (middles - pole) @ directions.anterior > -15.0
    return forwards & (across < 15.0) & (height < anatomy.height(pole)) & (height > tuberosity)


@dataclass(frozen=True)
class StandardLoad:
    """A force along a straight line.

    Attributes
    ----------
    proximal, anterior, medial : the force on the socket, in body weights.
    ahead_mm, inside_mm : where the line passes the knee centre, anterior and medial of it; a line through it
        passes the limb's middle where there is no knee.
    """

    proximal: float
    anterior: float = 0.0
    medial: float = 0.0
    ahead_mm: float = 0.0
    inside_mm: float = 0.0

    def force(self, body_weight: float, directions: Directions) -> Array:
        """(3,) N, LPS, on the socket."""
        force = self.proximal * directions.proximal + self.anterior * directions.anterior
        if self.medial:
            force = force + self.medial * directions.medial_axis
        return np.asarray(body_weight * force)

    def moment(self, body_weight: float, directions: Directions) -> Array:
        """(3,) N mm, LPS, on the socket about the knee centre."""
        arm = self.ahead_mm * directions.anterior
        if self.inside_mm:
            arm = arm + self.inside_mm * directions.medial_axis
        return np.cross(arm, self.force(body_weight, directions))


STANDARD_LOADS: Mapping[str, StandardLoad] = {
    "double stance": StandardLoad(0.5),
    "single stance": StandardLoad(1.0),
    "heel strike": StandardLoad(1.1, 0.2, 0.2, 50.0, 50.0),  # ISO 10328, condition I
    "mid-stance": StandardLoad(0.8, 0.0, 0.0, 0.0, 40.0),
    "toe-off": StandardLoad(1.1, -0.1, 0.0, 70.0, 40.0),  # ISO 10328, condition II
}
