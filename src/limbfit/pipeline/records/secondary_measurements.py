"""What is measured beside a record's force, as it is stored and as it is compared with a simulation.

Ultrasound through the indenter sees tissues become thinner and shear waves run, cameras see the skin around
it move. One simulation tells them all (`SiteModel.layers`, `SiteModel.skin_points`, `SiteModel.waves`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import ProblemError, TraceError
from ...identify.fit.objective import find_largest_magnitude
from ...identify.uncertainty.noise import SiteNoise, compute_depth_slope, compute_skin_similarity
from ...indentation import (
    OFF_SKIN_MM,
    Simulation,
    SiteModel,
    WavePlace,
    find_nearest_points,
    is_under,
    place_waves_under,
    read_indenter,
    to_vector3,
)
from ...mesh import read_vtu
from ...results.base import read_curves
from ...results.limb import LayerRecord, TraceFacts, WaveRecord
from ...study import Record, Study, Vector
from ...traces import LayerThinning, SurfaceMotion, WaveMeans
from ...traces.numerics import build_linear_interpolation
from ..engine.store import LAYERS, WAVES, write_curves

Ints = NDArray[np.int64]

CURVES = "{}-surface"  # of a record
NEAR_MM = 40.0
MAX_POINTS = 30
_COLUMNS = ("x_mm", "y_mm", "z_mm", "ux_mm", "uy_mm", "uz_mm")
_LEAST_DEPTH = 0.1  # of the largest: nearer to touch-down moves are not in proportion to the depth


@dataclass(frozen=True)
class SecondaryValues:
    """What is seen beside a record's force: values (n,), and where a simulation of it shows them.

    Each is a mean over time of one gauge: ``at`` (n, t) of the record's times, of number ``gauge`` (n,) in
    `Simulation.observed`. ``time_s`` (n,) is when; ``covariance`` (n, n) is that of the readings. ``what`` is
    seen, ``facts`` are for the stored row. ``unit`` is that of the values.
    """

    what: str
    value: Array
    time_s: Array
    gauge: NDArray[np.int64]
    at: Array
    covariance: Array
    facts: dict[str, Any]

    kind: ClassVar[str]
    quantity: ClassVar[str]  # in the heads of stored curves
    unit: ClassVar[str] = "mm"

    def observe(self, simulation: Simulation) -> tuple[Array, Array]:
        """The same values (n,) of a simulation, and their derivatives (n, p); none: (n, 0)."""
        values = np.einsum("nt,nt->n", self.at, simulation.observed[self.gauge])
        slopes = simulation.observed_jacobian
        if slopes is None:
            return values, np.zeros((len(values), 0))
        return values, np.einsum("nt,ntp->np", self.at, slopes[self.gauge])

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the values, root mean square."""
        return float(np.sqrt(np.diag(self.covariance).mean()))

    def weight(self, error_share: float) -> float:
        """How much its residuals count beside those of a force, 1 at most.

        A force counts as one whose error is ``error_share`` of its largest. Where this is off by more than
        that share of the largest value, it counts by as much less.
        """
        return min(1.0, (error_share * find_largest_magnitude(self.value) / self.noise_sd) ** 2)

    def noise(
        self, name: str, simulated: Array, depth_mm: Array | None, touch_down_sd_mm: float
    ) -> SiteNoise:
        """Noise of the values: of the readings, and of the touch-down.

        ``simulated`` (n,) tell what a wrong touch-down does to them; no ``depth_mm`` (t,) of the indenter
        at the record's times under a stated force, where the time of touch-down alone is off.
        """
        covariance = self.covariance
        if depth_mm is not None:
            slope = touch_down_sd_mm * self.depth_slope(self.at @ depth_mm, simulated)
            covariance = covariance + np.outer(slope, slope)
        sd = self.facts["sd"]
        return SiteNoise(
            name, self.time_s, covariance, sd, 0.0, touch_down_sd_mm, self.unit, similarity=self.similarity
        )

    @property
    def similarity(self) -> Array | None:
        """See `SiteNoise.similarity`."""
        return None

    def depth_slope(self, depth_mm: Array, simulated: Array) -> Array:
        """How the values (n,) change with the depth (n,), in their unit for each mm."""
        raise NotImplementedError

    def strain_slope(self, simulated: Array) -> Array | None:
        """How the values (n,) change with the logarithm of all strain; None where a depth decides it."""
        return None

    @property
    def columns(self) -> dict[str, Array]:
        """What the stored curves say of each value."""
        return {"time_s": self.time_s}


