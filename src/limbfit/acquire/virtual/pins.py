"""Motors with limits of speed and acceleration, heads that lag by a play, and sensors with their errors."""

from collections.abc import Collection

import numpy as np

from ...arrays import Array, Mask
from ..events import PINS

STROKE_MM = 60.0
ACCELERATION = 1000.0  # mm/s2, when driven
BRAKING = 8000.0  # mm/s2, when stopped or halted
PLAY_MM = 0.02
ARRIVAL_TOLERANCE_MM = 0.001
HOME_MM = 0.1


class Motors:
    """14 motors in steps of ``step_s``: trapezoids of speed towards targets.

    Attributes
    ----------
    position_mm, speed_mm_s : (14,) of the motors, positive towards the limb.
    head_mm : (14,) of the heads.
    driving : (14,) whether a motor is under distance.
    """

    def __init__(self, step_s: float) -> None:
        self.step_s = step_s
        self.position_mm, self.speed_mm_s, self.head_mm = np.zeros(PINS), np.zeros(PINS), np.zeros(PINS)
        self.driving = np.zeros(PINS, dtype=bool)
        self._target, self._speed = np.zeros(PINS), np.zeros(PINS)
        self._acceleration = np.full(PINS, ACCELERATION)

    def drive(self, k: int, target_mm: float, speed_mm_s: float) -> None:
        self.driving[k], self._target[k], self._speed[k] = True, target_mm, speed_mm_s
        self._acceleration[k] = ACCELERATION

    def halt(self, k: int) -> None:
        self.driving[k] = False

    def retract(self, speed_mm_s: float) -> None:
        """Everything home, as hard as can be."""
        self.driving[:] = self.position_mm > ARRIVAL_TOLERANCE_MM
        self._target[:], self._speed[:], self._acceleration[:] = 0.0, speed_mm_s, BRAKING

    def find_withdrawn(self) -> Mask:
        """Withdrawn, and not about to leave."""
        return (self.position_mm < HOME_MM) & ~(self.driving & (self._target > self.position_mm))

    def step(self, jammed: Collection[int], powered: bool) -> None:
        """One time step; jammed motors (indices) and those without power stand."""
        distance = self._target - self.position_mm
        braking = np.where(self.driving, self._acceleration, BRAKING)
        reach = np.sqrt(2 * braking * np.abs(distance))
        target_speed = np.where(self.driving, np.sign(distance) * np.minimum(self._speed, reach), 0.0)
        change = braking * self.step_s
        self.speed_mm_s += np.minimum(np.maximum(target_speed - self.speed_mm_s, -change), change)
        if not powered:
            self.speed_mm_s[:] = 0.0
        for k in jammed:
            self.speed_mm_s[k] = 0.0
        moved = self.speed_mm_s * self.step_s
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

    def __init__(self, random: np.random.Generator, step_s: float) -> None:
        self._random = random
        self._zero = random.normal(0, 40, PINS)
        self._drift_step_mN = self._drift_mN * np.sqrt(step_s)
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
