"""A synthetic patient with known truth: anatomy, image, markers, traces, study file."""

from .build import draw_true_parameters, make_phantom, unpack_patient
from .geometry import LIMBS, Limb, make_limb
from .robot import TrueSite, build_true_sites
