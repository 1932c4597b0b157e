"""The true limb of `protocols.py`: its records, and the studies that are made of them."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from identification_cases import (
    HEAD,
    INDENTER,
    NOISE_N,
    SPOTS,
    STUDY_SPACING_MM,
    TRUE_ELEMENT,
    TRUE_STEPS,
    Spot,
    Stump,
    parameters_of,
)
from scipy.interpolate import interp1d

from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.sites.sites import compute_indenter_axis, project_to_skin
from limbfit.anatomy.surfaces.surfaces import save_anatomy
from limbfit.fe import solve
from limbfit.indentation import (
    SiteModel,
    build_problem,
    choose_points_around,
    observe_result,
    place_waves_under,
    read_indenter,
)
from limbfit.mesh import Mesh, find_gauges_along, read_vtu, write_vtu
from limbfit.phantom.robot import (
    CLEARANCE_MM,
    DISPLACEMENT_NOISE_MM,
    NOTHING,
    RATE_HZ,
    RobotRecord,
    SecondaryMeasurements,
    write_surface,
    write_ultrasound,
    write_waves,
)
from limbfit.pipeline.engine.store import write_json
from limbfit.study import IndenterTable

# Finer than the study's: within 0.5 % of the force of edges of 1.5 mm on surfaces of 1 mm.
TRUE_MESH = MeshSettings(edge_near_mm=1.8, edge_far_mm=12.0, near_radius_mm=12.0, growth=0.5, flatness=1.8)
TRUE_SPACING_MM = 1.5
SLOW = 0.96
BALL = IndenterTable(shape="sphere", width_mm=12.0)
BALL_TABLE = '\n[indenters.ball]\nshape = "sphere"\nwidth_mm = 12.0\n'
PRIORS = 'priors = "population"\n'
# At rest before an indenter moves (`acquire.pause_s` is longer: 5 s), and after it is back, s.
BEFORE_S, AFTER_S = 1.0, 0.4
TISSUES = ("skin", "muscle")


@dataclass(frozen=True)
class Take:
    """One record: where, with what, how fast and held for how long, and what is ``seen`` beside its force."""

    site: str
    speed: float = SLOW
    hold_s: float = 0.0
    ball: bool = False
    depth: float | None = None
    seen: SecondaryMeasurements = NOTHING

    @property
    def name(self) -> str:
        depth = "" if self.depth is None else f"-{self.depth:g}mm"
        return f"{self.site}-{'ball' if self.ball else 'punch'}-{self.speed:g}-{self.hold_s:g}s{depth}"

    @property
    def spot(self) -> Spot:
        return next(spot for spot in SPOTS if spot.name == self.site)

    @property
    def knots(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        depth = self.depth or self.spot.depth
        ramp = depth / self.speed
        if not self.hold_s:
            return (0.0, ramp, 2 * ramp), (0.0, depth, 0.0)
        return (0.0, ramp, ramp + self.hold_s, 2 * ramp + self.hold_s), (0.0, depth, depth, 0.0)


@dataclass(frozen=True)
class Limb:
    """The true limb of a seed, whose meshes and answers are kept in a folder."""

    folder: Path
    seed: int

    def _mesh(self, site: str) -> tuple[Mesh, tuple[float, ...], tuple[float, ...]]:
        file, place = self.folder / "truth" / f"{site}.vtu", self.folder / "truth" / f"{site}.json"
        if not place.is_file():
            anatomy = Stump().anatomy(TRUE_SPACING_MM)
            spot = Take(site).spot
            position, _ = project_to_skin(anatomy, Stump().at(spot.degrees, spot.height))
            axis = compute_indenter_axis(anatomy.skin, position, INDENTER.width_mm)
            mesh, _ = mesh_site(anatomy, position, axis, TRUE_MESH, build_base_mesh(anatomy, TRUE_MESH))
            write_vtu(mesh, file)
            write_json(place, {"position": list(map(float, position)), "axis": list(map(float, axis))})
        known = json.loads(place.read_text())
        return read_vtu(file), tuple(known["position"]), tuple(known["axis"])

    def answer(self, take: Take) -> dict[str, np.ndarray]:
        """Times from touch-down, true force, and what is seen beside it; simulated once."""
        more = "-more" if take.seen.surface or take.seen.shear_waves else ""
        file = self.folder / "truth" / f"{self.seed}-{take.name}{more}.npz"
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            np.savez(file, **self._simulated(take))
        with np.load(file) as stored:
            return dict(stored)

    def _simulated(self, take: Take) -> dict[str, np.ndarray]:
        mesh, position, axis = self._mesh(take.site)
        indenter = BALL if take.ball else INDENTER
        model = SiteModel(take.name, Path(), "", position, axis, *take.knots, indenter=indenter)
        gauges = find_gauges_along(mesh, np.array(position), np.array(axis))
        points, waves = np.zeros((0, 3)), ()
        if take.seen.surface or take.seen.shear_waves:
            points = choose_points_around(mesh, read_indenter(indenter, position, axis, None))
            waves = place_waves_under(model, mesh)
        model = replace(model, layers=tuple(one.region for one in gauges), waves=waves)
        model = replace(model, skin_points=tuple(map(tuple, points)))
        steps = replace(TRUE_STEPS, load_steps=12, unload_steps=20)  # holds take those of unloading
        problem = replace(build_problem(model, mesh, parameters_of(self.seed)), element=TRUE_ELEMENT)
        result = solve(problem, steps=steps, store="all")
        if not result.completed:
            raise SystemExit(f"the truth of {take.name} could not be simulated: {result.reason}")
        times = model.curve_times(2001)
        values, _ = observe_result(result, model, times)
        lost, moves, speeds = np.split(values, [len(gauges), len(values) - len(waves)])
        told = {f"compression_{one.region}": row for one, row in zip(gauges, lost)}
        told |= {f"thickness_{one.region}": np.array(one.thickness_mm) for one in gauges}
        told |= {f"speed_{one.tissue}": row for one, row in zip(waves, speeds)}
        told |= {"points": points, "moves": moves.reshape(len(points), 3, len(times))}
        return {"times": times, "force": result.force_at(times), **told}

    def write(self, folder: Path, take: Take) -> None:
        """What the robot writes of a record, and what is seen beside it."""
        found = self.answer(take)
        random = np.random.default_rng([self.seed, *take.name.encode()])
        clearance = random.uniform(*CLEARANCE_MM)
        approach = clearance / take.speed
        touch = BEFORE_S + approach
        knots_s, knots_mm = take.knots
        path_s = np.array([0.0, BEFORE_S, *(touch + t for t in knots_s), touch + knots_s[-1] + approach])
        path_mm = np.array([0.0, 0.0, *(clearance + d for d in knots_mm), 0.0])
        time = np.arange(0.0, path_s[-1] + AFTER_S, 1 / RATE_HZ)
        moved = np.interp(time, path_s, path_mm) + DISPLACEMENT_NOISE_MM * random.standard_normal(time.size)
        force = np.interp(time - touch, found["times"], found["force"], left=0.0, right=0.0)
        force = force + NOISE_N * random.standard_normal(time.size)
        made = RobotRecord(time, moved, force, clearance, touch, NOISE_N)
        folder.mkdir(parents=True, exist_ok=True)
        made.write(folder / f"{take.name}.csv")

        def at(name: str) -> Callable[[np.ndarray], np.ndarray]:
            return lambda t: np.interp(t, found["times"], found[name])

        if take.seen.ultrasound:
            layers = {one: (float(found[f"thickness_{one}"]), at(f"compression_{one}")) for one in TISSUES}
            write_ultrasound(folder / f"{take.name}-layers.csv", made, layers, random)
        if take.seen.surface:
            moves = interp1d(found["times"], found["moves"])
            own = found["points"], lambda t: moves(np.minimum(t, found["times"][-1]))
            write_surface(folder / f"{take.name}-surface.csv", made, *own, random)
        if take.seen.shear_waves:
            speeds = {one: at(f"speed_{one}") for one in TISSUES}
            write_waves(folder / f"{take.name}-waves.csv", made, speeds, random)


def write_case(
    folder: Path,
    limb: Limb,
    takes: Sequence[Take],
    edge_mm: float | None,
    prior: bool,
    held_out: Sequence[Take],
) -> None:
    """A study with these records of its fitted sites, and those that are ``held_out``."""
    every = (*takes, *held_out)
    save_anatomy(folder / "limb", Stump().anatomy(STUDY_SPACING_MM))
    text = HEAD.replace("edge_near_mm = 6.0", f"edge_near_mm = {edge_mm}")
    text = text.replace("load_steps = 5\nunload_steps = 4", "load_steps = 8\nunload_steps = 12")
    if edge_mm is None:  # a study that states nothing but its data
        text = HEAD[: HEAD.index("[solver]")] + "[calibration]\n"
    if prior:
        text = text.replace("[calibration]\n", f"[calibration]\n{PRIORS}")
    text += BALL_TABLE if any(take.ball for take in takes) else ""
    for spot in SPOTS:
        if any(take.site == spot.name for take in every):
            text += f'\n[[sites]]\nname = "{spot.name}"\nregion = "{spot.region}"\n'
            text += f"fitted = {json.dumps(spot.fitted)}\n"
            text += f"position = {Stump().at(spot.degrees, spot.height).tolist()}\n"
    for take in every:
        limb.write(folder / "traces", take)
        name = take.name.removeprefix(f"{take.site}-")
        text += f'\n[[records]]\nsite = "{take.site}"\nname = "{name}"\ntrace = "traces/{take.name}.csv"\n'
        text += 'indenter = "ball"\n' if take.ball else ""
        for key, end in (("ultrasound", "layers"), ("surface", "surface"), ("shear_waves", "waves")):
            text += f'{key} = "traces/{take.name}-{end}.csv"\n' if getattr(take.seen, key) else ""
    (folder / "study.toml").write_text(text, encoding="utf-8")
