"""Material laws: each is a small frozen class that yields a `LawTable` and its derivatives."""

from __future__ import annotations

from .hyperelastic import MooneyRivlin, NeoHookean, Ogden, OgdenQLV
from .material import LawTable, Material
from .viscoelastic import ORDER_IN_TIME, prony_factors
from .volumetric import VOLUMETRIC_LAWS

__all__ = [
    "ORDER_IN_TIME",
    "VOLUMETRIC_LAWS",
    "LawTable",
    "Material",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "OgdenQLV",
    "prony_factors",
]
