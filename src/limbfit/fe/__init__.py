"""The mechanics: viscoelastic indentation of soft tissue by a rigid body, with exact sensitivities.

>>> from limbfit.bench.blocks import build_layered_block
>>> from limbfit.fe import History, Indenter, OgdenQLV, Problem, StepControl, solve
>>> mesh = build_layered_block("tet10", 2)                                         # skin over muscle, mm
>>> skin = OgdenQLV(c=0.009, m=6.0, gamma=2.0, tau=0.5)                      # MPa, -, -, s
>>> muscle = OgdenQLV(c=0.005, m=5.0, gamma=1.0, tau=0.5)
>>> punch = Indenter("square", width=20.0, centre=(0, 0, 0), axis=(0, 0, -1))
>>> ramp = History(times=[0.0, 2.0, 4.0], displacement=[0.0, 2.0, 0.0])      # s, mm
>>> fixed, faces = mesh.node_sets["bottom"], mesh.face_sets["skin"]
>>> problem = Problem(mesh, {"skin": skin, "muscle": muscle}, fixed, faces, punch, ramp)
>>> result = solve(problem, steps=StepControl(load_steps=3, unload_steps=2), sensitivities=True)
>>> result.completed, result.force_at([1.0, 2.0]).shape                      # N
(True, (2,))
>>> result.sensitivity_at([1.0, 2.0]).shape                                  # N per MPa, -, -, s
(2, 8)

Units: mm, N, s, MPa.  A problem that is impossible as stated raises `limbfit.errors.ProblemError`; one that
cannot be solved to its end is a result with ``completed = False`` and a ``reason``.  A next simulation on
the same mesh with other materials is quicker with ``warm_start=result`` of a run with ``store="all"``.
"""

from __future__ import annotations

from ..shapes import RigidSurface
from .contact.open_surface import OpenSurface
from .contact.rigid import Indenter
from .contact.smooth_surface import SmoothSurface
from .diagnostics import SimulationWarning, list_texts
from .kernel.elements import ELEMENTS
from .materials import (
    ORDER_IN_TIME,
    VOLUMETRIC_LAWS,
    Contractile,
    Fibred,
    FungQLV,
    Material,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    OgdenPower,
    OgdenQLV,
)
from .motion import Activation, Motion, RigidBody
from .pressure import Pressure
from .problem import History, Problem, Support, isochoric_stretch
from .result import Result, State, Step
from .solution.compiling import are_compiled, compile_kernels
from .solution.control import StepControl
from .solution.linear import build_linear_solver
from .solution.start import compute_tangent_at_rest
from .solution.stepping import Checkpoints, Snapshot, iterate, solve
from .system import System
from .tractions import Tractions, compute_tractions

__all__ = [
    "ELEMENTS",
    "ORDER_IN_TIME",
    "VOLUMETRIC_LAWS",
    "Activation",
    "Checkpoints",
    "Contractile",
    "Fibred",
    "FungQLV",
    "History",
    "Indenter",
    "Material",
    "MooneyRivlin",
    "Motion",
    "NeoHookean",
    "Ogden",
    "OgdenPower",
    "OgdenQLV",
    "OpenSurface",
    "Pressure",
    "Problem",
    "Result",
    "RigidBody",
    "RigidSurface",
    "SimulationWarning",
    "SmoothSurface",
    "Snapshot",
    "State",
    "Step",
    "StepControl",
    "Support",
    "System",
    "Tractions",
    "are_compiled",
    "build_linear_solver",
    "compile_kernels",
    "compute_tangent_at_rest",
    "compute_tractions",
    "isochoric_stretch",
    "iterate",
    "list_texts",
    "solve",
]
