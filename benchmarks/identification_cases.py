"""A small study with known truth, and the ways in which its files are made wrong.

The limb is a stump of 90 mm around one bone, so that a simulation with derivatives takes about a second.
Its records come from other meshes (edges of 3 mm instead of 6, finer surfaces), another element and more
steps than the study has, with 0.05 N of noise; what is true of them is in ``truth.json``.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.sites.sites import compute_indenter_axis, project_to_skin
from limbfit.anatomy.surfaces.surfaces import Anatomy, save_anatomy
from limbfit.fe import StepControl, solve
from limbfit.indentation import Parameters, SiteModel, build_problem
from limbfit.phantom.build import draw_true_parameters
from limbfit.phantom.geometry import extract_contour
from limbfit.phantom.robot import HEADER, Ramp, record
from limbfit.study import IndenterTable

Array = NDArray[np.float64]

CUT_MM, NOISE_N, PENALTY_PER_MM = 90.0, 0.05, 150.0
INDENTER = IndenterTable(width_mm=16.0, edge_radius_mm=4.0)
TRUE_ELEMENT, TRUE_STEPS = (
    "tet10g8p0",
    StepControl(load_steps=8, unload_steps=6, penalty=PENALTY_PER_MM, hold_penalty=True),
)
TRUE_MESH = MeshSettings(edge_near_mm=3.0, edge_far_mm=30.0, near_radius_mm=12.0, growth=0.8, flatness=1.8)
TRUE_SPACING_MM, STUDY_SPACING_MM = 2.0, 3.5  # at which the surfaces of truth and study are sampled


@dataclass(frozen=True)
class Stump:
    """A limb along z (anterior: -y) with a dome below and a rod of bone before its middle; mm."""

    distal: float = 28.0
    proximal: float = 34.0
    dome: float = 26.0
    bone_radius: float = 8.0
    bone_offset: float = 13.0

    def radius(self, z: Array) -> Array:
        return self.distal + (self.proximal - self.distal) * z / CUT_MM

    def skin(self, p: Array) -> Array:
        """Negative inside, about the distance; at points (..., 3)."""
        r, z = self.radius(p[..., 2]), p[..., 2]
        around = np.hypot(p[..., 0], p[..., 1])
        below = np.clip(self.dome - z, 0.0, None) / self.dome
        return np.where(z < self.dome, (np.hypot(around / r, below) - 1) * r, around - r)

    def bone(self, p: Array) -> Array:
        above = p[..., 2] - np.clip(p[..., 2], 22.0, None)
        return np.sqrt(p[..., 0] ** 2 + (p[..., 1] + self.bone_offset) ** 2 + above**2) - self.bone_radius

    def anatomy(self, spacing: float) -> Anatomy:
        skin = extract_contour(self.skin, (-45.0, -45.0, -5.0), (45.0, 45.0, CUT_MM), spacing)
        bone = extract_contour(self.bone, (-30.0, -40.0, 5.0), (30.0, 30.0, CUT_MM + 6.0), spacing / 1.5)
        return Anatomy(skin, {"tibia": bone}, np.array([0.0, 0.0, CUT_MM]), np.array([0.0, 0.0, 1.0]))

    def at(self, degrees: float, z: float) -> Array:
        """The skin at an angle from anterior and a height."""
        turn, r = np.radians(degrees), self.radius(np.array(z))
        return np.array([r * np.sin(turn), -r * np.cos(turn), z])


@dataclass(frozen=True)
class Spot:
    """A site: degrees from anterior, height and depth in mm, speed in mm/s."""

    name: str
    region: str
    degrees: float
    height: float
    depth: float
    speed: float
    fitted: bool = True

    @property
    def ramp(self) -> Ramp:
        return Ramp(self.depth, self.speed)


SPOTS = (
    Spot("1", "anterior", 0.0, 50.0, 3.0, 0.95),
    Spot("2", "medial", 90.0, 50.0, 5.0, 0.97),
    Spot("3", "posterior", 180.0, 60.0, 6.0, 0.93),
    Spot("4", "lateral", -50.0, 62.0, 4.0, 0.99),
    Spot("5", "anterior", 35.0, 66.0, 3.5, 0.96, fitted=False),
    Spot("6", "posterior", -140.0, 45.0, 5.5, 0.98, fitted=False),
)
# Another person's limb, and this one with all moduli twice as large, at a fitted and a held-out site.
FOREIGN = {"other": (Stump(25.0, 37.0, 24.0, 7.0, 10.0), 1, 1.0), "double": (Stump(), 0, 2.0)}
FOREIGN_SITES = ("3", "6")


def parameters_of(seed: int, stiffer: float = 1.0) -> Parameters:
    """The phantom's tissues of a seed, their moduli times a factor."""
    return {name: {**v, "c_kPa": stiffer * v["c_kPa"]} for name, v in draw_true_parameters(seed).items()}


