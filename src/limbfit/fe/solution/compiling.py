"""The compiled kernels of an indentation: whether they are stored, and made beforehand."""

import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
from numba.core.dispatcher import Dispatcher

from ...mesh import Mesh, to_tet10
from ...mesh.cells import SIX_TETS, build_boxes
from ..contact.rigid import Indenter
from ..kernel.assembly import is_compiled
from ..kernel.laws import Laws
from ..materials import OgdenQLV
from ..memory import compute_elastic_stresses
from ..observables import compute_element_fields
from ..problem import History, Problem
from .control import StepControl
from .sensitivity import explicit_derivatives
from .stepping import solve

_SIDE_MM, _DEPTH_MM = 20.0, 0.2


def remove_old_kernels() -> None:
    """Remove stored kernels that are older than the source of any other.

    Numba compares a stored kernel with the file that it is written in. It does not see that a function which
    the kernel calls has changed in another file, and would go on with the law or element as it was.
    """
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("limbfit.")]
    kernels = [one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)]
    newest = max(Path(one.py_func.__code__.co_filename).stat().st_mtime for one in kernels)
    for folder in {one.stats.cache_path for one in kernels if one.stats.cache_path}:
        for file in Path(folder).glob("*.nbi"):
            with suppress(FileNotFoundError):  # another process removes them, too
                if file.stat().st_mtime < newest:
                    file.unlink()


def are_compiled() -> bool:
    """True if the two costliest kernels are stored on this machine; the others are made with them."""
    stored = Path(explicit_derivatives.stats.cache_path or ".")
    return is_compiled() and any(stored.glob(f"sensitivity.{explicit_derivatives.py_func.__name__}-*.nbi"))


def compile_kernels() -> None:
    """Compile what an indentation with a square punch, its derivatives and its fields need, and store it.

    That takes half a minute.  Kernels hold for every element and law: one small block meets them all.
    """
    corners, _ = build_boxes(*[np.array([0.0, _SIDE_MM])] * 3)
    mesh = to_tet10(Mesh.from_arrays(corners, SIX_TETS, ["skin", "muscle"] * 3))
    tissue = OgdenQLV(c=0.005, m=5.0, gamma=1.0, tau=0.5)
    problem = Problem(
        mesh=mesh,
        materials={"skin": tissue, "muscle": tissue},
        fixed=np.flatnonzero(mesh.points[:, 2] == 0.0),
        contact_faces=mesh.faces_where(lambda points: points[:, 2] == _SIDE_MM),
        indenter=Indenter("square", _SIDE_MM, 2.0, (10.0, 10.0, _SIDE_MM), (0.0, 0.0, -1.0)),
        history=History(np.array([0.0, 1.0]), np.array([0.0, _DEPTH_MM])),
        element="tet10p0",
    )
    found = solve(problem, steps=StepControl(times=(0.5, 1.0)), sensitivities=True)
    if found.deepest is not None:
        laws = Laws.build([tissue, tissue])
        compute_element_fields(found.system, laws, found.deepest)
        compute_elastic_stresses(found.system, laws, found.deepest.u)  # of steps without derivatives


remove_old_kernels()  # before any of them is called
