"""What indentations and a socket's loads do to the tissue, in figures (see `identify.checks.domain`)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from vtkmodules.util.numpy_support import vtk_to_numpy

from ...anatomy.sites.sites import compute_indenter_axis, compute_square_edges, measure_tissue_under
from ...anatomy.surfaces.surfaces import Anatomy
from ...arrays import Array
from ...donning import LoadedState
from ...identify.checks.domain import (
    ANGLE,
    COMPRESSION,
    DEPTH,
    LEVEL,
    PRESSURE,
    RATE,
    SHEAR,
    TIME,
    Extent,
    RecordedRange,
    describe_outside,
)
from ...indentation import compute_contact_radius
from ...mesh import Mesh, cell_volumes, grid_to_mesh, read_grid
from ...phases import find_phases
from ...study import IndenterTable, Vector
from ...study.socket import SocketTable

NEAR_MM = 20.0  # from what is touched: the tissue that a load strains most
_SLICE_MM = 10.0  # of the limb, whose middle angles are about


@dataclass(frozen=True)
class LoadHistory:
    """When an indentation, or a load, strains the tissue.

    ``ramp_s`` is its shortest ramp, ``end_s`` when it ends, from the first touch. ``rate_per_s`` is the
    largest rate of what drives it over the largest value of that.
    """

    ramp_s: float
    end_s: float
    rate_per_s: float

    @classmethod
    def from_knots(cls, times_s: Sequence[float], driven: Sequence[float]) -> LoadHistory:
        """Build it from a displacement (n,) mm, or a force (n,) N, at times (n,) s from touch-down."""
        ramps = [phase for phase in find_phases(np.array(times_s), np.array(driven)) if phase.kind == "load"]
        if not ramps:
            return cls(float(times_s[-1]), float(times_s[-1]), 0.0)
        rate = max(phase.rate_mm_s for phase in ramps) / max(driven)
        return cls(min(phase.duration_s for phase in ramps), float(times_s[-1]), rate)

    @property
    def time(self) -> Extent:
        """From the shortest ramp to the end."""
        return Extent(TIME, "s", self.ramp_s, self.end_s)


@dataclass(frozen=True, eq=False)
class LimbAxis:
    """The limb as seen along its axis, for levels and directions of points on it."""

    anatomy: Anatomy

    @cached_property
    def _heights(self) -> Array:
        return self.anatomy.height(self.anatomy.skin.points)

    def measure_level(self, points: Array) -> Array:
        """Return the distance (n,) mm of points (n, 3) from the limb's distal end, along its axis."""
        return self.anatomy.height(points) - self._heights.min()

    def measure_angle(self, points: Array) -> Array:
        """Return the direction (n,) in degrees of points (n, 3) about the limb's middle at their level."""
        skin, first = self.anatomy.skin.points, self._heights.min()
        slices = ((self._heights - first) / _SLICE_MM).astype(int)
        count = np.bincount(slices)
        known = np.flatnonzero(count)
        at, levels = self.measure_level(points), (known + 0.5) * _SLICE_MM
        means = [np.bincount(slices, places)[known] / count[known] for places in skin.T]
        middles = np.stack([np.interp(at, levels, mean) for mean in means], axis=1)
        along, across = compute_square_edges(self.anatomy.cut_normal)
        off = points - middles
        return np.degrees(np.arctan2(off @ across, off @ along))


def compute_strain_extents(
    mesh: Mesh, shear: Array, compression: Array, pressure: Array, tissues: Collection[str], near_mm: float
) -> list[Extent]:
    """Return shear and compressive strain of each tissue near what is pressed.

    Parameters
    ----------
    shear, compression : (m,) of the cells, as in `donning.inside.Strains`.
    pressure : (n,) of contact at the nodes; 0 where nothing touches.
    near_mm : cells count whose middle is within so far of a node that is pressed.
    """
    touched = mesh.points[pressure > 0.0]
    if not len(touched):
        return []
    middles = mesh.points[mesh.corners].mean(axis=1)
    far, _ = cKDTree(touched).query(middles, distance_upper_bound=near_mm)
    near, volumes, found = np.isfinite(far), cell_volumes(mesh), []
    for number, tissue in enumerate(mesh.region_names):
        cells = near & (mesh.regions == number)
        if tissue in tissues and cells.any():
            for quantity, values in ((SHEAR, shear), (COMPRESSION, compression)):
                found.append(Extent.from_values(quantity, "", values[cells], volumes[cells], tissue))
    return found


def read_strain_extents(file: Path) -> list[Extent]:
    """Return the strains near the indenter of a simulation whose fields were stored (see `fields`)."""
    grid = read_grid(file)
    mesh = grid_to_mesh(grid, file)
    most, least = (
        vtk_to_numpy(grid.GetCellData().GetArray(f"{which}_stretch")) ** 2
        for which in ("largest", "smallest")
    )
    pressure = vtk_to_numpy(grid.GetPointData().GetArray("contact_pressure_kPa"))
    shear, compression = (most - least) / 4.0, (1.0 - least) / 2.0
    return compute_strain_extents(mesh, shear, compression, pressure, mesh.region_names, NEAR_MM)


