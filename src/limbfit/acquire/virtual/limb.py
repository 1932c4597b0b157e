"""The limb in the ring: where its skin is for each pin, and how it pushes back.

How a site pushes back is a stored simulation, turned into a force for any history of displacement:

    F(t) = max(0, h_0(u(t)) + sum_i int_0^t exp(-(t - s) / tau_i) dh_i(u(s)))

This is quasi-linear viscoelasticity with an elastic function of its own for each time constant. All h_i rise
(their pieces have slopes >= 0, by non-negative least squares), so the force is stable whatever the history;
beyond the depth of the simulation each goes on with its last slope.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ...arrays import Array
from ...errors import TraceError
from ..events import PINS

STEP_S = 0.001  # of time
GAP_MM = (12.0, 22.0)  # from a pin's home to the skin
STIFFNESS_RATIOS = (1.0, 2.0)  # places under the clamping pins, times the mean site
COUPLING = 0.02  # of the test pin's force, felt by the pins across
BULGE = 0.08  # of the test pin's depth, towards its neighbours
ANGLES = 2 * np.pi * np.arange(PINS) / PINS
_DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
_PIN_INDICES = np.arange(PINS)
TAUS_S = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
PIECES = 16
_FINE_STEPS = 2000
_SMOOTHING_WEIGHT = 0.02  # weight on differences of neighbouring slopes
_CONTACT_FORCE_SHARE = 1e-3  # of the largest force


class VirtualLimb:
    """Tissue under 14 pins, stepped in time; ``sites`` are what the test pin may meet.

    ``gap_mm`` (14,) is from each pin's home to the skin as it lies now, ``force_N`` (14,) what it feels in
    truth.
    """

    def __init__(
        self,
        sites: Mapping[str, Surrogate],
        random: np.random.Generator,
        gap_mm: tuple[float, float] = GAP_MM,
    ) -> None:
        self.sites = dict(sites)
        self._gap = random.uniform(*gap_mm, PINS)
        self._stiffness_ratios = random.uniform(*STIFFNESS_RATIOS, PINS)
        mean = np.mean([s.values for s in sites.values()], axis=0)
        depth = float(np.mean([s.depth_mm for s in sites.values()]))
        self._values = self._stiffness_ratios[:, None, None] * mean
        self._step = np.full(PINS, depth / PIECES)
        self._shift = np.zeros(2)
        self._levels = np.zeros((PINS, 1 + TAUS_S.size))
        self._memory = np.zeros((PINS, TAUS_S.size))
        self._set_test_pin(0)
        self.force_N = np.zeros(PINS)
        self.gap_mm = self._gap.copy()
        self._decay = np.exp(-STEP_S / TAUS_S)
        self._gain = TAUS_S / STEP_S * (1 - self._decay)

    def place_site(self, site: str, pin: int) -> bool:
        """Put a site under a pin; return False if the limb has none of that name."""
        if site not in self.sites:
            return False
        found = self.sites[site]
        self._set_test_pin(pin - 1)
        self._values[self._test_pin], self._step[self._test_pin] = found.values, found.depth_mm / PIECES
        self._levels[self._test_pin] = self._memory[self._test_pin] = 0.0
        return True

    def _set_test_pin(self, k: int) -> None:
        self._test_pin = k
        self._opposite_coupling = COUPLING * np.maximum(-np.cos(ANGLES - ANGLES[k]), 0.0)
        self._neighbour_bulge = BULGE * np.isin(_PIN_INDICES, [(k - 1) % PINS, (k + 1) % PINS])

    def shift(self, towards: int, length_mm: float) -> None:
        """Move the whole limb towards a pin."""
        angle = ANGLES[towards - 1]
        self._shift += length_mm * np.array([np.cos(angle), np.sin(angle)])

    def step(self, head_mm: Array) -> None:
        """Advance by ``STEP_S``, at the end of which the heads (14,) are at these positions, mm."""
        near = self._shift @ _DIRECTIONS
        depth = np.maximum(head_mm - self._gap + near, 0.0)
        place = np.minimum((depth / self._step).astype(np.intp), PIECES - 1)
        low, high = self._values[_PIN_INDICES, :, place], self._values[_PIN_INDICES, :, place + 1]
        levels = low + (high - low) * (depth / self._step - place)[:, None]
        self._memory = self._decay * self._memory + (levels - self._levels)[:, 1:] * self._gain
        self._levels = levels
        force = np.maximum(levels[:, 0] + self._memory.sum(axis=1), 0.0)
        force[depth == 0] = 0.0
        self.force_N = force + (force > 0) * (force[self._test_pin] * self._opposite_coupling)
        self.gap_mm = self._gap - near - depth[self._test_pin] * self._neighbour_bulge


@dataclass(frozen=True)
class Surrogate:
    """``values`` (1 + len(TAUS_S), PIECES + 1): h_0 and h_i at even displacements up to ``depth_mm``.

    ``error_percent``: largest difference from what it was fitted to, of the largest force.
    """

    depth_mm: float
    values: Array
    error_percent: float


def fit_surrogate(time_s: Array, displacement_mm: Array, force_N: Array) -> Surrogate:
    """Fit a surrogate to a simulated indentation, in and out, (n,) from touch-down. Raises `TraceError` where
    the curve has no force or no depth.
    """
    depth, peak = float(displacement_mm.max(initial=0.0)), float(force_N.max(initial=0.0))
    if not (len(time_s) > 10 and depth > 0.1 and peak > 0.01 and np.all(np.diff(time_s) > 0)):
        raise TraceError("the simulated curve has no indentation in it")
    fine = np.union1d(np.linspace(time_s[0], time_s[-1], _FINE_STEPS), time_s)
    at = np.searchsorted(fine, time_s)
    pieces = _split_depth(np.interp(fine, time_s, displacement_mm), depth)
    columns = [pieces] + [_integrate_memory(fine, pieces, tau) for tau in TAUS_S]
    matrix = np.concatenate([column[at] for column in columns], axis=1)
    touching = force_N > _CONTACT_FORCE_SHARE * peak
    rough = np.diff(np.eye(PIECES), axis=0)
    smooth = _SMOOTHING_WEIGHT * np.kron(np.eye(len(columns)), rough)
    rises, _ = nnls(
        np.concatenate([matrix[touching], smooth]),
        np.concatenate([force_N[touching] / peak, np.zeros(len(smooth))]),
        maxiter=20_000,
    )
    miss = np.abs(np.maximum(matrix @ rises, 0.0) - force_N / peak).max()
    values = peak * np.cumsum(rises.reshape(len(columns), PIECES), axis=1)
    return Surrogate(depth, np.pad(values, ((0, 0), (1, 0))), float(100 * miss))


def _split_depth(displacement: Array, depth: float) -> Array:
    """Return how much of each piece of the depth is passed, (n, PIECES); the last goes on."""
    gone = np.maximum(displacement, 0.0)[:, None] * (PIECES / depth) - np.arange(PIECES)
    return np.concatenate([np.clip(gone[:, :-1], 0.0, 1.0), np.maximum(gone[:, -1:], 0.0)], axis=1)


def _integrate_memory(time: Array, levels: Array, tau: float) -> Array:
    """Integrate exp(-(t - s)/tau) dlevel(s) exactly, with levels straight between times."""
    memory = np.zeros_like(levels)
    steps = np.diff(time)
    for k, step in enumerate(steps):
        decay = np.exp(-step / tau)
        memory[k + 1] = decay * memory[k] + (levels[k + 1] - levels[k]) * (tau / step) * (1 - decay)
    return memory
