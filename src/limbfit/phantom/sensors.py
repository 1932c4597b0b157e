"""What sensors in a phantom's socket record: true pressures with gains, drift and noise, as files.

Of an error e, within which 95 % of readings are stated to be, a cell's gain and each of its readings have a
standard deviation of 0.3 e, and a drift of all cells grows to 0.3 e.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ..arrays import Array
from ..socket.sensors import FULL_SCALE

SHARE, FRAMES, STEP_S, NOISE = 0.3, 20, 0.1, 3  # noise in counts of Tekscan's converter
TEMPLATES = Environment(
    loader=PackageLoader("limbfit.phantom", "templates"),
    undefined=StrictUndefined,
    trim_blocks=True,
    keep_trailing_newline=True,
)


def record_pressure(true_kPa: Array, error_kPa: float, error_percent: float, seed: int) -> Array:
    """Readings (frames, n) kPa of true pressures (n,)."""
    random = np.random.default_rng([seed, 14])
    gain = 1.0 + 0.01 * error_percent * SHARE * random.standard_normal(len(true_kPa))
    drift = 1.0 + 0.01 * error_percent * SHARE * np.linspace(0.0, 1.0, FRAMES)
    noise = error_kPa * SHARE * random.standard_normal((FRAMES, len(true_kPa)))
    return np.asarray(np.maximum(drift[:, None] * gain * true_kPa + noise, 0.0))


def count_pressure(kPa: Array, saturation_kPa: float) -> Array:
    """Round readings as Tekscan's converter counts them: none beyond saturation, 0 below the noise."""
    counts = np.minimum(np.round(FULL_SCALE * kPa / saturation_kPa), FULL_SCALE)
    return np.where(counts < NOISE, 0.0, counts * saturation_kPa / FULL_SCALE)


def write_from_template(file: Path, name: str, mode: str = "w", **facts: Any) -> None:
    """Write a file, or the end of one, by a template and what that needs."""
    with file.open(mode, encoding="utf-8") as stream:
        stream.write(TEMPLATES.get_template(name).render(step_s=STEP_S, noise=NOISE, **facts))