@dataclass(frozen=True)
class LayerMeasurement(SecondaryValues):
    """The compression of a tissue under the indenter."""

    kind: ClassVar = "ultrasound"
    quantity: ClassVar = "compression"

    def depth_slope(self, depth_mm: Array, simulated: Array) -> Array:
        return compute_depth_slope(self.time_s, depth_mm, simulated)


@dataclass(frozen=True)
class SurfaceMeasurement(SecondaryValues):
    """The displacement of the skin around the indenter: ``points`` (n, 3) mm along ``components`` (n,)."""

    points: Array
    components: NDArray[np.int64]

    kind: ClassVar = "surface"
    quantity: ClassVar = "displacement"

    @property
    def similarity(self) -> Array:
        return compute_skin_similarity(self.points, self.components)

    def depth_slope(self, depth_mm: Array, simulated: Array) -> Array:
        """Moves of the skin are nearly in proportion to the depth."""
        return _divide_by_depth(depth_mm, simulated)

    @property
    def columns(self) -> dict[str, Array]:
        places = dict(zip(("x_mm", "y_mm", "z_mm"), self.points.T, strict=True))
        return {"time_s": self.time_s, **places, "component": self.components.astype(np.float64)}


@dataclass(frozen=True)
class WaveMeasurement(SecondaryValues):
    """Speeds of shear waves, m/s, at one place under the indenter: at rest, and while it presses."""

    kind: ClassVar = "shear waves"
    quantity: ClassVar = "speed"
    unit: ClassVar = "m/s"

    def depth_slope(self, depth_mm: Array, simulated: Array) -> Array:
        """What strain adds to a speed is nearly in proportion to the depth."""
        return _divide_by_depth(depth_mm, simulated - simulated[np.argmin(depth_mm)])

    def strain_slope(self, simulated: Array) -> Array:
        """As much as strain adds to a speed since the first reading."""
        return np.asarray(simulated - simulated[np.argmin(self.time_s)])


def _divide_by_depth(depth_mm: Array, values: Array) -> Array:
    """Values (n,) over depths (n,), mm; none where the indenter is not in."""
    deepest = float(depth_mm.max())
    if deepest <= 0.0:
        return np.zeros_like(values)
    return np.asarray(values / np.maximum(depth_mm, _LEAST_DEPTH * deepest))


def read_secondary_values(
    folder: Path, record: Record, facts: TraceFacts, points: ChosenPoints | None, times_s: Array
) -> tuple[SecondaryValues, ...]:
    """What is compared beside a stored record, in the order of a simulation's gauges.

    ``folder``: of the stage ``traces``, which has stored the record's ``facts``. ``points``: those of its
    surface that are compared; None: none. ``times_s``: (t,) of the record.
    """
    tissues, found = list_compared_tissues(facts), list[SecondaryValues]()
    if tissues:
        layers = read_curves(folder / LAYERS.format(record.name))
        for number, tissue in enumerate(tissues):
            found.append(_build_layer_measurement(tissue, facts.layers[tissue], layers, number, times_s))
    first = len(found)
    if points is not None:
        motion = read_motion(folder, record)
        found.append(_build_surface_measurement(record, points, motion, first, times_s))
        first += 3 * len(points.points)
    if facts.waves:
        waves = read_curves(folder / WAVES.format(record.name))
        for number, place in enumerate(facts.waves):
            own = {name: values[waves["place"] == number] for name, values in waves.items()}
            found.append(_build_wave_measurement(record, place.name, own, first + number, times_s))
    return tuple(found)


