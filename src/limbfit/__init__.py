"""limbfit: patient-specific viscoelastic finite-element models of residual limbs."""

__version__ = "0.1.0"
