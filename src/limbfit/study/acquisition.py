"""The table ``[acquire]``: how indentations are recorded on a device."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from .tables import Positive, TomlTable


class AcquireTable(TomlTable):
    """Speeds, forces, pauses, repeats and limits of the experiment; defaults are the paper's (section 2.1.2).

    What the paper does not state (approach, retraction, limits) is what suits a seated person's limb.
    """

    pin: Annotated[int, Field(ge=1, le=14)] = 1
    clamp_N: Annotated[float, Field(ge=1, le=25)] = 15.0
    clamp_tolerance_N: Positive = 1.0
    clamp_speed_mm_s: Positive = 5.0
    settle_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    approach_speed_mm_s: Positive = 2.0
    touch_N: Annotated[float, Field(ge=0.1, le=2)] = 0.2
    start_gap_mm: Annotated[float, Field(ge=0, le=5)] = 0.5
    search_speed_mm_s: Positive = 5.0
    search_force_N: Positive = 18.0
    search_depth_mm: Positive = 15.0
    min_depth_mm: Positive = 1.0
    pause_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    precondition: Annotated[int, Field(ge=0, le=50)] = 0
    repeats: Annotated[int, Field(ge=1, le=50)] = 1
    ramp_speed_mm_s: Positive = 0.96
    hold_s: Annotated[float, Field(ge=0, le=599)] = 0.0
    retract_speed_mm_s: Annotated[float, Field(gt=0, le=100)] = 20.0
    force_limit_N: Annotated[float, Field(gt=0, le=45)] = 25.0
    clamp_limit_N: Annotated[float, Field(gt=0, le=45)] = 25.0
    depth_limit_mm: Annotated[float, Field(gt=0, le=50)] = 20.0
    speed_limit_mm_s: Annotated[float, Field(gt=0, le=12)] = 8.0
    time_limit_s: Annotated[float, Field(ge=1, le=600)] = 90.0
    operator_limit_s: Annotated[float, Field(ge=1, le=3600)] = 600.0
    watchdog_ms: Annotated[float, Field(ge=10, le=500)] = 20.0
    key_gap_ms: Annotated[float, Field(ge=30, le=1000)] = 120.0

    @model_validator(mode="after")
    def _below_the_limits(self) -> AcquireTable:
        for name in ("clamp", "approach", "search", "ramp"):
            if getattr(self, f"{name}_speed_mm_s") > self.speed_limit_mm_s:
                raise ValueError(f"{name}_speed_mm_s is over speed_limit_mm_s")
        if self.hold_s >= self.time_limit_s:
            raise ValueError("hold_s is not below time_limit_s: the hold would end in a stop")
        if self.search_force_N >= self.force_limit_N:
            raise ValueError("search_force_N is not below force_limit_N: the search would end in a stop")
        if self.search_depth_mm >= self.depth_limit_mm:
            raise ValueError("search_depth_mm is not below depth_limit_mm: the search would end in a stop")
        if self.min_depth_mm >= self.search_depth_mm:
            raise ValueError("min_depth_mm is not below search_depth_mm")
        if self.clamp_N + self.clamp_tolerance_N >= self.clamp_limit_N:
            raise ValueError(
                "clamp_N with its tolerance is not below clamp_limit_N: clamping would end in a stop"
            )
        if self.clamp_tolerance_N >= self.clamp_N:
            raise ValueError("clamp_tolerance_N is not below clamp_N")
        return self
