"""Studies of one block, whose record, and what is seen beside it, come from the same mesh and element."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from layered import layered_block, store_blocks
from limbfit.execution import SerialExecutor
from limbfit.identify.uncertainty.uncertainty import Uncertainty
from limbfit.indentation import Parameters, Simulation, SimulationJob, SiteModel, simulate
from limbfit.mesh import Mesh, write_vtu
from limbfit.phantom.robot import Ramp, RobotRecord, record
from limbfit.pipeline.engine.context import Context
from limbfit.pipeline.identification.answer import (
    FineMeshCorrection,
    correct_to_fine_meshes,
    estimate_linearised,
)
from limbfit.pipeline.identification.calibrate import run_calibrate
from limbfit.pipeline.identification.predict import run_predict
from limbfit.pipeline.identification.search import RecordSimulator, build_problem
from limbfit.pipeline.records.records import RecordSet, load_records
from limbfit.pipeline.simulation.simulations import SimulationCache
from limbfit.study import Study, load_study

TRUTH = {
    "skin": {"c_kPa": 9.0, "m": 6.0, "gamma": 2.0, "tau_s": 0.6},
    "muscle": {"c_kPa": 4.5, "m": 4.5, "gamma": 3.0, "tau_s": 0.3},
}
TEXT = """
[study]
name = "a block"
[surfaces]
skin = "skin.stl"
{}
[mesh.coarse]
edge_near_mm = 6.0
[calibration]
max_iterations = 2
corrections = 1
[[sites]]
name = "a"
fitted = true
trace = "a.csv"
position = [0.0, 0.0, 0.0]
"""
PUNCH = """
[indenter]
width_mm = 10.0
edge_radius_mm = 2.0
[solver]
load_steps = 8
unload_steps = 8
penalty_per_mm = 100.0
"""
Made = tuple[RobotRecord, np.ndarray, np.random.Generator]  # and the times of its simulation, s


@dataclass(frozen=True)
class SeenBlock:
    """A block of skin over muscle, mm, ``half`` as wide, and how it is indented.

    ``wanted`` says of a model on its mesh what is seen; ``write`` writes it, of the simulation.
    """

    seen: str
    wanted: Callable[[SiteModel, Mesh], SiteModel]
    write: Callable[[Study, SiteModel, Simulation, Made], None]
    thickness: tuple[float, float] = (3.0, 9.0)
    half: float = 12.0
    growth: float = 3.0
    divisions: int = 4
    tools: str = PUNCH

    def mesh(self) -> Mesh:
        return layered_block(self.thickness, ("skin", "muscle"), self.half, 6, self.growth)

    def study(self, folder: Path, more: str = "") -> Study:
        for name in ("skin.stl", "a.csv", self.seen):
            (folder / name).touch()
        (folder / "study.toml").write_text(TEXT.format(self.tools) + more)
        return load_study(folder)

    def stored(self, folder: Path, more: str) -> Context:
        """A study with ``more`` said of its site, and what the stages before a calibration make."""
        mesh = self.mesh()

        def write(study: Study, model: SiteModel, truth: Parameters, random: np.random.Generator) -> None:
            write_vtu(mesh, folder / "truth.vtu")
            model = replace(model, mesh=folder / "truth.vtu", mesh_digest="truth", element=study.mesh.element)
            model, times = self.wanted(model, mesh), np.linspace(0.0, model.knots_s[-1], 201)
            job = SimulationJob(model, study.tissues, tuple(study.vector(truth)), tuple(times), False)
            found = simulate(job)
            ramp = Ramp(max(model.knots_mm), 0.96)
            made = record(ramp, lambda t: np.interp(t, times, found.force_N), random)
            made.write(study.path(Path("a.csv")))
            self.write(study, model, found, (made, times, random))

        study, n = self.study(folder, more), self.divisions
        store = store_blocks(study, {"a": (self.thickness, 3.0, True)}, TRUTH, n, n, write)
        for place in (store["mesh"], store["mesh"] / "coarse"):
            write_vtu(mesh, place / "a.vtu")
        return Context(study, store, SerialExecutor(), lambda event: None)

    def narrowed(self, folder: Path, more: str) -> "Narrowed":
        """What one ramp and ``more`` beside it tell: every interval is narrower than by force alone."""
        widths = []
        for name, said in (("force", ""), ("both", more)):
            (folder / name).mkdir()
            context = self.stored(folder / name, said)
            records, at, known = estimate_at_truth(context)
            widths.append(np.log(known.intervals_95[:, 1] / known.intervals_95[:, 0]))
        assert (widths[1] < widths[0]).all()
        assert {one.site_name for one in records.curves} == {"a"}  # left out together
        assert records.simulations == 1
        noise = known.residual_model.noise
        misfits = []
        for one, response, seen in zip(records.own[1:], at.responses[1:], noise[1:], strict=True):
            off = response.force_N - one.compared
            misfits.append(off @ np.linalg.solve(seen.covariance, off) / len(off))
        return Narrowed(context, records, misfits, widths[0], widths[1])


@dataclass(frozen=True)
class Narrowed:
    """What is known of a block at its true parameters, and how well what is seen beside the force fits.

    ``misfits`` are mean squares in the noise's own measure; ``by_force`` and ``by_both`` the logarithms of
    the ratios of the intervals' ends.
    """

    context: Context
    records: RecordSet
    misfits: list[float]
    by_force: np.ndarray
    by_both: np.ndarray

    def fit_and_predict(self) -> tuple[dict, list[dict]]:
        """The calibration's result, and what is predicted of each curve that is seen beside the force."""
        store = self.context.store
        for stage, run in (("calibrate", run_calibrate), ("predict", run_predict)):
            store[stage].mkdir()
            run(self.context, store[stage])
        (row,) = store.results.predict.to_plain()["sites"]
        return store.results.calibration.to_plain(), row["observed"]


def check_truth_within(intervals: dict) -> None:
    """Every true value lies within the 95 % interval of a calibration."""
    for tissue, values in TRUTH.items():
        for name, value in values.items():
            low, high = intervals[tissue][name]
            assert low <= value <= high, (tissue, name)


def estimate_at_truth(context: Context) -> tuple[RecordSet, FineMeshCorrection, Uncertainty]:
    """The records of a stored study, what is simulated of them at the true parameters, and what they tell."""
    study, problem = context.study, build_problem(context.study)
    records = load_records(context, study.recorded, secondary=True)
    cache, truth = SimulationCache(study.folder / "runs"), study.vector(TRUTH)
    simulator = RecordSimulator(problem, records, cache, context.executor, lambda text: None)
    at = correct_to_fine_meshes(simulator, truth)
    return records, at, estimate_linearised(simulator, truth, at)
