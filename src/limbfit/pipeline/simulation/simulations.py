"""Simulations of a study, never done twice: kept on disk as they finish, keyed by what decides them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...execution import Executor
from ...extensions import compute_extensions_digest
from ...fe import SimulationWarning
from ...indentation import (
    Simulation,
    SimulationJob,
    SiteModel,
    simulate,
)
from ..engine.context import Context
from ..engine.digests import code_digest, compute_digest
from ..engine.storage import write_atomically
from ..engine.store import EARLIER, RUNS

CURVE_POINTS = 81  # times, about, at which measured and simulated force are compared


class SimulationCache:
    """Finished simulations in ``folder``, one file each.

    ``also`` are folders of earlier runs, beside those of interrupted attempts: what is found there is copied,
    since they may be replaced.
    ``work`` does a job; what it tells beyond `simulate` is in the simulation's facts.
    """

    def __init__(
        self,
        folder: Path,
        also: Sequence[Path] = (),
        work: Callable[[SimulationJob], Simulation] = simulate,
    ) -> None:
        self.folder, self.work = folder, work
        self.places = (folder, folder.parent / EARLIER, *also)
        folder.mkdir(parents=True, exist_ok=True)

    def run(
        self, jobs: Sequence[SimulationJob], executor: Executor, again: bool = False
    ) -> Iterator[Simulation]:
        """The jobs' simulations, in order; those not found are done on the executor, once each, and kept.

        ``again``: those that failed are tried once more.
        """
        found = {job: kept for job in dict.fromkeys(jobs) if (kept := self._find(job)) is not None}
        if again:
            found = {job: kept for job, kept in found.items() if kept.completed}
        missing = [job for job in dict.fromkeys(jobs) if job not in found]
        made = executor.map(self.work, missing, keys=[job.model.name for job in missing], on_lost=_build_lost)
        for job in jobs:
            if job not in found:
                simulation = found[job] = next(made)
                if not simulation.facts.get("lost"):  # the machine's fault: another run tries it again
                    self._keep(job, simulation)
            yield found[job]

    def example(self) -> Simulation | None:
        """Any kept simulation, for what they all have in common; None where there is none."""
        file = next(self.folder.glob("*.npz"), None)
        return None if file is None else _load(file)

    def __len__(self) -> int:
        return len(list(self.folder.glob("*.npz")))

    def with_sensitivities(self) -> int:
        """How many of the kept simulations have derivatives."""
        return sum(_load(file).jacobian is not None for file in self.folder.glob("*.npz"))

    def _find(self, job: SimulationJob) -> Simulation | None:
        name = f"{compute_job_digest(job)}.npz"
        for place in self.places:
            if (place / name).is_file():
                if place != self.folder:
                    with write_atomically(self.folder / name) as stream:
                        stream.write((place / name).read_bytes())
                return _load(self.folder / name)
        return None

    def _keep(self, job: SimulationJob, simulation: Simulation) -> None:
        with write_atomically(self.folder / f"{compute_job_digest(job)}.npz") as stream:
            arrays = {"force_N": simulation.force_N}
            if simulation.jacobian is not None:
                arrays["jacobian"] = simulation.jacobian
            if simulation.observed.size:
                arrays["observed"] = simulation.observed
            if simulation.observed_jacobian is not None:
                arrays["observed_jacobian"] = simulation.observed_jacobian
            facts = {
                "site": simulation.site,
                "completed": simulation.completed,
                "reason": simulation.reason,
                "penetration_mm": simulation.penetration_mm,
                "facts": simulation.facts,
                "doubts": [asdict(doubt) for doubt in simulation.doubts],
            }
            np.savez(stream, facts=json.dumps(facts), **arrays)  # type: ignore[arg-type]


def _build_lost(job: SimulationJob, reason: str) -> Simulation:
    """A failed simulation in place of one whose worker died or went over its limits."""
    n, site = len(job.times_s), job.model.name
    slopes = np.zeros((n, len(job.parameters))) if job.sensitivities else None
    facts = {"lost": True, "element": "", "steps": 0, "newton_iterations": 0, "cuts": 0}
    nothing = np.zeros((job.model.gauges, n))
    return Simulation(site, np.zeros(n), slopes, False, reason, 0.0, facts, observed=nothing)


def _load(file: Path) -> Simulation:
    with np.load(file, allow_pickle=False) as stored:
        facts: dict[str, Any] = json.loads(str(stored["facts"]))
        jacobian = stored.get("jacobian")
        doubts = tuple(SimulationWarning(**one) for one in facts.pop("doubts"))
        return Simulation(
            force_N=stored["force_N"],
            jacobian=jacobian,
            doubts=doubts,
            observed=stored.get("observed", np.zeros((0, 0))),
            observed_jacobian=stored.get("observed_jacobian"),
            **facts,
        )


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


def find_newest_simulations(folder: Path, sites: Sequence[str]) -> dict[str, Simulation]:
    """The last kept simulation of each of the sites, of those that have one, while a stage goes on."""
    found: dict[str, Simulation] = {}
    files = [(file.stat().st_mtime_ns, file) for file in folder.glob("*.npz")]
    for _, file in sorted(files, reverse=True):
        if len(found) == len(sites):
            break
        simulation = _load(file)
        if simulation.site in sites:
            found.setdefault(simulation.site, simulation)
    return found