def list_compared_tissues(facts: TraceFacts) -> list[str]:
    """The tissues of a record whose compression is compared."""
    return [name for name, layer in facts.layers.items() if layer.compared]


def _build_layer_measurement(
    tissue: str, stated: LayerRecord, curves: dict[str, Array], number: int, times_s: Array
) -> LayerMeasurement:
    time_s, values, samples = (curves[name] for name in ("time_s", f"{tissue}_mm", "samples"))
    thinning = LayerThinning(
        tissue, stated.thickness_mm, time_s, values, samples, stated.before, stated.sd_mm
    )
    facts = {"sd": stated.sd_mm, "thickness_mm": stated.thickness_mm, "compared": f"{len(time_s)} times"}
    gauge, at = np.full(len(time_s), number), build_linear_interpolation(time_s, times_s)
    return LayerMeasurement(tissue, values, time_s, gauge, at, thinning.covariance, facts)


def _build_surface_measurement(
    record: Record, points: ChosenPoints, motion: SurfaceMotion, first: int, times_s: Array
) -> SurfaceMeasurement:
    means = motion.average(points.which)
    sd, words = record.surface_sd_mm, ("x", "y", "z")
    if record.surface_frame == "site":
        words = ("along the edge", "across it", "along the axis")
    facts = {
        "sd": sd,
        "left_out": dict(points.left_out),
        "components": list(words),
        "compared": f"{len(points.points)} points, {len(means.moved_mm)} values",
    }
    gauge = first + 3 * means.point + means.component
    at = means.frames @ build_linear_interpolation(motion.time_s, times_s)
    values = means.moved_mm, means.time_s, gauge, at, np.diag(sd**2 / means.samples)
    return SurfaceMeasurement(
        "surface", *values, facts, np.array(points.points)[means.point], means.component
    )


def _build_wave_measurement(
    record: Record, name: str, curves: dict[str, Array], gauge: int, times_s: Array
) -> WaveMeasurement:
    means, n = WaveMeans(curves["time_s"], curves["speed_m_s"], curves["samples"]), len(curves["time_s"])
    sd, bias = record.shear_waves_sd_m_s, record.shear_waves_bias_m_s
    facts = {"sd": sd, "bias": bias, "compared": f"{n} times"}
    gauges, at = np.full(n, gauge), build_linear_interpolation(means.time_s, times_s)
    values = means.speed_m_s, means.time_s, gauges, at, means.covariance(sd, bias)
    return WaveMeasurement(f"{name}-waves", *values, facts)


@dataclass(frozen=True)
class ChosenPoints:
    """Points of a surface that are compared.

    ``points`` are their places on the skin, LPS mm, ``axes`` the directions of the components, ``which`` (k,)
    their numbers in the file's motion. ``left_out`` says how many others are not compared, by the reason.
    """

    points: tuple[Vector, ...]
    axes: tuple[Vector, Vector, Vector]
    which: Ints
    left_out: Mapping[str, int]

    @property
    def words(self) -> str:
        """How many are compared and left out."""
        others = "".join(f", {number} {why}" for why, number in self.left_out.items())
        return f"{len(self.points)} points compared{others}"


def write_motion(folder: Path, record: Record, motion: SurfaceMotion) -> None:
    """Store how a record's surface moves from touch-down on."""
    time, place, moved = motion.rows
    columns = dict(zip(_COLUMNS, (*place.T, *moved.T), strict=True))
    write_curves(folder / f"{CURVES.format(record.name)}.csv", time_s=time, **columns)


