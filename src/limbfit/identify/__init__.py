"""Identification: calibration, uncertainty and prediction on callables that are handed in."""

from .calibration import Calibration, CalibrationSettings, Iterate, StageResult, State, calibrate
from .discrepancy import ResidualModel, estimate_discrepancy
from .emulator import Emulator
from .fidelity import Corrected, FidelitySettings, calibrate_corrected
from .multistart import Multistart, Started, multistart, random_starts
from .noise import SiteNoise, curve_noise, record_noise
from .objective import Measured, SiteResponse
from .parameters import (
    FIXED,
    Prior,
    Space,
    Unknowns,
    constrained,
    search_space,
    separate,
    shared,
    two_stages,
)
from .prediction import Summary, error_percent, prediction_sd, summarise
from .uncertainty import (
    DETERMINED,
    GIVEN,
    UNDETERMINED,
    WEAK,
    Combination,
    Uncertainty,
    estimate_uncertainty,
)

__all__ = [
    "DETERMINED",
    "FIXED",
    "GIVEN",
    "UNDETERMINED",
    "WEAK",
    "Calibration",
    "CalibrationSettings",
    "Combination",
    "Corrected",
    "Emulator",
    "FidelitySettings",
    "Iterate",
    "Measured",
    "Multistart",
    "Prior",
    "ResidualModel",
    "SiteNoise",
    "SiteResponse",
    "Space",
    "StageResult",
    "Started",
    "State",
    "Summary",
    "Uncertainty",
    "Unknowns",
    "calibrate",
    "calibrate_corrected",
    "constrained",
    "curve_noise",
    "error_percent",
    "estimate_discrepancy",
    "estimate_uncertainty",
    "multistart",
    "prediction_sd",
    "random_starts",
    "record_noise",
    "search_space",
    "separate",
    "shared",
    "summarise",
    "two_stages",
]
