"""Material laws: each is a small frozen class that yields a `MaterialTable` and its derivatives."""

from __future__ import annotations

from .ogden import MaterialTable, OgdenQLV
from .viscoelastic import prony_factors
from .volumetric import VOLUMETRIC_LAWS

__all__ = ["VOLUMETRIC_LAWS", "MaterialTable", "OgdenQLV", "prony_factors"]
