"""The phantom's socket: what a prosthetist would make of its true shape, as a file beside the patient."""

from pathlib import Path
from typing import Any

import numpy as np

from ..anatomy.surfaces.surfacefiles import write_surface
from ..anatomy.surfaces.surfaces import Anatomy, Surface
from ..arrays import Array
from ..socket import Area, Recipe, Socket, read_socket, rectify_limb
from ..socket.landmarks import Directions, build_default_regions, find_directions, find_knee_centre
from ..socket.rectify import Trim
from .geometry import Limb
from .surfaces import build_outer_surface

FILE = Path("socket") / "socket.stl"
LINER_MM = 6.0
REDUCTION_PERCENT = 3.0
BELOW_KNEE_MM, BAND_MM = 10.0, 6.0  # of the brim at the back, and of the skin that says how far back it is
BELOW_CUT_MM = 30.0  # of a thigh's brim
# Region, radius and depth (mm) of what is pressed in or relieved.
AREAS = {
    "transtibial": (
        ("patellar tendon", 25.0, 4.0),
        ("medial proximal", 30.0, 3.0),
        ("posterior proximal", 35.0, 4.0),
        ("tibial crest", 25.0, -2.0),
        ("fibular head", 20.0, -3.0),
        ("distal tibia", 25.0, -3.0),
    ),
    "transfemoral": (
        ("anterior proximal", 40.0, 4.0),
        ("posterior proximal", 40.0, 3.0),
        ("lateral middle", 40.0, 3.0),
        ("lateral distal", 30.0, -3.0),
    ),
}


def make_socket(anatomy: Anatomy, outer: Surface, kind: str = "transtibial") -> tuple[Socket, list[Area]]:
    """Make the socket around a limb in a liner, and its areas: a shank's bears on the patellar tendon.

    Parameters
    ----------
    anatomy : of the limb; of a shank, with a tibia and a patella.
    outer : the closed surface of the liner, LPS mm, flat at the same proximal cut.
    kind : of limb, one of ``LIMBS``.

    Raises
    ------
    SurfaceError
        Where the limb has no place for it.
    """
    directions = find_directions(anatomy, "right")
    regions = build_default_regions(anatomy, directions)
    areas = [Area(name, regions[name].position, radius, depth) for name, radius, depth in AREAS[kind]]
    knee, frame = find_knee_centre(anatomy), anatomy.frame
    if knee is None:
        trim = Trim([(anatomy.cut_point - BELOW_CUT_MM * anatomy.cut_normal, anatomy.cut_normal)])
    else:
        trim = _trim_around_tendon(anatomy, directions, knee)
    return rectify_limb(outer, frame, Recipe(trim, REDUCTION_PERCENT, areas)), areas


def _trim_around_tendon(anatomy: Anatomy, directions: Directions, knee: Array) -> Trim:
    """Trim as a patellar-tendon-bearing socket is: from the patella's middle to below the knee at the back.

    A brim below the knee all around would cut through the bar on the tendon, half of which lies above it.
    """
    front, skin = anatomy.bones["patella"].points.mean(axis=0), anatomy.skin.points
    near = np.abs(anatomy.height(skin) - anatomy.height(knee) + BELOW_KNEE_MM) < BAND_MM
    behind = ((skin[near] - knee) @ directions.anterior).min()
    back = knee + behind * directions.anterior - BELOW_KNEE_MM * directions.proximal
    slope = (front - back) @ directions.proximal / ((front - back) @ directions.anterior)
    return Trim([(front, directions.proximal - slope * directions.anterior)])


def write_socket(folder: Path, limb: Limb, anatomy: Anatomy) -> dict[str, Any]:
    """Write the socket of a limb into a study's folder and read it back; returns what is true of it."""
    outer = build_outer_surface(limb, LINER_MM)
    socket, areas = make_socket(anatomy, outer, limb.kind)
    (folder / FILE).parent.mkdir()
    write_surface(folder / FILE, socket.surface)
    read_socket(folder / FILE, outer=outer, frame=anatomy.frame, bones=anatomy.bones)
    return {
        "file": FILE.as_posix(),
        "liner_mm": LINER_MM,
        "reduction_percent": REDUCTION_PERCENT,
        "volume_mm3": socket.volume_mm3,
        "areas": [
            {
                "name": a.name,
                "position_mm": a.position.tolist(),
                "radius_mm": a.radius_mm,
                "depth_mm": a.depth_mm,
            }
            for a in areas
        ],
    }
