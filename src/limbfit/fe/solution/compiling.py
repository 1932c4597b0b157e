"""The compiled kernels of an indentation: whether they are stored, and made beforehand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...mesh import Mesh, boundary_faces, to_tet10
from ..contact.indenter import Indenter
from ..kernel.assembly import is_compiled
from ..kernel.laws import Laws
from ..materials import OgdenQLV
from ..observables import compute_element_fields
from ..problem import History, Problem
from .control import StepControl
from .sensitivity import explicit_derivatives
from .stepping import solve

_SIDE_MM, _DEPTH_MM = 20.0, 0.2
# Kuhn's six tetrahedra of a box whose corners are numbered 4 i + 2 j + k.
_TETS = np.array([[0, 3, 1, 7], [0, 2, 3, 7], [0, 6, 2, 7], [0, 4, 6, 7], [0, 5, 4, 7], [0, 1, 5, 7]])


def are_compiled() -> bool:
    """True if the two costliest kernels are stored on this machine; the others are made with them."""
    stored = Path(explicit_derivatives.stats.cache_path or ".")
    return is_compiled() and any(stored.glob(f"sensitivity.{explicit_derivatives.py_func.__name__}-*.nbi"))


def compile_kernels() -> None:
    """Compile what an indentation with a square punch, its derivatives and its fields need, and store it.

    That takes half a minute.  Kernels hold for every element and law: one small block meets them all.
    """
    corners = _SIDE_MM * np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    regions = np.array([0, 1, 0, 1, 0, 1])
    linear = Mesh(corners, _TETS, "tet4", regions, ("skin", "muscle"), {}, {})
    faces = boundary_faces(linear)
    top = (corners[faces][:, :, 2] == _SIDE_MM).all(axis=1)
    mesh = to_tet10(Mesh(corners, _TETS, "tet4", regions, ("skin", "muscle"), {}, {"skin": faces[top]}))
    tissue = OgdenQLV(c=0.005, m=5.0, gamma=1.0, tau=0.5)
    problem = Problem(
        mesh=mesh,
        materials={"skin": tissue, "muscle": tissue},
        fixed=np.flatnonzero(mesh.points[:, 2] == 0.0),
        contact_faces=mesh.face_sets["skin"],
        indenter=Indenter("square", _SIDE_MM, 2.0, (10.0, 10.0, _SIDE_MM), (0.0, 0.0, -1.0)),
        history=History(np.array([0.0, 1.0]), np.array([0.0, _DEPTH_MM])),
        element="tet10p0",
    )
    found = solve(problem, steps=StepControl(times=(0.5, 1.0)), sensitivities=True)
    if found.deepest is not None:
        compute_element_fields(found.system, Laws.build([tissue, tissue]), found.deepest)
