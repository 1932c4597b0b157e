"""The limb in the ring: where its skin is for each pin, and how it pushes back."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...arrays import Array
from ..events import PINS
from .surrogate import PIECES, TAUS_S, Surrogate

GAP_MM = (12.0, 22.0)  # from a pin's home to the skin
STIFFER = (1.0, 2.0)  # places under the clamping pins, times the mean site
COUPLING = 0.02  # of the test pin's force, felt by the pins across
BULGE = 0.08  # of the test pin's depth, towards its neighbours
ANGLES = 2 * np.pi * np.arange(PINS) / PINS
_DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
_ROWS = np.arange(PINS)


class VirtualLimb:
    """Tissue under 14 pins, stepped in time; ``sites`` are what the test pin may meet.

    Attributes
    ----------
    gap_mm : (14,) from each pin's home to the skin as it lies now.
    force_N : (14,) what each pin feels in truth.
    """

    def __init__(
        self,
        sites: Mapping[str, Surrogate],
        random: np.random.Generator,
        gap_mm: tuple[float, float] = GAP_MM,
    ) -> None:
        self.sites = dict(sites)
        self._gap = random.uniform(*gap_mm, PINS)
        self._stiffer = random.uniform(*STIFFER, PINS)
        mean = np.mean([s.values for s in sites.values()], axis=0)
        depth = float(np.mean([s.depth_mm for s in sites.values()]))
        self._values = self._stiffer[:, None, None] * mean
        self._step = np.full(PINS, depth / PIECES)
        self._shift = np.zeros(2)
        self._levels = np.zeros((PINS, 1 + TAUS_S.size))
        self._kept = np.zeros((PINS, TAUS_S.size))
        self._set_test(0)
        self.force_N = np.zeros(PINS)
        self.gap_mm = self._gap.copy()
        self.set_time_step(0.001)

    def set_time_step(self, step_s: float) -> None:
        self._fade = np.exp(-step_s / TAUS_S)
        self._gain = TAUS_S / step_s * (1 - self._fade)

    def bring(self, site: str, pin: int) -> bool:
        """Put a site under a pin; False where the limb has none of that name."""
        if site not in self.sites:
            return False
        found = self.sites[site]
        self._set_test(pin - 1)
        self._values[self._test], self._step[self._test] = found.values, found.step_mm
        self._levels[self._test] = self._kept[self._test] = 0.0
        return True

    def _set_test(self, k: int) -> None:
        self._test = k
        self._across = COUPLING * np.maximum(-np.cos(ANGLES - ANGLES[k]), 0.0)
        self._beside = BULGE * np.isin(_ROWS, [(k - 1) % PINS, (k + 1) % PINS])

    def shift(self, towards: int, length_mm: float) -> None:
        """Move the whole limb towards a pin."""
        angle = ANGLES[towards - 1]
        self._shift += length_mm * np.array([np.cos(angle), np.sin(angle)])

    def step(self, head_mm: Array) -> None:
        """One time step, at whose end the heads are here."""
        near = self._shift @ _DIRECTIONS
        depth = np.maximum(head_mm - self._gap + near, 0.0)
        place = np.minimum((depth / self._step).astype(np.intp), PIECES - 1)
        low, high = self._values[_ROWS, :, place], self._values[_ROWS, :, place + 1]
        levels = low + (high - low) * (depth / self._step - place)[:, None]
        self._kept = self._fade * self._kept + (levels - self._levels)[:, 1:] * self._gain
        self._levels = levels
        force = np.maximum(levels[:, 0] + self._kept.sum(axis=1), 0.0)
        force[depth == 0] = 0.0
        self.force_N = force + (force > 0) * (force[self._test] * self._across)
        self.gap_mm = self._gap - near - depth[self._test] * self._beside
