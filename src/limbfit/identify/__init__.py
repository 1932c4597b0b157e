"""Identification: calibration, uncertainty and prediction on callables that are handed in."""

from .fit.calibration import calibrate
from .fit.fidelity import Corrected, FidelitySettings, calibrate_corrected
from .fit.multistart import Multistart, Started, multistart, random_starts
from .fit.objective import Measured, SiteResponse
from .fit.parameters import (
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
from .fit.prediction import Summary, error_percent, prediction_sd, summarise
from .fit.state import Calibration, CalibrationSettings, Iterate, SearchState, StageResult
from .uncertainty.discrepancy import ResidualModel, estimate_discrepancy
from .uncertainty.emulator import Emulator
from .uncertainty.noise import SiteNoise, curve_noise, record_noise
from .uncertainty.uncertainty import (
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
    "SearchState",
    "SiteNoise",
    "SiteResponse",
    "Space",
    "StageResult",
    "Started",
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
