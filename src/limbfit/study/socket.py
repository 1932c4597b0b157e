"""The tables ``[socket]`` and ``[socket.design]``: shape, liner, donning, loads, and designed pressures."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from .tables import Friction, Plane, Positive, TomlTable, Vector, find_repeated

NAME = r"^[A-Za-z0-9][A-Za-z0-9 ().,_-]{0,39}$"
Length = Annotated[float, Field(ge=0)]
Distribution = Literal["tissue depth", "hydrostatic", "total surface bearing", "patellar tendon bearing"]
Preset = Literal["double stance", "single stance", "heel strike", "mid-stance", "toe-off"]
# Round figures, not fitted to a product: only that silicone elastomers are stiffer than gels is from a source
# (Sanders et al., J Rehabil Res Dev 2004, 41:175). With m = 2 the law is a Mooney-Rivlin solid's.
LINERS: dict[str, dict[str, float]] = {
    "silicone": {"c_kPa": 100.0, "m": 2.0, "gamma": 0.1, "tau_s": 1.0},
    "gel": {"c_kPa": 40.0, "m": 2.0, "gamma": 0.3, "tau_s": 1.0},
}
# Names that results have for something else, of what has names.
TAKEN_NAMES = {"areas": (), "loads": ("donning",), "regions": ("the limb", "settling"), "measured": ()}
# Keys of `MeasuredTable` for sheets, and for those whose file does not state their layout.
SHEET_KEYS, LAYOUT_KEYS = ("landmarks", "markups", "from_s", "to_s"), ("rows", "columns", "spacing_mm")


class DesignRegionTable(TomlTable):
    """A region with a pressure of its own, or a limit that ``--optimise`` keeps to."""

    region: str
    pressure_kPa: Annotated[float, Field(ge=0, le=100)] | None = None
    limit_kPa: Positive | None = None

    def check_keys(self) -> None:
        if self.pressure_kPa is None and self.limit_kPa is None:
            raise ValueError("give pressure_kPa, limit_kPa or both")


class SocketDesignTable(TomlTable):
    """How a socket is designed from pressures; every key has a default."""

    pressure: Distribution = "tissue depth"
    pressure_kPa: Annotated[float, Field(gt=0, le=60)] = 10.0
    regions: tuple[DesignRegionTable, ...] = ()
    wall_mm: Annotated[float, Field(ge=1, le=15)] = 4.0
    adapter_diameter_mm: Annotated[float, Field(ge=0, le=150)] = 60.0
    adapter_mm: Annotated[float, Field(ge=1, le=60)] = 8.0

    def check_keys(self) -> None:
        if doubled := find_repeated(one.region for one in self.regions):
            raise ValueError(f"regions: {doubled[0]!r} is given twice")


class LinerTable(TomlTable):
    """A liner bonded to the skin: its thickness, its material, and parameters that differ from it."""

    thickness_mm: Annotated[float, Field(ge=0, le=20)] = 6.0
    material: Literal["silicone", "gel"] = "silicone"
    c_kPa: Positive | None = None
    m: Positive | None = None
    gamma: Length | None = None
    tau_s: Positive | None = None

    @property
    def parameters(self) -> dict[str, float]:
        """The law's parameters by key, as stated or else the material's."""
        stated = {"c_kPa": self.c_kPa, "m": self.m, "gamma": self.gamma, "tau_s": self.tau_s}
        return LINERS[self.material] | {key: value for key, value in stated.items() if value is not None}


class SocketAreaTable(TomlTable):
    """A round area that presses in (positive depth) or gives relief, at a point or at a region's middle."""

    name: str = Field(pattern=NAME)
    position: Vector | None = None
    region: str | None = None
    radius_mm: Annotated[float, Field(ge=3, le=150)]
    depth_mm: Annotated[float, Field(ge=-20, le=20)]

    def check_keys(self) -> None:
        if (self.position is None) == (self.region is None):
            raise ValueError("give either position (LPS, mm) or region")


class SocketRegionTable(TomlTable):
    """A named round region of the skin, for tables."""

    name: str = Field(pattern=NAME)
    position: Vector
    radius_mm: Positive


class SocketLoadTable(TomlTable):
    """A load on the socket: one of the presets times body weight, or a force and a moment about a point."""

    name: str = Field(pattern=NAME)
    preset: Preset | None = None
    force_N: Vector | None = None
    moment_Nmm: Vector = (0.0, 0.0, 0.0)
    point: Vector | None = None
    duration_s: Positive = 1.0
    hold_s: Length = 2.0

    def check_keys(self) -> None:
        if (self.preset is None) == (self.force_N is None):
            raise ValueError(f"give either preset ({', '.join(get_args(Preset))}) or force_N")
        if self.preset is not None and "moment_Nmm" in self.model_fields_set:
            raise ValueError("a preset has its own moment; give force_N with moment_Nmm instead")


class LandmarkTable(TomlTable):
    """A cell of a sheet, counted from 1, and where it lies: at a point (LPS, mm), or at a marker."""

    row: Annotated[int, Field(ge=1)]
    column: Annotated[int, Field(ge=1)]
    position: Vector | None = None
    marker: str | None = None

    def check_keys(self) -> None:
        if (self.position is None) == (self.marker is None):
            raise ValueError("give either position (LPS, mm) or marker (a point of markups)")


