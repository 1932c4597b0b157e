"""Where a limb is indented, ``[[sites]]``, and what was recorded there, ``[[records]]``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from .tables import Direction, Positive, TomlTable, Vector

RECORDED = ("trace", "ultrasound", "surface", "shear_waves")  # files of a record
STORED_ENDINGS = ("raw", "layers", "surface", "waves", "model", "optimize")  # of a record's files in results
_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$"


class _RecordKeys(TomlTable):
    """The keys of a record, stated at its site or in a table of its own.

    ``touch_down_s`` and ``peak_s`` are times of the record, where it is not to be left to limbfit to find
    them. ``indenter`` is a name in ``[indenters]``; None: the one of ``[indenter]``. ``control`` is what was
    stated to the machine, and drives the model; the other is compared. ``ultrasound`` is a file of what
    ultrasound through the indenter saw meanwhile: the thickness of tissues, read to ``ultrasound_sd_mm``.
    ``surface`` is one of how the skin around the indenter moved, to ``surface_sd_mm``; positions and
    displacements in ``surface_frame``: that of the limb, or of the site's indenter. ``shear_waves`` is one of
    the speeds of shear waves under the indenter, each read to ``shear_waves_sd_m_s``, and all of a place off
    together by ``shear_waves_bias_m_s``.
    """

    name: str = Field(pattern=_NAME)
    trace: Path | None = None
    touch_down_s: float | None = None
    peak_s: float | None = None
    indenter: str | None = None
    control: Literal["displacement", "force"] = "displacement"
    ultrasound: Path | None = None
    ultrasound_sd_mm: Positive = 0.1
    surface: Path | None = None
    surface_sd_mm: Positive = 0.05
    surface_frame: Literal["limb", "site"] = "limb"
    shear_waves: Path | None = None
    shear_waves_sd_m_s: Positive = 0.1
    shear_waves_bias_m_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1

    @property
    def forced(self) -> bool:
        """True if a force drove the indenter, so that depths are compared."""
        return self.control == "force"

    def check_keys(self) -> None:
        if None not in (self.touch_down_s, self.peak_s) and self.touch_down_s >= self.peak_s:  # type: ignore[operator]
            raise ValueError("touch_down_s must come before peak_s")


class Site(_RecordKeys):
    """An indentation site, with its record where it has one only; more are `RecordTable`.

    ``position`` is a point on the skin (LPS mm); ``near`` is a rough one that is matched to a marker.
    ``axis`` (into the limb) and ``edge`` (one edge direction of the square) are found when not given.
    ``weight`` is how often a fitted site counts, however many records it has.
    Where there is no record, ``depth_mm`` and ``speed_mm_s`` plan an indentation to be simulated.
    """

    region: str = ""
    fitted: bool = False
    weight: Positive = 1.0
    depth_mm: Positive | None = None
    speed_mm_s: Positive = 0.96
    position: Vector | None = None
    near: Vector | None = None
    axis: Direction | None = None
    edge: Direction | None = None

    @property
    def site(self) -> Site:
        """The site itself: like a record, an indentation that it plans has a site and a key."""
        return self

    @property
    def key(self) -> str:
        """Where the study file states it."""
        return f"sites.{self.name}"

    @property
    def planned_knots(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Times, s, and depths, mm, of the indentation that it plans: in and out."""
        assert self.depth_mm is not None
        ramp = self.depth_mm / self.speed_mm_s
        return (0.0, ramp, 2 * ramp), (0.0, self.depth_mm, 0.0)

    def check_keys(self) -> None:
        super().check_keys()
        if (self.position is None) == (self.near is None):
            raise ValueError("give either position (on the skin) or near (to be matched to a marker)")
        if self.axis and self.edge and not np.cross(self.axis, self.edge).any():
            raise ValueError("edge is along axis; give a direction across it, or leave edge out")
        for key in ("touch_down_s", "peak_s", "ultrasound", "surface", "shear_waves"):
            if self.trace is None and getattr(self, key) is not None:
                raise ValueError(f"{key} belongs to a record, and the site has no trace")


class RecordTable(_RecordKeys):
    """A record of ``site``, beside others there; ``name`` is its own among those.

    ``depth_mm``, ``speed_mm_s`` and ``hold_s`` are how it is to be made, where not as `AcquireTable` states.
    """

    site: str
    trace: Path
    depth_mm: Positive | None = None
    speed_mm_s: Positive | None = None
    hold_s: Annotated[float, Field(ge=0)] | None = None

    @property
    def full_name(self) -> str:
        """Its name among all records and sites."""
        return f"{self.site}-{self.name}"

    @property
    def key(self) -> str:
        """Where the study file states it."""
        return f"records.{self.full_name}"


class Record(_RecordKeys):
    """A record, and what a stage asks of it.

    ``name`` is the site's where the site states it, else ``<site>-<record>``: one name in files, tables and
    messages. ``key`` is where the study file states the record, ``of_site`` how many records the site has;
    ``depth_mm``, ``speed_mm_s`` and ``hold_s`` are how it is to be made.
    """

    name: str
    trace: Path
    site: Site
    key: str
    of_site: int = 1
    depth_mm: float | None = None
    speed_mm_s: float | None = None
    hold_s: float | None = None

    @property
    def files(self) -> tuple[Path, ...]:
        """The files of the record: the trace, and those measured beside it."""
        return tuple(file for key in RECORDED if (file := getattr(self, key)) is not None)

    @property
    def observed(self) -> str:
        """The kind of measurement beside the force; empty if there is none."""
        kinds = {"ultrasound": "ultrasound", "surface": "surface displacement", "shear_waves": "shear waves"}
        return next((word for key, word in kinds.items() if getattr(self, key) is not None), "")

    @property
    def unit(self) -> Literal["N", "mm"]:
        """The unit of what is compared."""
        return "mm" if self.forced else "N"

    @property
    def fitted(self) -> bool:
        return self.site.fitted

    @property
    def region(self) -> str:
        return self.site.region

    @property
    def weight(self) -> float:
        """Its share of the site's: records of a site count together as often as the site does."""
        return self.site.weight / self.of_site


Indentation = Record | Site  # a site is one where it plans an indentation


def list_records(site: Site, tables: tuple[RecordTable, ...]) -> tuple[Record, ...]:
    """List the records of a site: its own, then those of the study's tables that name it."""
    stated: list[dict[str, Any]] = []
    if site.trace is not None:  # the site's depth and speed plan an indentation without a record
        own = {field: getattr(site, field) for field in _RecordKeys.model_fields}
        stated.append({**own, "key": site.key})
    for table in tables:
        if table.site == site.name:
            stated.append({**dict(table), "name": table.full_name, "key": table.key})
    shared = {"site": site, "of_site": len(stated)}
    return tuple(Record.model_construct(**{**values, **shared}) for values in stated)
