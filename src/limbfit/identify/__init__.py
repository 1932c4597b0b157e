"""Identification: calibration, uncertainty and prediction on callables that are handed in."""

from .calibration import Calibration, CalibrationSettings, Iterate, StageResult, State, calibrate
from .objective import Measured, SiteResponse
from .parameters import FIXED, SEPARATE, SHARED, TWO_STAGES, Space, Unknowns, search_space
from .prediction import Summary, error_percent, prediction_sd, summarise

__all__ = [
    "FIXED",
    "SEPARATE",
    "SHARED",
    "TWO_STAGES",
    "Calibration",
    "CalibrationSettings",
    "Iterate",
    "Measured",
    "SiteResponse",
    "Space",
    "StageResult",
    "State",
    "Summary",
    "Unknowns",
    "calibrate",
    "error_percent",
    "prediction_sd",
    "search_space",
    "summarise",
]