class MeasuredTable(TomlTable):
    """What sensors in the socket recorded under a load, and their error: what 95 % of readings are within.

    Both errors count together. A sheet lies where its ``landmarks`` say, of which some may be control points
    of a file of 3D Slicer, ``markups``; ``spacing_mm`` is from row to row and from column to column.
    """

    name: str = Field(pattern=NAME)
    load: str
    file: Path
    format: Literal["cells", "tekscan", "pliance"]
    error_kPa: Length = 0.0
    error_percent: Length = 0.0
    noise_kPa: Length | None = None
    saturation_kPa: Positive | None = None
    from_s: float | None = None
    to_s: float | None = None
    rows: Annotated[int, Field(ge=2)] | None = None
    columns: Annotated[int, Field(ge=2)] | None = None
    spacing_mm: tuple[Positive, Positive] | None = None
    landmarks: tuple[LandmarkTable, ...] = ()
    markups: Path | None = None
    within_mm: Positive = 10.0

    def check_keys(self) -> None:
        is_sheet, stated = self.format != "cells", self.model_fields_set
        ruled_out = () if self.format == "pliance" else LAYOUT_KEYS if is_sheet else SHEET_KEYS + LAYOUT_KEYS
        if wrong := [key for key in ruled_out if key in stated]:
            raise ValueError(f'{wrong[0]} does not belong to format = "{self.format}"; leave it out')
        if self.format == "pliance" and (missing := [key for key in LAYOUT_KEYS if key not in stated]):
            raise ValueError(f"the file does not state the sheet's layout; give {missing[0]}")
        if not self.error_kPa + self.error_percent:
            raise ValueError("the sensor's error is not known; give error_kPa, error_percent or both")
        if (self.markups is None) == any(one.marker is not None for one in self.landmarks):
            raise ValueError("markups and the landmarks' marker belong together; give both or neither")
        if is_sheet and len(self.landmarks) < 3:
            raise ValueError(f"{len(self.landmarks)} landmarks; a sheet is placed by three or more")
        cells = np.array([(one.row, one.column) for one in self.landmarks])
        if is_sheet and np.linalg.matrix_rank(cells - cells[0]) < 2:
            raise ValueError("all landmarks lie on one line of the sheet; add one beside it")


class SocketTable(TomlTable):
    """A socket from a file or rectified from the limb; every key has a default.

    ``trim_mm`` is below the top of the tibia, or below the proximal cut by more where no tibia ends below it.
    ``edge_mm`` is the edge length of the limb's mesh where the socket touches, by default by the size of the
    socket; ``face_edge_mm`` the socket's.
    """

    file: Path | None = None
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    space: Literal["LPS", "RAS"] | None = None
    side: Literal["left", "right"] | None = None
    reduction_percent: Annotated[float, Field(ge=-10, le=15)] = 3.0
    areas: tuple[SocketAreaTable, ...] = ()
    trim_mm: Length | None = None
    trim_planes: tuple[Plane, ...] = ()
    trimline: tuple[Vector, ...] = ()
    flare_mm: Annotated[float, Field(ge=0, le=25)] = 6.0
    distal: Literal["clearance", "bearing"] = "clearance"
    distal_clearance_mm: Annotated[float, Field(ge=0, le=40)] = 5.0
    face_edge_mm: Annotated[float, Field(ge=2, le=8)] = 4.0
    edge_mm: Annotated[float, Field(ge=3, le=30)] | None = None
    liner: LinerTable = LinerTable()
    friction: Friction = 0.5
    donning: Literal["growth", "insertion"] = "growth"
    donning_s: Positive = 2.0
    travel_mm: Positive | None = None
    hold_s: Length = 10.0
    worn_s: Positive = 3600.0
    body_weight_N: Annotated[float, Field(ge=50, le=3000)] = 800.0
    loads: tuple[SocketLoadTable, ...] = (SocketLoadTable(name="single stance", preset="single stance"),)
    regions: tuple[SocketRegionTable, ...] = ()
    measured: tuple[MeasuredTable, ...] = ()
    design: SocketDesignTable = SocketDesignTable()

    def check_keys(self) -> None:
        brims = ("trim_mm", "trim_planes", "trimline")
        stated = [key for key in brims if getattr(self, key) not in (None, ())]
        if "trim_mm" in stated and len(stated) > 1:
            raise ValueError(f"trim_mm is a plane of its own: leave it or {stated[1]} out")
        if self.trimline and len(self.trimline) < 3:
            raise ValueError("trimline needs three points or more, in order around the limb")
        for kind, taken in TAKEN_NAMES.items():
            names = [one.name for one in getattr(self, kind)]
            if doubled := find_repeated(names):
                raise ValueError(f"{kind}: names must differ; given twice: {doubled[0]}")
            if own := sorted({*taken} & {*names}):
                raise ValueError(f"{kind}: {own[0]!r} is a name of the results' own; give another")
        loads = ["donning", *(load.name for load in self.loads)]
        for one in self.measured:
            if one.load not in loads:
                what = f"measured.{one.name}: no load is named {one.load!r}"
                raise ValueError(f"{what}; there are {', '.join(loads)}")
        if self.edge_mm is not None and self.edge_mm < 0.5 * self.face_edge_mm:
            raise ValueError("edge_mm is shorter than half of face_edge_mm: the face would show its facets")
