"""How much each layer of soft tissue is compressed under a rigid probe, by limbfit's solver at large strains.

A quarter of a block of skin, fat and muscle on flat bone is pressed by a rectangle with rounded edges, by a
growing force. A common factor of all moduli is one of the force, so that a simulation holds at every common
stiffness. A Sobol' design of simulations over thickness, ratios of moduli and m is interpolated (a Gaussian
process about linear theory, Rasmussen and Williams 2006, section 2.7): `SolvedFootprint` stands for the
solver where `layer_compressions.Footprint` stands for linear theory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

import numpy as np
from layer_compressions import Footprint, Layers
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.stats import qmc

from limbfit.fe import History, Indenter, Material, OgdenQLV, Problem, Result, StepControl, Support, solve
from limbfit.mesh import Mesh
from limbfit.mesh.cells import HEX, build_boxes
from limbfit.shapes import Measure, register_shape
from limbfit.shapes.shape import Distance, Square

Array = NDArray[np.float64]

ROUNDING_MM = 2.0
ACROSS = 4  # elements from the middle of the probe to its edge
BEYOND_MM = (1.5, 4.0, 9.0, 18.0, 34.0, 62.0)  # edges of elements, from the probe's own
LAYER_MM, DEEPEST = 3.0, 6  # height of an element in outer layers; how many the innermost has
RATIO = 1.4  # of the heights of two neighbours in the innermost layer
ELASTIC = {"gamma": 0.01, "tau": 0.01}  # a law has a relaxation: one that is over at once
SECONDS = 10.0
C_MPA = 0.005  # of the innermost layer in every simulation
LOADS_N = np.array([0.6, 1.5, 3.0, 6.0, 11.0, 20.0, 35.0, 60.0])
# The design: quantiles of the legs' thicknesses, moduli of skin and fat over that of muscle, and m.
QUANTILES = (0.005, 0.995)
RATIOS = np.array([4 * np.exp([-1.7, 1.7]), np.exp([-1.7, 1.7])])
EXPONENTS = (3.0, 14.0)
LENGTHS = np.array([3.0, 3.0, 3.0, 3.0, 3.0, 4.0, 1.5])  # of the process, in deviations of the design
NUGGET = 1e-3  # of its variance: what a mesh makes of neighbouring designs
SOFTENED = 0.45  # strain of linear theory beyond which the mean no longer follows it
SKIN_SHARE, SKIN_MM = 0.2, (1.0, 3.0)  # of skin and fat that are one layer, what is meshed as skin


class Rectangle(Square):
    """A `Square` of ``width`` that is drawn out along x by ``longer_mm``."""

    name: ClassVar = "rectangle"
    words: ClassVar = "rectangular probe"
    measures: ClassVar = (Measure("longer_mm", 0.0, 0.0, 500.0, "longer than wide by"),)

    def __init__(self, width: float, radius: float, longer_mm: float = 0.0) -> None:
        super().__init__(width, radius)
        object.__setattr__(self, "longer_mm", longer_mm)

    def distance(self, points: Array) -> Distance:
        """That of the square, once its middle is cut out."""
        x, y, z = points.T
        short = np.sign(x) * np.maximum(np.abs(x) - self.longer_mm / 2, 0.0)
        return super().distance(np.column_stack([short, y, z]))

    @property
    def reach(self) -> float:
        return 0.9 * (self.width + self.longer_mm)


register_shape(Rectangle)


def press_layers(
    thickness_mm: Array, footprint: Footprint, moduli_MPa: Array, m: float, force_N: float
) -> tuple[Result, NDArray[np.intp]]:
    """A quarter of a block of layers, outermost first, pressed up to a force (that of the whole block).

    Returns the simulation and the nodes (l + 1,) on the axis between the layers, from the skin to the bone.
    """
    mesh, axis = layered_quarter(thickness_mm, footprint)
    tissues = {
        name: OgdenQLV(c=c, m=m, **ELASTIC) for name, c in zip(mesh.region_names, moduli_MPa, strict=True)
    }
    history = History(np.array([0.0, SECONDS]), force=np.array([0.0, force_N / 4]))
    steps = StepControl(times=tuple(SECONDS * LOADS_N / LOADS_N[-1]), max_cuts=2)
    return solve(quarter_problem(mesh, tissues, probe_of(footprint), history), steps, store="all"), axis


def probe_of(footprint: Footprint) -> Indenter:
    """The rectangle of a footprint, its longer side along x."""
    short, long = sorted((footprint.length_mm, footprint.width_mm))
    return Indenter("rectangle", short, ROUNDING_MM, edge=(1, 0, 0), measures={"longer_mm": long - short})


def quarter_problem(
    mesh: Mesh, tissues: Mapping[str, Material], indenter: Indenter, history: History
) -> Problem:
    """What presses a quarter that is mirrored at x = 0 and y = 0, on its bone; forces are a quarter."""
    x, y, _ = mesh.points.T
    mirrors = (Support(np.flatnonzero(x < 1e-9), 0), Support(np.flatnonzero(y < 1e-9), 1))
    fixed, touched = mesh.node_sets["bone"], mesh.face_sets["skin"]
    return Problem(mesh, tissues, fixed, touched, indenter, history, supports=mirrors)


def layered_quarter(thickness_mm: Array, footprint: Footprint) -> tuple[Mesh, NDArray[np.intp]]:
    """The mesh (hexahedra, top at z = 0, x and y positive), and its nodes on the axis between layers."""
    half = (
        np.array([max(footprint.length_mm, footprint.width_mm), min(footprint.length_mm, footprint.width_mm)])
        / 2
    )
    sides = [
        np.concatenate([np.linspace(0.0, h - ROUNDING_MM, ACROSS), h + np.array([0.0, *BEYOND_MM])])
        for h in half
    ]
    ends = -np.concatenate([[0.0], np.cumsum(thickness_mm)])
    lines = []
    for number, (top, bottom) in enumerate(pairwise(ends)):
        if number == len(thickness_mm) - 1:
            heights = RATIO ** np.arange(DEEPEST)
        else:
            heights = np.ones(max(round((top - bottom) / LAYER_MM), 2))
        lines.append(top - (top - bottom) * np.cumsum(heights) / heights.sum())
    z = np.concatenate([[0.0], *lines])[::-1]
    points, corners = build_boxes(*sides, z)
    names = tuple(f"layer{i + 1}" for i in range(len(thickness_mm)))
    depth = -points[corners][:, :, 2].mean(axis=1)
    regions = np.searchsorted(np.cumsum(thickness_mm)[:-1], depth)
    mesh = Mesh(points, corners[:, HEX], "hex8", regions, names)
    top_faces = mesh.faces_where(lambda p: p[:, 2] > -1e-9)
    axis = [int(np.argmin(np.linalg.norm(points - [0, 0, height], axis=1))) for height in ends]
    sets = {"bone": np.flatnonzero(points[:, 2] < z[0] + 1e-9)}, {"skin": top_faces}
    return Mesh(points, corners[:, HEX], "hex8", regions, names, *sets), np.array(axis)


def read_compressions(result: Result, axis: NDArray[np.intp], force_N: float) -> tuple[Array, Array]:
    """Force (k,) of the whole block, N, and compression (k, l) of every layer on the axis, mm."""
    down = -np.array([state.u[axis, 2] for state in result.states])
    force = np.array([state.time for state in result.states]) * force_N / SECONDS
    return force, down[:, :-1] - down[:, 1:]


@dataclass(frozen=True)
class SolvedDesign:
    """Simulations: inputs (k, 7), logarithms of three thicknesses (mm), two ratios, m, force at `C_MPA` (N).

    ``strain (k, 3)`` of the layers; ``run (k,)``: number of the simulation.
    """

    inputs: Array
    strain: Array
    run: NDArray[np.intp]

    @classmethod
    def simulate(cls, footprint: Footprint, legs_mm: Array, runs: int, file: Path, seed: int) -> SolvedDesign:
        """What ``file`` holds already, and what is missing of ``runs`` simulations.

        ``legs_mm (n, 3)``: thicknesses of legs, of whose range the design is.
        """
        shares = qmc.Sobol(6, seed=seed).random_base2(6)[:runs]
        low, high = np.log(np.array([*RATIOS, EXPONENTS])).T
        others = np.exp(low + shares[:, 3:] * (high - low))
        share = QUANTILES[0] + shares[:, :3] * (QUANTILES[1] - QUANTILES[0])
        thickness = np.stack([np.quantile(legs_mm[:, k], share[:, k]) for k in range(3)], axis=1)
        design = (
            cls.read(file) if file.exists() else cls(np.zeros((0, 7)), np.zeros((0, 3)), np.zeros(0, np.intp))
        )
        for number in range(int(design.run.max(initial=-1)) + 1, runs):
            of_run = np.array([*thickness[number], *others[number]])
            moduli = C_MPA * np.array([*of_run[3:5], 1.0])
            force, pressed = read_compressions(
                *press_layers(of_run[:3], footprint, moduli, of_run[5], LOADS_N[-1]), LOADS_N[-1]
            )
            inputs = np.column_stack([np.tile(np.log(of_run), (len(force), 1)), np.log(force)])
            design = cls(
                np.vstack([design.inputs, inputs]),
                np.vstack([design.strain, pressed / of_run[:3]]),
                np.append(design.run, np.full(len(force), number)),
            )
            np.savez(file, inputs=design.inputs, strain=design.strain, run=design.run)
        return design

    @classmethod
    def read(cls, file: Path) -> SolvedDesign:
        with np.load(file) as stored:
            return cls(stored["inputs"], stored["strain"], stored["run"])

    def of(self, chosen: NDArray[np.bool_]) -> SolvedDesign:
        return SolvedDesign(self.inputs[chosen], self.strain[chosen], self.run[chosen])

    def leave_out(self, footprint: Footprint) -> Array:
        """Root mean square error (3,) in mm where one simulation is interpolated from the others."""
        thickness, moduli = np.exp(self.inputs[:, :3]), C_MPA * np.exp(self.inputs[:, 3:5])
        moduli = np.column_stack([moduli, np.full(len(moduli), C_MPA)])
        off = np.empty_like(self.strain)
        for number in np.unique(self.run):
            out = self.run == number
            inputs, force = self.inputs[out], np.exp(self.inputs[out, 6:])
            linear = (
                Layers.under(footprint, thickness[out]).compressions(moduli[out]) * force / thickness[out]
            )
            probe = SolvedFootprint(footprint, self.of(~out), 1.0)
            off[out] = (probe.strains(inputs, linear) - self.strain[out]) * thickness[out]
        used = (self.inputs[:, 6] > np.log(LOADS_N[1])) & (self.inputs[:, 6] < np.log(LOADS_N[-1]))
        return np.asarray(np.sqrt(np.mean(off[used] ** 2, axis=0)))


class SolvedFootprint:
    """A probe on layers by the interpolated solver; what `Footprint` is to linear theory.

    Parameters
    ----------
    m : exponent of Ogden's law of every layer.
    """

    def __init__(self, footprint: Footprint, design: SolvedDesign, m: float) -> None:
        self.footprint, self.m, self.inputs = footprint, m, design.inputs
        self.middle, self.spread = design.inputs.mean(axis=0), design.inputs.std(axis=0)
        scaled = self._scaled(design.inputs)
        thickness, ratios = np.exp(design.inputs[:, :3]), np.exp(design.inputs[:, 3:5])
        moduli = C_MPA * np.column_stack([ratios, np.ones(len(ratios))])
        linear = Layers.under(footprint, thickness).compressions(moduli) * np.exp(design.inputs[:, 6:])
        mean = self._mean(scaled, linear / thickness)
        self.trend = np.linalg.lstsq(mean, design.strain, rcond=None)[0]
        kernel = self._kernel(scaled, scaled) + NUGGET * np.eye(len(scaled))
        self.weights = np.linalg.solve(kernel, design.strain - mean @ self.trend)
        self.known = scaled

    def under(self, thickness_mm: Array, force_N: Array) -> SolvedLayers:
        """Layers (n, 3) or, with skin and fat as one, (n, 2) under this probe."""
        return SolvedLayers(self, thickness_mm, force_N)

    def strains(self, inputs: Array, linear: Array) -> Array:
        """(n, 3) at inputs (n, 7), where linear theory has strains ``linear`` (n, 3)."""
        scaled = self._scaled(inputs)
        return np.asarray(
            self._mean(scaled, linear) @ self.trend + self._kernel(scaled, self.known) @ self.weights
        )

    def _scaled(self, inputs: Array) -> Array:
        return (inputs - self.middle) / self.spread

    def _kernel(self, a: Array, b: Array) -> Array:
        return np.asarray(np.exp(-cdist(a / LENGTHS, b / LENGTHS, "sqeuclidean") / 2))

    def _mean(self, scaled: Array, linear: Array) -> Array:
        return np.column_stack([np.ones(len(scaled)), scaled, linear / np.hypot(1.0, linear / SOFTENED)])


class SolvedLayers:
    """n places under one probe and their forces; as `Layers`, for those forces alone."""

    def __init__(self, probe: SolvedFootprint, thickness_mm: Array, force_N: Array) -> None:
        self.probe, self.force_N, self.merged = probe, force_N, thickness_mm.shape[1] == 2
        if self.merged:
            skin = np.clip(SKIN_SHARE * thickness_mm[:, 0], *SKIN_MM)
            thickness_mm = np.column_stack([skin, thickness_mm[:, 0] - skin, thickness_mm[:, 1]])
        self.thickness_mm = thickness_mm
        self.linear = Layers.under(probe.footprint, thickness_mm)

    def compressions(self, shear_moduli: Array) -> Array:
        """Compression of each layer on the axis, in mm per N, for moduli in MPa."""
        moduli = shear_moduli[:, [0, 0, 1]] if self.merged else shear_moduli
        scale = moduli[:, -1:] / C_MPA
        force = self.force_N[:, None]
        ratios = moduli[:, :2] / moduli[:, 2:]
        inside = np.clip(ratios, *RATIOS.T)
        load = force / scale
        least = np.clip(load, LOADS_N[0], LOADS_N[-1])
        # Beyond the design a strain follows its own modulus, and all follow the force.
        linear = self.linear.compressions(C_MPA * np.column_stack([inside, np.ones(len(inside))])) * least
        inputs = np.column_stack(
            [
                np.log(self.thickness_mm),
                np.log(inside),
                np.full(len(moduli), np.log(self.probe.m)),
                np.log(least),
            ]
        )
        strain = self.probe.strains(inputs, linear / self.thickness_mm) * load / least
        strain[:, :2] *= inside / ratios
        found = strain * self.thickness_mm / force
        return np.column_stack([found[:, 0] + found[:, 1], found[:, 2]]) if self.merged else found
