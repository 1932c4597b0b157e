"""What the virtual device is made of: motors with limits of speed and acceleration, heads that lag by a play,
sensors with their errors, and the limb in the ring: where its skin is for each pin, and how it pushes back.

How a site pushes back is a stored simulation, turned into a force for any history of displacement:

    F(t) = max(0, h_0(u(t)) + sum_i int_0^t exp(-(t - s) / tau_i) dh_i(u(s)))

This is quasi-linear viscoelasticity with an elastic function of its own for each time constant. All h_i rise
(their pieces have slopes >= 0, by non-negative least squares), so the force is stable whatever the history;
beyond the depth of the simulation each goes on with its last slope.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ...arrays import Array, Mask
from ...errors import TraceError
from ...traces.touchdown import compute_memory
from ..line_protocol import PINS

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
STROKE_MM = 60.0
ACCELERATION = 1000.0  # mm/s2, when driven
RETRACT_MM_S = 100.0
BRAKING = 8000.0  # mm/s2, when stopped or halted
PLAY_MM = 0.02
ARRIVAL_TOLERANCE_MM = 0.001
HOME_MM = 0.1


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
    columns = [pieces] + [compute_memory(fine, pieces.T, tau).T for tau in TAUS_S]
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


class Motors:
    """14 motors in steps of ``STEP_S``: trapezoids of speed towards targets.

    ``position_mm``, ``speed_mm_s``: (14,) of the motors, positive towards the limb; ``head_mm``: (14,) of the
    heads; ``driving``: (14,) whether a motor is under distance.
    """

    def __init__(self) -> None:
        self.position_mm, self.speed_mm_s, self.head_mm = np.zeros(PINS), np.zeros(PINS), np.zeros(PINS)
        self.driving = np.zeros(PINS, dtype=bool)
        self._target, self._speed = np.zeros(PINS), np.zeros(PINS)
        self._acceleration = np.full(PINS, ACCELERATION)

    def drive(self, k: int, target_mm: float, speed_mm_s: float) -> None:
        self.driving[k], self._target[k], self._speed[k] = True, target_mm, speed_mm_s
        self._acceleration[k] = ACCELERATION

    def halt(self, k: int) -> None:
        self.driving[k] = False

    def retract(self) -> None:
        """Everything home, as hard as can be."""
        self.driving[:] = self.position_mm > ARRIVAL_TOLERANCE_MM
        self._target[:], self._speed[:], self._acceleration[:] = 0.0, RETRACT_MM_S, BRAKING

    def find_withdrawn(self) -> Mask:
        """Withdrawn, and not about to leave."""
        return (self.position_mm < HOME_MM) & ~(self.driving & (self._target > self.position_mm))

    def step(self, jammed: Collection[int], powered: bool) -> None:
        """One time step; jammed motors (indices) and those without power stand."""
        distance = self._target - self.position_mm
        braking = np.where(self.driving, self._acceleration, BRAKING)
        reach = np.sqrt(2 * braking * np.abs(distance))
        target_speed = np.where(self.driving, np.sign(distance) * np.minimum(self._speed, reach), 0.0)
        change = braking * STEP_S
        self.speed_mm_s += np.minimum(np.maximum(target_speed - self.speed_mm_s, -change), change)
        if not powered:
            self.speed_mm_s[:] = 0.0
        for k in jammed:
            self.speed_mm_s[k] = 0.0
        moved = self.speed_mm_s * STEP_S
        arrives = (
            self.driving
            & (np.abs(distance) <= np.maximum(np.abs(moved), ARRIVAL_TOLERANCE_MM))
            & (moved * distance >= 0)
        )
        if not powered:
            arrives[:] = False
        reached = np.where(arrives, self._target, self.position_mm + moved)
        self.position_mm = np.minimum(np.maximum(reached, 0.0), STROKE_MM)
        self.speed_mm_s[arrives] = 0.0
        self.driving &= ~arrives
        lowest, highest = self.position_mm - PLAY_MM / 2, self.position_mm + PLAY_MM / 2
        self.head_mm = np.minimum(np.maximum(self.head_mm, lowest), highest)

    def find_lagging(self) -> Mask:
        """Driven, far from the target, and standing."""
        far = np.abs(self._target - self.position_mm) > 0.05
        return self.driving & far & (np.abs(self.speed_mm_s) < 0.1 * self._speed)


class Sensors:
    """What the device reads: um, mN, fF as integers, with noise, drift, quantisation and range."""

    range_mN = 50_000
    touch_fF = 12_500
    _force_noise_mN, _force_step_mN = 30.0, 5
    _drift_mN = 0.2  # per square root of a second
    _encoder_noise_um, _capacitance_noise_fF = 1.5, 20.0
    _area = 8.854 * 400.0  # fF mm: eps0 times the head's 400 mm2
    _film_mm = 0.25

    def __init__(self, random: np.random.Generator) -> None:
        self._random = random
        self._zero = random.normal(0, 40, PINS)
        self._drift_step_mN = self._drift_mN * np.sqrt(STEP_S)
        self._frozen_forces_mN: dict[int, int] = {}
        self._noise_blocks: list[Array] = []

    def read(
        self,
        position_mm: Array,
        head_mm: Array,
        force_N: Array,
        gap_mm: Array,
        dead: Collection[int],
        saturated: Collection[int],
    ) -> tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]:
        """Positions, forces, capacitances; ``dead`` and ``saturated`` are indices of force sensors."""
        if not self._noise_blocks:
            self._noise_blocks = list(self._random.standard_normal((500, 4, PINS)))
        noise = self._noise_blocks.pop()
        self._zero += self._drift_step_mN * noise[0]
        raw = 1000 * force_N + self._zero + self._force_noise_mN * noise[1]
        quantised = np.rint(raw / self._force_step_mN) * self._force_step_mN
        force = np.minimum(np.maximum(quantised, -self.range_mN), self.range_mN).astype(int).tolist()
        for k in saturated:
            force[k] = self.range_mN
        for k in dead:
            force[k] = self._frozen_forces_mN.setdefault(k, force[k])
        for k in [k for k in self._frozen_forces_mN if k not in dead]:
            del self._frozen_forces_mN[k]
        position = np.rint(1000 * position_mm + self._encoder_noise_um * noise[2]).astype(int).tolist()
        air = np.maximum(gap_mm - head_mm, 0.0) + self._film_mm
        capacitance = self._area / air + 50 * force_N + self._capacitance_noise_fF * noise[3]
        return tuple(position), tuple(force), tuple(np.rint(capacitance).astype(int).tolist())
