"""An indenter as the rigid mesh that FEBio and Abaqus need: its front in quadrilaterals, grown backwards.

The side walls are left out below the steepest part of the rounded edge: faces beside the skin keep FEBio's
contact from converging, and the skin under a punch does not reach them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fe import Indenter

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BLUNT = 0.05  # edge radius over the width that FEBio's contact goes round without retries


@dataclass(frozen=True)
class Tool:
    """A rigid mesh: ``points (n, 3)`` mm, ``cells`` of ``cell_type`` (hex8, or tri3 shells), and the faces
    (f, 4 | 3) that touch, outward."""

    points: Array
    cells: Indices
    cell_type: str
    front: Indices


def blunt(indenter: Indenter) -> bool:
    """Whether the rigid mesh is round enough for FEBio's contact; the edges of a surface are sharp."""
    return indenter.body.facets().rounding >= BLUNT * indenter.width


def tool_mesh(indenter: Indenter) -> Tool:
    """The rigid mesh of an indenter where it stands.

    Shapes carry the rounding that limbfit itself computes with; a surface (``stl``) is written as it is, its
    edges sharp.
    """
    facets = indenter.body.facets()
    if facets.closed is not None:
        return Tool(_placed(indenter, facets.points), facets.closed, "tri3", facets.front)
    count, back = len(facets.points), facets.points - [0.0, 0.0, 0.5 * indenter.width]
    cells = np.hstack([facets.front + count, facets.front])
    return Tool(_placed(indenter, np.vstack([facets.points, back])), cells, "hex8", facets.front)


def _placed(indenter: Indenter, local: Array) -> Array:
    return np.asarray(np.asarray(indenter.centre) + local @ indenter.frame)