def make_records(folder: Path, stump: Stump, parameters: Parameters, spots: tuple[Spot, ...]) -> None:
    """What the robot writes at some sites of a limb, one CSV each."""
    folder.mkdir(parents=True, exist_ok=True)
    anatomy = stump.anatomy(TRUE_SPACING_MM)
    base = build_base_mesh(anatomy, TRUE_MESH)
    for spot in spots:
        file = folder / f"{spot.name}.csv"
        if file.is_file():
            continue
        position, _ = project_to_skin(anatomy, stump.at(spot.degrees, spot.height))
        axis = compute_indenter_axis(anatomy.skin, position, INDENTER.width_mm)
        mesh, _ = mesh_site(anatomy, position, axis, TRUE_MESH, base)
        place, along = tuple(map(float, position)), tuple(map(float, axis))
        model = SiteModel(spot.name, Path(), "", place, along, *spot.ramp.knots, indenter=INDENTER)
        problem = replace(build_problem(model, mesh, parameters), element=TRUE_ELEMENT)
        result = solve(problem, steps=TRUE_STEPS)
        if not result.completed:
            raise SystemExit(f"the truth of site {spot.name} could not be simulated: {result.reason}")
        random = np.random.default_rng([8, int(spot.name)])
        made = record(spot.ramp, result.force_at, random)
        more = np.sqrt(NOISE_N**2 - made.force_noise**2) * random.standard_normal(made.force.size)
        replace(made, force=made.force + more).write(file)


HEAD = f"""\
[study]
name = "stump with known truth"

[surfaces]
skin = "limb/skin.stl"
bones = {{ tibia = "limb/bone-tibia.stl" }}

[indenter]
width_mm = {INDENTER.width_mm}
edge_radius_mm = {INDENTER.edge_radius_mm}

[solver]
penalty_per_mm = {PENALTY_PER_MM}
load_steps = 5
unload_steps = 4

[mesh]
edge_near_mm = 6.0
edge_far_mm = 30.0
near_radius_mm = 10.0
growth = 1.2
flatness = 2.0

[calibration]
relative_tolerance = 0.01

[execution]
workers = 1
"""


def write_study(folder: Path, sites: Mapping[str, Mapping[str, Any]], more: str = "") -> None:
    """``study.toml`` of sites (positions, traces, perhaps axes), with further tables."""
    text = HEAD + more
    for name, site in sites.items():
        text += f'\n[[sites]]\nname = "{name}"\n'
        text += "".join(f"{key} = {json.dumps(value)}\n" for key, value in site.items())
    (folder / "study.toml").write_text(text, encoding="utf-8")


def true_sites() -> dict[str, dict[str, Any]]:
    """The sites' tables as they should be."""
    return {
        spot.name: {
            "region": spot.region,
            "fitted": spot.fitted,
            "trace": f"traces/{spot.name}.csv",
            "position": Stump().at(spot.degrees, spot.height).tolist(),
        }
        for spot in SPOTS
    }


def make_study(folder: Path) -> Path:
    """The study in ``folder``, made unless it is there; what was begun is gone on with."""
    if (folder / "truth.json").is_file():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    save_anatomy(folder / "limb", Stump().anatomy(STUDY_SPACING_MM))
    make_records(folder / "traces", Stump(), parameters_of(0), SPOTS)
    foreign = tuple(spot for spot in SPOTS if spot.name in FOREIGN_SITES)
    for name, (stump, seed, stiffer) in FOREIGN.items():
        make_records(folder / name, stump, parameters_of(seed, stiffer), foreign)
    write_study(folder, true_sites())
    truth = {"parameters": parameters_of(0), "noise_N": NOISE_N, "mesh": asdict(TRUE_MESH)}
    (folder / "truth.json").write_text(json.dumps(truth | {"element": TRUE_ELEMENT}, indent=1))
    return folder


