"""The phantom's socket: what a prosthetist would make of its true shape, as a file beside the patient."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..anatomy.frame import limb_frame
from ..anatomy.surfaces.surfacefiles import write_surface
from ..socket import Area, Recipe, rectified
from ..socket.landmarks import directions, knee_centre
from ..socket.regions import default_regions
from ..socket.trim import Trim
from .geometry import Limb
from .surfaces import outer_surface, true_anatomy

FILE = Path("socket") / "socket.stl"
LINER_MM = 6.0
REDUCTION_PERCENT = 3.0
BELOW_KNEE_MM = 10.0
# Region, radius and depth (mm) of what is pressed in or relieved.
AREAS = (
    ("patellar tendon", 25.0, 4.0),
    ("medial proximal", 30.0, 3.0),
    ("posterior proximal", 35.0, 4.0),
    ("tibial crest", 25.0, -2.0),
    ("fibular head", 20.0, -3.0),
    ("distal tibia", 25.0, -3.0),
)
STUDY = f"""
[socket]                  # the face of a rectified socket, around the limb with a liner of {LINER_MM:g} mm
file = "{FILE.as_posix()}"
"""


def write_socket(folder: Path, limb: Limb) -> dict[str, Any]:
    """Write the socket of a limb into a study's folder; returns what is true of it."""
    anatomy = true_anatomy(limb)
    known, knee = directions(anatomy), knee_centre(anatomy)
    assert knee is not None  # the phantom has a tibia
    regions = default_regions(anatomy, known)
    areas = [Area(name, regions[name].position, radius, depth) for name, radius, depth in AREAS]
    trim = Trim([(knee - BELOW_KNEE_MM * anatomy.cut_normal, anatomy.cut_normal)])
    recipe = Recipe(trim, REDUCTION_PERCENT, areas)
    frame = limb_frame(anatomy.cut_point, anatomy.cut_normal)
    socket = rectified(outer_surface(limb, LINER_MM), frame, recipe)
    (folder / FILE).parent.mkdir()
    write_surface(folder / FILE, socket.surface)
    return {
        "file": FILE.as_posix(),
        "liner_mm": LINER_MM,
        "reduction_percent": REDUCTION_PERCENT,
        "volume_mm3": socket.volume_mm3,
        "areas": [
            {
                "name": a.name,
                "position_mm": list(a.position),
                "radius_mm": a.radius_mm,
                "depth_mm": a.depth_mm,
            }
            for a in areas
        ],
    }
