"""Material laws: each is a small frozen class that yields a `LawTable` and its derivatives."""

from __future__ import annotations

from .elastic import VOLUMETRIC_LAWS, ElasticLaw, lane_function, mean_exponential
from .fibred import Contractile, Fibred
from .hyperelastic import FungQLV, MooneyRivlin, NeoHookean, Ogden, OgdenPower, OgdenQLV
from .material import LawTable, Material, PronyTerms, Uncoupled
from .viscoelastic import ORDER_IN_TIME, compute_prony_factors

__all__ = [
    "ORDER_IN_TIME",
    "VOLUMETRIC_LAWS",
    "Contractile",
    "ElasticLaw",
    "Fibred",
    "FungQLV",
    "LawTable",
    "Material",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "OgdenPower",
    "OgdenQLV",
    "PronyTerms",
    "Uncoupled",
    "compute_prony_factors",
    "lane_function",
    "mean_exponential",
]
