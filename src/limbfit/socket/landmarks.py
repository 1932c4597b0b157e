"""Where anterior and medial are on a limb, where its knee is, and about which point it is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..anatomy.frame import build_limb_frame
from ..anatomy.surfaces.surfaces import Anatomy
from ..anatomy.surfaces.triangles import Surface
from ..arrays import Array
from ..errors import SurfaceError
from .shape import cut_section, measure_section

PLATEAU_MM = 8.0  # of the tibia's top: its mean is the knee centre


@dataclass(frozen=True, eq=False)
class Directions:
    """Unit vectors (3,) in LPS, at right angles; ``lateral`` is None where the side is not known."""

    proximal: Array
    anterior: Array
    lateral: Array | None

    @property
    def medial(self) -> Array:
        """Towards the other leg.

        Raises
        ------
        SurfaceError
            Where the side of the limb is not known.
        """
        if self.lateral is None:
            raise SurfaceError(
                "medial and lateral are not known: no bones are named tibia and fibula",
                remedy='state socket.side ("left" or "right")',
            )
        return -self.lateral


def find_directions(anatomy: Anatomy, side: Literal["left", "right"] | None = None) -> Directions:
    """The directions of a limb: proximal by its cut, anterior by patient space, lateral by fibula or side.

    Parameters
    ----------
    side : of the patient; by default lateral is where the fibula lies beside the tibia.

    Raises
    ------
    SurfaceError
        For a limb that lies along the anterior axis of patient space.
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
    if side is None:
        tibia, fibula = find_bone(anatomy, "tibia"), find_bone(anatomy, "fibula")
        if tibia is None or fibula is None:
            return Directions(proximal, anterior, None)
        apart = float((fibula.points.mean(axis=0) - tibia.points.mean(axis=0)) @ across)
        return Directions(proximal, anterior, across if apart > 0.0 else -across)
    return Directions(proximal, anterior, across if side == "left" else -across)


def find_bone(anatomy: Anatomy, name: str) -> Surface | None:
    """The bone of that name, however it is spelled: ``Tibia left`` is a tibia."""
    return next((b for key, b in anatomy.bones.items() if name in key.lower()), None)


def find_knee_centre(anatomy: Anatomy) -> Array | None:
    """(3,) LPS mm, the middle of the tibia's top; None where no bone is named tibia."""
    tibia = find_bone(anatomy, "tibia")
    if tibia is None:
        return None
    height = anatomy.height(tibia.points)
    top = tibia.points[height > height.max() - PLATEAU_MM]
    return np.asarray((top.min(axis=0) + top.max(axis=0)) / 2)


def load_point(anatomy: Anatomy, brim: Array) -> Array:
    """(3,) LPS mm, the point about which loads are meant where none is stated.

    It is the knee centre; where that is not known, the centre of the limb's section at the height of the
    brim, whose points are ``brim`` (k, 3).
    """
    knee = find_knee_centre(anatomy)
    if knee is not None:
        return knee
    frame, skin = build_limb_frame(anatomy.cut_point, anatomy.cut_normal), anatomy.skin
    z = min(float(frame.to_limb(brim)[:, 2].mean()), -1.0)  # below the cut, which closes the skin
    local = Surface(frame.to_limb(skin.points), skin.faces)
    x, y, _ = measure_section(cut_section(local, (0.0, 0.0, z), (0.0, 0.0, 1.0)))
    return frame.to_patient(np.array([x, y, z]))
