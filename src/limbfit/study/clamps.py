"""The table ``[clamps]``: the pins that hold the limb while one of them indents it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator, model_validator

from .tables import Positive, TomlTable

RING = 14  # pins of the device of the source paper (section 2.1), the test pin among them
CLEAR = 1  # on either side of the test pin, off the skin, so that tissue can bulge
Angle = Annotated[float, Field(ge=-180.0, le=180.0)]


class ClampsTable(TomlTable):
    """Square pins that press by ``force_N`` each before the indenter touches; none where there is no table.

    ``angles_degrees`` are around the limb from the test pin, by default those of the paper's eleven;
    ``levels_mm`` how far proximally of its plane, one for each angle or one for all.
    """

    force_N: Annotated[float, Field(gt=0, le=100)] = 15.0
    angles_degrees: tuple[Angle, ...] = ()
    levels_mm: tuple[float, ...] = (0.0,)
    width_mm: Annotated[float, Field(ge=5, le=60)] = 20.0
    clamping_s: Positive = 2.0
    settling_s: Positive = 5.0

    @field_validator("angles_degrees")
    @classmethod
    def _apart(cls, angles: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(angles)) < len(angles):
            raise ValueError("two pins are at one angle; give each angle once")
        if 0.0 in angles:
            raise ValueError("0 is where the test pin is; leave it out")
        return angles

    @model_validator(mode="after")
    def _one_level_each(self) -> ClampsTable:
        if len(self.levels_mm) not in (1, len(self.angles)):
            raise ValueError(
                f"levels_mm has {len(self.levels_mm)} levels for {len(self.angles)} pins; "
                "give one, or one for each angle"
            )
        return self

    @property
    def angles(self) -> tuple[float, ...]:
        """Degrees of each pin, those stated or the paper's."""
        usual = tuple(360.0 * k / RING for k in range(CLEAR + 1, RING - CLEAR))
        return self.angles_degrees or usual

    @property
    def levels(self) -> tuple[float, ...]:
        """Level of each pin, mm."""
        return self.levels_mm if len(self.levels_mm) > 1 else self.levels_mm * len(self.angles)

    @property
    def begun_s(self) -> float:
        """When the indenter touches, after clamping began, s."""
        return self.clamping_s + self.settling_s