Sites = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """A corruption: the sites that it concerns, words of a cause that would name it, what it does."""

    name: str
    sites: tuple[str, ...]
    causes: tuple[str, ...]
    change: Callable[[Path, Sites], None]


def swapped(one: str, other: str) -> Case:
    def change(folder: Path, sites: Sites) -> None:
        first, second, aside = (folder / "traces" / f"{name}.csv" for name in (one, other, "aside"))
        first.rename(aside)
        second.rename(first)
        aside.rename(second)

    return Case(f"names {one} and {other} swapped", (one, other), ("swapped",), change)


def in_unit(site: str, what: str, factors: tuple[float, float, float], *causes: str) -> Case:
    """The columns time, displacement and force of a record times factors."""

    def change(folder: Path, sites: Sites) -> None:
        file = folder / "traces" / f"{site}.csv"
        table = np.loadtxt(file, delimiter=",", skiprows=1) * factors
        np.savetxt(file, table, fmt="%.7g", delimiter=",", header=HEADER, comments="")

    return Case(f"site {site} {what}", (site,), causes, change)


def tilted(site: str, degrees: float) -> Case:
    """The axis turned about the limb's own, as that of a neighbour would be."""

    def change(folder: Path, sites: Sites) -> None:
        x, y, _ = sites[site]["position"]
        inward = -np.array([x, y]) / np.hypot(x, y)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = np.array([[c, -s], [s, c]]) @ inward
        sites[site]["axis"] = [*turned.tolist(), 0.0]

    return Case(f"axis of site {site} turned by {degrees:g} degrees", (site,), ("axis",), change)


def moved(site: str, mm: float, way: str) -> Case:
    """The place moved along the skin: ``around`` the limb or ``along`` it."""

    def change(folder: Path, sites: Sites) -> None:
        spot = next(spot for spot in SPOTS if spot.name == site)
        turn = np.degrees(mm / Stump().radius(np.array(spot.height))) if way == "around" else 0.0
        height = spot.height + (mm if way == "along" else 0.0)
        sites[site]["position"] = Stump().at(spot.degrees + turn, height).tolist()

    return Case(f"site {site} moved by {mm:g} mm {way} the limb", (site,), ("another place",), change)


def foreign(site: str, source: str, words: str) -> Case:
    """The record of a site replaced by that of another limb."""

    def change(folder: Path, sites: Sites) -> None:
        (folder / "traces" / f"{site}.csv").write_bytes((folder / source / f"{site}.csv").read_bytes())

    return Case(f"site {site} of {words}", (site,), ("limb",), change)


KGF, LBF = 1 / 9.80665, 1 / 4.44822
CLEAN = Case("clean", (), (), lambda folder, sites: None)
# Corruptions of held-out sites leave the fit as it is: they cost a prediction only.
WRONG = (
    CLEAN,
    swapped("3", "6"),
    swapped("1", "5"),
    swapped("5", "6"),
    *(in_unit(s, "in kgf", (1, 1, KGF), "in kgf") for s in ("6", "3", "1")),
    *(in_unit(s, "in lbf", (1, 1, LBF), "in lbf") for s in ("6", "2")),
    *(in_unit(s, "in N taken for kgf", (1, 1, 1 / KGF), "multiplied by 9.81") for s in ("5",)),
    *(in_unit(s, "with displacement in cm", (1, 0.1, 1), "in cm") for s in ("6", "2")),
    *(in_unit(s, "with time in ms", (1000, 1, 1), "in ms") for s in ("5", "3")),
    *(tilted(s, 40.0) for s in ("6", "1")),
    moved("5", 20.0, "around"),
    moved("6", 20.0, "along"),
    moved("1", 20.0, "around"),
    moved("3", -20.0, "along"),
    *(foreign(s, "double", "a limb twice as stiff") for s in ("6", "3")),
    *(foreign(s, "other", "another limb") for s in ("6", "3")),
    swapped("1", "3"),
    swapped("2", "3"),
    swapped("2", "4"),
)