def read_motion(folder: Path, record: Record) -> SurfaceMotion:
    """What `write_motion` stored."""
    columns = read_curves(folder / f"{CURVES.format(record.name)}.csv")
    rows = np.column_stack([columns[name] for name in _COLUMNS])
    return SurfaceMotion.from_rows(columns["time_s"], rows[:, :3], rows[:, 3:])


def choose_points(
    study: Study,
    record: Record,
    place: tuple[Vector, Vector],
    skin: tuple[Array, Ints],
    motion: SurfaceMotion,
) -> ChosenPoints:
    """The points of a record's surface that can be compared, at most `MAX_POINTS`, evenly spread.

    ``place``: position and axis of the indenter. ``skin``: points (n, 3) mm and faces (f, 3 or more).
    ``motion``: in the frame that the study states. Raises `TraceError` where there is none, with the study's
    file.
    """
    assert record.surface is not None
    file = study.path(record.surface)
    indenter = read_indenter(study.indenter_of(record), *place, record.site.edge)
    axes, points = np.eye(3), motion.points
    if record.surface_frame == "site":
        axes = indenter.frame
        points = np.array(place[0]) + points @ axes

    def build_error(what: str) -> TraceError:
        remedy = 'give LPS millimetres of the skin at rest, or surface_frame = "site"'
        if record.surface_frame == "site":
            remedy = 'give millimetres from the site, or surface_frame = "limb"'
        return TraceError(what, file=file, place="x_mm, y_mm, z_mm", remedy=remedy)

    away = np.linalg.norm(points - place[0], axis=1)
    if away.min() > NEAR_MM:
        what = f"no point lies within {NEAR_MM:g} mm of site {record.site.name}"
        raise build_error(f"{what}: the nearest is {away.min():.0f} mm away")
    found = find_nearest_points(*skin, points)
    reasons = {
        f"farther than {NEAR_MM:g} mm from the site": away > NEAR_MM,
        f"more than {OFF_SKIN_MM:g} mm off the skin": found.off_mm > OFF_SKIN_MM,
        "under the indenter": is_under(indenter, found.points),
        "never seen in contact": ~np.isfinite(motion.moved_mm).any(axis=(0, 2)),
    }
    left, left_out = np.ones(len(points), dtype=bool), {}
    for why, bad in reasons.items():
        if (number := int((bad & left).sum())) > 0:
            left_out[why] = number
        left &= ~bad
    if not left.any():
        told = ", ".join(f"{number} {why}" for why, number in left_out.items())
        raise build_error(f"no point can be compared: {told}")
    usable = np.flatnonzero(left)
    which = usable[_spread(found.points[usable], int(np.argmin(away[usable])))]
    if len(which) < len(usable):
        left_out[f"thinned out, to {MAX_POINTS}"] = len(usable) - len(which)
    chosen = tuple(to_vector3(point) for point in found.points[which])
    x, y, z = (to_vector3(axis) for axis in axes)
    return ChosenPoints(chosen, (x, y, z), which, left_out)


def _spread(points: Array, first: int) -> Ints:
    """At most `MAX_POINTS` of points (k, 3), each as far as can be from those before it; sorted."""
    chosen = [first]
    away = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < min(len(points), MAX_POINTS):
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(sorted(chosen))


def place_waves(
    study: Study, record: Record, model: SiteModel, waves: Sequence[WaveRecord]
) -> tuple[WavePlace, ...]:
    """Where the shear waves of a record are, in the site's own mesh; ``waves`` as ``traces.json`` has them.

    Raises `TraceError` where the limb has no such place, with the record's file.
    """
    assert record.shear_waves is not None
    try:
        return place_waves_under(model, read_vtu(model.mesh), [(one.tissue, one.depth_mm) for one in waves])
    except ProblemError as error:
        what, file = f"site {record.site.name}: {error.what}", study.path(record.shear_waves)
        raise TraceError(what, file=file, place="header", remedy=error.remedy) from None
