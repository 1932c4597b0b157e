"""Directions of fibres in FEBio's words: a material's axis where all cells have one, else one for each cell.

Source: FEBio User Manual 4.0, sections on local material axes and on ``MeshData``.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from ..fe import Problem
from .moving import row

Array = NDArray[np.float64]


def directions(problem: Problem) -> dict[str, Array]:
    """The directions of the fibres of each region that has some: (1, 3), or one for each of its cells."""
    mesh, found = problem.mesh, {}
    for r, name in enumerate(mesh.region_names):
        if problem.materials[name].table().has_fibres and problem.fibres is not None:
            given = np.broadcast_to(np.asarray(problem.fibres, dtype=float), (len(mesh.cells), 3))
            own = given[mesh.regions == r]
            found[name] = own[:1] if (own == own[0]).all() else own
    return found


def axis_of(own: Array | None) -> str:
    """The axis of a material whose cells have one direction."""
    return "" if own is None or len(own) != 1 else f'<mat_axis type="vector">{_axes(own[0])}</mat_axis>'


def axes_of_cells(problem: Problem) -> Iterator[str]:
    """The axes that differ from cell to cell."""
    for name, own in directions(problem).items():
        if len(own) == 1:
            continue
        yield f'<ElementData type="mat_axis" elem_set={quoteattr(name)}>'
        for i, direction in enumerate(own, 1):
            yield f'<elem lid="{i}">{_axes(direction)}</elem>'
        yield "</ElementData>"


def _axes(direction: Array) -> str:
    """The first axis, and a vector that spans a plane with it."""
    other = np.eye(3)[np.argmin(np.abs(direction))]
    return f"<a>{row(direction)}</a><d>{row(other)}</d>"
