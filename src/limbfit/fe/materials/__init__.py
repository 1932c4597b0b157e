"""Material laws: each is a small frozen class that yields a `LawTable` and its derivatives."""

from .elastic import VOLUMETRIC_LAWS as VOLUMETRIC_LAWS
from .elastic import ElasticLaw as ElasticLaw
from .elastic import lane_function as lane_function
from .elastic import mean_exponential as mean_exponential
from .fibred import ContractileMaterial as ContractileMaterial
from .fibred import FibredMaterial as FibredMaterial
from .hyperelastic import FungQLV as FungQLV
from .hyperelastic import MooneyRivlin as MooneyRivlin
from .hyperelastic import NeoHookean as NeoHookean
from .hyperelastic import Ogden as Ogden
from .hyperelastic import OgdenPower as OgdenPower
from .hyperelastic import OgdenQLV as OgdenQLV
from .material import ORDER_IN_TIME as ORDER_IN_TIME
from .material import LawTable as LawTable
from .material import Material as Material
from .material import PronyTerms as PronyTerms
from .material import Uncoupled as Uncoupled
from .material import compute_prony_factors as compute_prony_factors
