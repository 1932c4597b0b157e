"""Planning an experiment on a limb: ``limbfit design`` with the parameters that are known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...indentation import Parameters
from ...study import Study
from ..shared.context import Listener, quiet
from ..shared.store import Store
from .run import run_experiment
from .simulate import known_parameters

_SENSOR_N, _MISFIT = 0.05, 0.02  # where no calibration tells: noise, and the model's error over the peak
_CORRELATION = 0.95  # of the model's error between neighbouring points of comparison


def design_study(
    study: Study,
    *,
    sites: int = 0,
    depths_mm: Sequence[float] = (),
    parameters: Parameters | None = None,
    listener: Listener = quiet,
) -> dict[str, Any]:
    """The best choice of sites and depths at known parameters, beside the study's own choice.

    Parameters
    ----------
    sites : how many to choose; 0: as many as the study fits, or four.
    depths_mm : depths to choose from at every site; none: as recorded or planned.
    parameters : per tissue; by default the identified ones, or the study's start.

    Returns
    -------
    dict
        What ``results/design/design.json`` holds, and ``folder``.

    Raises
    ------
    InputError
        For more sites than there are, or identified parameters that are stale.
    """
    used, origin = (parameters, "given") if parameters else known_parameters(study, Store(study.results))
    return run_experiment(
        study,
        "design",
        listener=listener,
        sites=sites or len(study.fitted) or 4,
        depths_mm=[float(depth) for depth in depths_mm],
        parameters=used,
        parameters_from=origin,
        noise=_noise_of(study, origin),
    )


def _noise_of(study: Study, origin: str) -> dict[str, float]:
    """Sensor noise and the model's own error, from the calibration's residuals where there is one."""
    if origin != "identified":
        return {"sensor_N": _SENSOR_N, "misfit": _MISFIT, "correlation": _CORRELATION}
    residuals = Store(study.results).read("calibrate", "calibration.json")["uncertainty"]["residuals"]
    noise = [row["compared_noise_sd_N"] for row in residuals["sites"].values()]
    return {
        "sensor_N": float(max(np.median(noise), 1e-3)),
        "misfit": float(residuals["misfit_elsewhere"]),
        "correlation": _CORRELATION,
    }