def describe_indentation(
    history: LoadHistory,
    depth_mm: float,
    indenter: IndenterTable,
    place: tuple[Vector, Vector] | None,
    axis: LimbAxis | None,
    *,
    force_N: float | None = None,
    strains: Sequence[Extent] = (),
    tested: RecordedRange | None = None,
) -> list[Extent]:
    """Return the extents of an indentation, as far as they are known.

    Parameters
    ----------
    place : position and axis of the indenter; None: not known yet, as ``axis``.
    force_N : the largest.
    strains : near the indenter at its deepest point.
    tested : what it will be compared with, for its angle to the nearest fitted site.
    """
    radius = compute_contact_radius(indenter)
    found = [history.time, *strains]
    for one in strains:
        if one.quantity == SHEAR:
            found.append(Extent(RATE, "1/s", 0.0, one.high * history.rate_per_s, one.tissue))
    if force_N is not None:
        found.append(Extent(PRESSURE, "kPa", 0.0, 1e3 * force_N / (np.pi * radius**2)))
    if place is not None and axis is not None:
        position, width = np.array(place[0]), radius * np.sqrt(np.pi)
        inwards = compute_indenter_axis(axis.anatomy.open_skin, position, width)
        thickness = measure_tissue_under(axis.anatomy, position, inwards, width)
        found.append(Extent(DEPTH, "", 0.0, depth_mm / thickness))
        level = float(axis.measure_level(position[None])[0])
        found.append(Extent(LEVEL, "mm", level, level))
        if tested is not None and tested.angles_deg:
            angle = float(tested.measure_angle(axis.measure_angle(position[None]))[0])
            found.append(Extent(ANGLE, "deg", 0.0, angle))
    return found


def describe_socket_load(
    mesh: Mesh,
    faces: NDArray[np.int64],
    held: LoadedState,
    before: Sequence[Extent],
    history: LoadHistory,
    tissues: Collection[str],
    near_mm: float,
    axis: LimbAxis,
    tested: RecordedRange,
) -> list[Extent]:
    """Return the extents of donning or a load of a socket when it has been held.

    Parameters
    ----------
    faces : (f, k) of the mesh, that the socket may touch.
    before : the extents of what was held before.
    history : its ramp, and its end from the beginning of donning.
    """
    strains = compute_strain_extents(
        mesh, held.strains.shear, held.strains.compression, held.pressure, tissues, near_mm
    )
    found = [history.time, *strains]
    earlier = {one.tissue: one.high for one in before if one.quantity == SHEAR}
    rates = {one.tissue: one.high for one in before if one.quantity == RATE}
    for one in strains:
        if one.quantity == SHEAR:
            rate = max(one.high - earlier.get(one.tissue, 0.0), 0.0) / history.ramp_s
            found.append(Extent(RATE, "1/s", 0.0, max(rate, rates.get(one.tissue, 0.0)), one.tissue))
    a, b, c = (mesh.points[faces[:, i]] for i in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    pressure = held.pressure[faces].mean(axis=1)
    touched = pressure > 0.0
    if touched.any():
        middles = ((a + b + c) / 3.0)[touched]
        levels, angles = axis.measure_level(middles), tested.measure_angle(axis.measure_angle(middles))
        for quantity, unit, values in (
            (PRESSURE, "kPa", pressure[touched]),
            (LEVEL, "mm", levels),
            (ANGLE, "deg", angles),
        ):
            found.append(Extent.from_values(quantity, unit, values, areas[touched]))
    return found


def time_socket_loads(table: SocketTable) -> dict[str, LoadHistory]:
    """Return the histories of donning and each load of a socket, by name; ends count from its beginning."""
    found, start = {}, 0.0
    loads = ((load.name, load.duration_s, load.hold_s) for load in table.loads)
    for name, ramp, hold in (("donning", table.donning_s, table.hold_s), *loads):
        start += ramp + hold
        found[name] = LoadHistory(ramp, start, 1.0 / ramp)
    return found


def name_load(name: str) -> str:
    """Return what sentences call donning or a load of a socket."""
    return name if name == "donning" else f"the load {name!r}"


def describe_untested_times(
    records: Iterable[LoadHistory], loads: Mapping[str, tuple[float, float]]
) -> list[str]:
    """Return in words which times of a socket's ``loads`` (ramp and end, s) a protocol's records have not."""
    tested = RecordedRange.from_records(([one.time] for one in records), ())
    ends = {name_load(name): Extent(TIME, "s", *times) for name, times in loads.items()}
    outside = {name: tested.find_outside([time]) for name, time in ends.items()}
    return [f"this protocol does not determine all: {text}" for text in describe_outside(outside)]
