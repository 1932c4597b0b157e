"""A synthetic patient with known truth: anatomy, image, markers, traces, study file."""

from __future__ import annotations

from .build import make_phantom, true_parameters
from .geometry import BONES, Limb, LimbShape, limb_shape, make_limb
from .sites import TrueSite, true_sites

__all__ = [
    "BONES",
    "Limb",
    "LimbShape",
    "TrueSite",
    "limb_shape",
    "make_limb",
    "make_phantom",
    "true_parameters",
    "true_sites",
]
