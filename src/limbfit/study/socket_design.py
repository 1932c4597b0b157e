"""The table ``[socket.design]``: the pressure that a socket is designed for, and its wall."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .tables import Positive, TomlTable


class DesignRegionTable(TomlTable):
    """A region with a pressure of its own, or a limit that ``--optimise`` keeps to."""

    region: str
    pressure_kPa: Annotated[float, Field(ge=0, le=100)] | None = None
    limit_kPa: Positive | None = None

    @model_validator(mode="after")
    def _says_something(self) -> DesignRegionTable:
        if self.pressure_kPa is None and self.limit_kPa is None:
            raise ValueError("give pressure_kPa, limit_kPa or both")
        return self


class SocketDesignTable(TomlTable):
    """How a socket is designed from pressures; every key has a default."""

    pressure: Literal["tissue depth", "hydrostatic", "total surface bearing", "patellar tendon bearing"] = (
        "tissue depth"
    )
    pressure_kPa: Annotated[float, Field(gt=0, le=60)] = 10.0
    regions: tuple[DesignRegionTable, ...] = ()
    wall_mm: Annotated[float, Field(ge=1, le=15)] = 4.0
    adapter_diameter_mm: Annotated[float, Field(ge=0, le=150)] = 60.0
    adapter_mm: Annotated[float, Field(ge=1, le=60)] = 8.0

    @model_validator(mode="after")
    def _regions_differ(self) -> SocketDesignTable:
        names = [one.region for one in self.regions]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"regions: {doubled[0]!r} is given twice")
        return self
