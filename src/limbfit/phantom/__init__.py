"""A synthetic patient with known truth: anatomy, image, markers, traces, study file."""

from __future__ import annotations

from .build import make_phantom, true_parameters
from .geometry import LIMBS, Limb, make_limb
from .sites import TrueSite, true_sites

__all__ = [
    "LIMBS",
    "Limb",
    "TrueSite",
    "make_limb",
    "make_phantom",
    "true_parameters",
    "true_sites",
]
