"""Structured two-layer blocks under the square punch, of any size: meshes that need no mesher."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import ProblemError
from ..fe import ELEMENTS, History, Indenter, OgdenQLV, Problem
from ..indentation import SiteModel
from ..mesh import Mesh, to_tet10
from ..mesh.cells import HEX, SIX_TETS, build_boxes
from ..study import SolverTable

SKIN, MUSCLE = OgdenQLV(0.009, 6.0, 2.0, 0.5), OgdenQLV(0.004, 4.0, 3.0, 0.3)
HALF, DEPTH, LAYER = 30.0, 30.0, 3.0  # mm
INDENTATION, SPEED = 6.0, 0.96  # mm, mm/s


def build_punched_block(element: str, divisions: int) -> Problem:
    """The square punch on a block of 60 x 60 x 30 mm with a 3 mm layer; ``divisions`` cells along 60 mm."""
    mesh = build_layered_block(ELEMENTS[element].cell_type, divisions)
    ramp = INDENTATION / SPEED
    return Problem(
        mesh=mesh,
        materials={"skin": SKIN, "muscle": MUSCLE},
        fixed=mesh.node_sets["bottom"],
        contact_faces=mesh.face_sets["skin"],
        indenter=Indenter("square", 20.0, 2.0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
        history=History(np.array([0.0, ramp, 2 * ramp]), np.array([0.0, INDENTATION, 0.0])),
        element=element,
    )


def build_block_model(
    name: str, file: Path, steps: SolverTable, element: str, depth_mm: float = INDENTATION
) -> SiteModel:
    """A site in the middle of a block's top, of a mesh that ``file`` holds."""
    ramp = depth_mm / SPEED
    return SiteModel(
        name=name,
        mesh=file,
        mesh_digest=name,
        position=(0.0, 0.0, 0.0),
        axis=(0.0, 0.0, -1.0),
        knots_s=(0.0, ramp, 2 * ramp),
        knots_mm=(0.0, depth_mm, 0.0),
        steps=steps,
        element=element,
    )


def build_layered_block(cell_type: str, divisions: int) -> Mesh:
    """Boxes of equal size below a layer; node set ``bottom``, face set ``skin`` (the whole top)."""
    side = np.linspace(-HALF, HALF, divisions + 1)
    n_below, n_above = _divide_depth(divisions)
    below, above = np.linspace(-DEPTH, -LAYER, n_below + 1), np.linspace(-LAYER, 0.0, n_above + 1)
    points, corners = build_boxes(side, side, np.concatenate([below, above[1:]]))
    cells = corners[:, HEX] if cell_type == "hex8" else corners[:, SIX_TETS].reshape(-1, 4)
    below_skin = points[cells][:, :, 2].mean(axis=1) <= -LAYER
    mesh = Mesh.from_arrays(points, cells, below_skin.astype(int), {0: "skin", 1: "muscle"})
    bottom, top = mesh.nodes_where(lambda p: p[:, 2] <= -DEPTH), mesh.faces_where(lambda p: p[:, 2] >= 0.0)
    mesh = replace(mesh, node_sets={"bottom": bottom}, face_sets={"skin": top})
    return to_tet10(mesh) if cell_type == "tet10" else mesh


def _divide_depth(divisions: int) -> tuple[int, int]:
    """Cells through the depth, below the layer and in it, of about the same size as along the side."""
    size = 2 * HALF / divisions
    return max(round((DEPTH - LAYER) / size), 1), max(round(LAYER / size), 1)


def choose_divisions(element: str, unknowns: int) -> int:
    """Fewest cells along the side that give a block that many unknowns. Raises `ProblemError` for an element
    that is not in the table.
    """
    if element not in ELEMENTS:
        raise ProblemError(f"no element {element!r}", remedy=f"use one of {', '.join(ELEMENTS)}")
    order = 2 if ELEMENTS[element].cell_type == "tet10" else 1
    divisions = 2
    while 3 * (order * divisions + 1) ** 2 * order * sum(_divide_depth(divisions)) < unknowns:
        divisions += 1
    return divisions
