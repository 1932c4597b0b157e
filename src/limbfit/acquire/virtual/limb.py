"""The limb in the ring: where its skin is for each pin, and how it pushes back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ...arrays import Array
from ...errors import TraceError
from ..events import PINS

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


TAUS_S = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
PIECES = 16
_GRID = 2000
_SMOOTH = 0.02  # weight on differences of neighbouring slopes
_IN_CONTACT = 1e-3  # of the largest force


@dataclass(frozen=True)
class Surrogate:
    """``values`` (1 + len(TAUS_S), PIECES + 1): h_0 and h_i at even displacements up to ``depth_mm``.

    ``error_percent``: largest difference from what it was fitted to, of the largest force.
    """

    depth_mm: float
    values: Array
    error_percent: float

    @property
    def step_mm(self) -> float:
        return self.depth_mm / PIECES

    def force(self, time_s: Array, displacement_mm: Array) -> Array:
        """Forces (n,) N of a history (n,) that starts at rest, stepped as finely as it is given."""
        levels = _split_depth(displacement_mm, self.depth_mm) @ np.diff(self.values, axis=1).T
        return np.maximum(levels[:, 0] + _apply_memory(time_s, levels[:, 1:]).sum(axis=1), 0.0)


def fit_surrogate(time_s: Array, displacement_mm: Array, force_N: Array) -> Surrogate:
    """Fit a surrogate to a simulated indentation, in and out.

    Parameters
    ----------
    time_s, displacement_mm, force_N : (n,) from touch-down.

    Raises
    ------
    TraceError
        Where the curve has no force or no depth.
    """
    depth, peak = float(displacement_mm.max(initial=0.0)), float(force_N.max(initial=0.0))
    if not (len(time_s) > 10 and depth > 0.1 and peak > 0.01 and np.all(np.diff(time_s) > 0)):
        raise TraceError("the simulated curve has no indentation in it")
    fine = np.union1d(np.linspace(time_s[0], time_s[-1], _GRID), time_s)
    at = np.searchsorted(fine, time_s)
    pieces = _split_depth(np.interp(fine, time_s, displacement_mm), depth)
    columns = [pieces] + [_integrate_memory(fine, pieces, tau) for tau in TAUS_S]
    matrix = np.concatenate([column[at] for column in columns], axis=1)
    touching = force_N > _IN_CONTACT * peak
    rough = np.diff(np.eye(PIECES), axis=0)
    smooth = _SMOOTH * np.kron(np.eye(len(columns)), rough)
    rises, _ = nnls(
        np.concatenate([matrix[touching], smooth]),
        np.concatenate([force_N[touching] / peak, np.zeros(len(smooth))]),
        maxiter=20_000,
    )
    miss = np.abs(np.maximum(matrix @ rises, 0.0) - force_N / peak).max()
    values = peak * np.cumsum(rises.reshape(len(columns), PIECES), axis=1)
    return Surrogate(depth, np.pad(values, ((0, 0), (1, 0))), float(100 * miss))


def _split_depth(displacement: Array, depth: float) -> Array:
    """(n, PIECES): how much of each piece of the depth has been gone; the last goes on."""
    gone = np.maximum(displacement, 0.0)[:, None] * (PIECES / depth) - np.arange(PIECES)
    return np.concatenate([np.clip(gone[:, :-1], 0.0, 1.0), np.maximum(gone[:, -1:], 0.0)], axis=1)


def _apply_memory(time: Array, levels: Array) -> Array:
    """Each column of levels as remembered with its own time constant."""
    parts = [_integrate_memory(time, levels[:, k : k + 1], tau)[:, 0] for k, tau in enumerate(TAUS_S)]
    return np.stack(parts, axis=1)


def _integrate_memory(time: Array, levels: Array, tau: float) -> Array:
    """int exp(-(t - s)/tau) dlevel(s), levels straight between times; exact."""
    kept = np.zeros_like(levels)
    steps = np.diff(time)
    for k, step in enumerate(steps):
        fade = np.exp(-step / tau)
        kept[k + 1] = fade * kept[k] + (levels[k + 1] - levels[k]) * (tau / step) * (1 - fade)
    return kept
