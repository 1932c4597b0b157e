"""Whether the pins of ``[clamps]`` meet the limb, told with the study's file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import ProblemError
from ...indentation import clamping_pins, read_indenter
from ...study import Indentation, Study, Vector

Array = NDArray[np.float64]


def pins_met(
    study: Study,
    one: Indentation,
    place: tuple[Vector, Vector],
    skin: tuple[Array, NDArray[np.int64]],
    along: Vector,
) -> int:
    """How many pins hold the limb in an indentation; 0 where the study has none.

    Parameters
    ----------
    place : position and axis of the indenter.
    skin : points (n, 3) mm and faces (f, 3 or more).
    along : the limb's axis, proximally.

    Raises
    ------
    ProblemError
        Where the pins cannot be placed, with the study's file.
    """
    if study.clamps is None:
        return 0
    indenter = read_indenter(study.indenter_of(one), *place, None)
    try:
        return len(clamping_pins(*skin, indenter, np.array(along), study.clamps))
    except ProblemError as error:
        what = f"site {one.name}: {error.what}"
        raise ProblemError(what, file=study.file, place="clamps", remedy=error.remedy) from None
