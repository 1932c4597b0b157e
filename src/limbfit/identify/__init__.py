"""Identification: calibration, uncertainty and prediction on callables that are handed in."""

from .calibration import Calibration, CalibrationSettings, Iterate, StageResult, State, calibrate
from .emulator import Emulator
from .objective import Measured, SiteResponse
from .parameters import FIXED, Space, Unknowns, search_space, separate, shared, two_stages
from .prediction import Summary, error_percent, prediction_sd, summarise
from .uncertainty import (
    DETERMINED,
    UNDETERMINED,
    WEAK,
    Combination,
    SiteNoise,
    Uncertainty,
    estimate_uncertainty,
)

__all__ = [
    "DETERMINED",
    "FIXED",
    "UNDETERMINED",
    "WEAK",
    "Calibration",
    "CalibrationSettings",
    "Combination",
    "Emulator",
    "Iterate",
    "Measured",
    "SiteNoise",
    "SiteResponse",
    "Space",
    "StageResult",
    "State",
    "Summary",
    "Uncertainty",
    "Unknowns",
    "calibrate",
    "error_percent",
    "estimate_uncertainty",
    "prediction_sd",
    "search_space",
    "separate",
    "shared",
    "summarise",
    "two_stages",
]
