"""The mechanics: viscoelastic indentation of soft tissue by a rigid body, with exact sensitivities.

>>> from limbfit.fe import History, Indenter, OgdenQLV, Problem, StepControl, solve
>>> skin = OgdenQLV(c=0.009, m=6.0, gamma=2.0, tau=0.5)                     # MPa, -, -, s
>>> punch = Indenter("square", width=20.0, centre=site, axis=inward)         # mm
>>> ramp = History(times=[0.0, 10.0, 20.0], displacement=[0.0, 9.6, 0.0])    # s, mm
>>> problem = Problem(mesh, {"skin": skin, "muscle": muscle}, fixed, skin_faces, punch, ramp)
>>> result = solve(problem, sensitivities=True)
>>> result.force_at(t), result.sensitivity_at(t)                             # N, N per MPa, -, -, s

Units: mm, N, s, MPa.  A problem that is impossible as stated raises `limbfit.errors.ProblemError`; one that
cannot be solved to its end is a result with ``completed = False`` and a ``reason``.  A next simulation on
the same mesh with other materials is quicker with ``warm_start=result`` of a run with ``store="all"``.
"""

from __future__ import annotations

from .elements import ELEMENTS
from .indenter import Indenter
from .materials import VOLUMETRIC_LAWS, Material, MooneyRivlin, NeoHookean, Ogden, OgdenQLV
from .problem import History, Problem, Support
from .result import Result, State, Step
from .rigid_surface import RigidSurface
from .stepping import StepControl, iterate, solve
from .system import System

__all__ = [
    "ELEMENTS",
    "VOLUMETRIC_LAWS",
    "History",
    "Indenter",
    "Material",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "OgdenQLV",
    "Problem",
    "Result",
    "RigidSurface",
    "State",
    "Step",
    "StepControl",
    "Support",
    "System",
    "iterate",
    "solve",
]
