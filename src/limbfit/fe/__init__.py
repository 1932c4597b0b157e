"""The mechanics: viscoelastic indentation of soft tissue by a rigid body, with exact sensitivities.

Units: mm, N, s, MPa.  A problem that is impossible as stated raises `limbfit.errors.ProblemError`; one that
cannot be solved to its end is a result with ``completed = False`` and a ``reason``.  A next simulation on
the same mesh with other materials is quicker with ``warm_start=result`` of a run with ``store="all"``.
"""

from ..shapes import RigidSurface as RigidSurface
from .contact.rigid import Indenter as Indenter
from .contact.rigid import OpenSurface as OpenSurface
from .contact.smooth_surface import SmoothSurface as SmoothSurface
from .kernel.elements import ELEMENTS as ELEMENTS
from .materials import ORDER_IN_TIME as ORDER_IN_TIME
from .materials import VOLUMETRIC_LAWS as VOLUMETRIC_LAWS
from .materials import ContractileMaterial as ContractileMaterial
from .materials import FibredMaterial as FibredMaterial
from .materials import FungQLV as FungQLV
from .materials import Material as Material
from .materials import MooneyRivlin as MooneyRivlin
from .materials import NeoHookean as NeoHookean
from .materials import Ogden as Ogden
from .materials import OgdenPower as OgdenPower
from .materials import OgdenQLV as OgdenQLV
from .motion import Activation as Activation
from .motion import Motion as Motion
from .motion import RigidBody as RigidBody
from .pressure import Pressure as Pressure
from .problem import History as History
from .problem import Problem as Problem
from .problem import Support as Support
from .problem import isochoric_stretch as isochoric_stretch
from .result import Result as Result
from .result import SimulationWarning as SimulationWarning
from .result import State as State
from .result import Step as Step
from .result import list_texts as list_texts
from .solution.compiling import are_compiled as are_compiled
from .solution.compiling import compile_kernels as compile_kernels
from .solution.control import StepControl as StepControl
from .solution.linear import build_linear_solver as build_linear_solver
from .solution.start import compute_tangent_at_rest as compute_tangent_at_rest
from .solution.stepping import Checkpoints as Checkpoints
from .solution.stepping import Snapshot as Snapshot
from .solution.stepping import iterate as iterate
from .solution.stepping import solve as solve
from .system import System as System
from .tractions import Tractions as Tractions
from .tractions import compute_tractions as compute_tractions
