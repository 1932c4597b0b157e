"""Simulations of a study, never done twice: kept on disk as they finish, keyed by what decides them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ...execution import Executor
from ...extensions import compute_extensions_digest
from ...fe import SimulationWarning
from ...indentation import Simulation, SimulationJob, SiteModel, simulate
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest
from ..engine.store import RUNS, Arrays, Facts, ResultFiles, read_made

CURVE_POINTS = 81  # times, about, at which measured and simulated force are compared


class SimulationCache:
    """Finished simulations in ``folder``, one file each.

    ``also`` are folders of earlier runs (see `ResultFiles`). ``work`` does a job; what it tells beyond
    `simulate` is in the simulation's facts.
    """

    def __init__(
        self, folder: Path, also: Iterable[Path] = (), work: Callable[[SimulationJob], Simulation] = simulate
    ) -> None:
        self.kept, self.work = ResultFiles(folder, also), work

    def run(
        self, jobs: Sequence[SimulationJob], executor: Executor, again: bool = False
    ) -> Iterator[Simulation]:
        """The jobs' simulations, in order; those not found are done on the executor, once each, and kept.

        ``again``: those that failed are tried once more.
        """
        stored = {job: self.kept.find(compute_job_digest(job)) for job in dict.fromkeys(jobs)}
        found = {job: _to_simulation(*made) for job, made in stored.items() if made is not None}
        if again:
            found = {job: kept for job, kept in found.items() if kept.completed}
        missing = [job for job in stored if job not in found]
        made = executor.map(self.work, missing, keys=[job.model.name for job in missing], on_lost=_build_lost)
        for job in jobs:
            if job not in found:
                simulation = found[job] = next(made)
                if not simulation.facts.get("lost"):  # the machine's fault: another run tries it again
                    self.keep(job, simulation)
            yield found[job]

    def keep(self, job: SimulationJob, simulation: Simulation) -> None:
        """Store a simulation, as it may have been done elsewhere."""
        stated = {name: value for name, value in vars(simulation).items() if value is not None}
        stated["doubts"] = [asdict(doubt) for doubt in simulation.doubts]
        arrays = {name: value for name, value in stated.items() if isinstance(value, np.ndarray)}
        facts = {name: value for name, value in stated.items() if name not in arrays}
        self.kept.put(compute_job_digest(job), (facts, arrays))

    def load_all(self) -> list[Simulation]:
        """Every simulation that is kept in the folder."""
        files = self.kept.folder.glob("*.npz")
        return [_to_simulation(*made) for file in files if (made := read_made(file))]


def _build_lost(job: SimulationJob, reason: str) -> Simulation:
    """A failed simulation in place of one whose worker died or went over its limits."""
    n, site = len(job.times_s), job.model.name
    slopes = np.zeros((n, len(job.parameters))) if job.sensitivities else None
    facts = {"lost": True, "element": "", "steps": 0, "newton_iterations": 0, "cuts": 0}
    nothing = np.zeros((job.model.gauges, n))
    return Simulation(site, np.zeros(n), slopes, False, reason, 0.0, facts, observed=nothing)


def _to_simulation(facts: Facts, arrays: Arrays) -> Simulation:
    doubts = tuple(SimulationWarning(**one) for one in facts.pop("doubts"))
    return Simulation(**facts | {"jacobian": None} | dict(arrays), doubts=doubts)


def compute_job_digest(job: SimulationJob) -> str:
    """What decides a simulation, code included, wherever its mesh file happens to lie."""
    model = {key: value for key, value in vars(job.model).items() if key not in ("mesh", "extensions")}
    indenter = job.model.indenter.model_dump(exclude={"file"})  # its digest is in the model
    clamps = None if job.model.clamps is None else job.model.clamps.model_dump()
    model["extensions_digest"] = compute_extensions_digest(job.model.extensions)
    model |= {"indenter": indenter, "steps": job.model.steps.model_dump(), "clamps": clamps}
    return compute_digest(
        code_digest(simulate),
        model,
        job.tissues,
        job.parameters,
        job.times_s,
        job.sensitivities,
        job.starts,
        job.nested_mm,
    )


def build_curve_job(model: SiteModel, tissues: tuple[str, ...], parameters: Iterable[float]) -> SimulationJob:
    """An indentation at flat ``parameters``, with derivatives, at the times of a curve."""
    times = model.curve_times(CURVE_POINTS)
    return SimulationJob(model, tissues, tuple(map(float, parameters)), tuple(map(float, times)))


def open_experiment_cache(context: Context, folder: Path) -> SimulationCache:
    """Simulations of the experiment in ``folder``; all others of the study count as done."""
    others = sorted(place for place in context.store.folder.glob(f"*/{RUNS}") if place.parent != folder)
    return SimulationCache(folder / RUNS, also=others)


def find_newest_simulation(folder: Path, site: str) -> Simulation | None:
    """The last kept simulation of a site, while a stage goes on; None where there is none."""
    files = [(file.stat().st_mtime_ns, file) for file in folder.glob("*.npz")]
    kept = (read_made(file) for _, file in sorted(files, reverse=True))
    simulations = (_to_simulation(*made) for made in kept if made is not None)
    return next((one for one in simulations if one.site == site), None)
