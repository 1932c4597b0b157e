"""The identification of `identification.py` where a drawn share of the simulations fails."""

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from identification_cases import SPOTS
from identification_copies import NAMES, Record, Study, cpu_s, outcome, quiet

from limbfit import load_study, run_study
from limbfit.errors import LimbfitError
from limbfit.execution import SerialExecutor, share_executor
from limbfit.fe import solve
from limbfit.indentation import Simulation, SimulationJob, build_problem, build_steps, to_parameters
from limbfit.mesh import read_vtu
from limbfit.pipeline.engine.digests import compute_digest
from limbfit.pipeline.engine.store import RUNS
from limbfit.pipeline.simulation.simulations import compute_job_digest
from limbfit.results.base import read_curves

# Newton iterations of a step, none of which may be halved: the largest with which a simulation stops early.
LIMITS = (5, 4, 3, 2, 1)


class Failing(SerialExecutor):
    """Runs jobs here, but a drawn share of the simulations with so few iterations that they stop early.

    What is drawn follows from a simulation's content, as with a real failure: asked again, it fails again.
    """

    def __init__(self, rate: float, seed: int) -> None:
        self.rate, self.seed = rate, seed

    def map(
        self,
        function: Callable[[Any], Any],
        jobs: Iterable[Any],
        keys: Sequence[str] | None = None,
        on_lost: Callable[[Any, str], Any] | None = None,
    ) -> Iterator[Any]:
        return (self._stopped(job) if self._fails(job) else function(job) for job in jobs)

    def _fails(self, job: Any) -> bool:
        drawn = isinstance(job, SimulationJob) and int(
            compute_digest(compute_job_digest(job), self.seed)[:8], 16
        )
        return drawn is not False and drawn < self.rate * 2**32

    def _stopped(self, job: SimulationJob) -> Simulation:
        """The simulation with a limit of iterations, as far as it comes."""
        model, times = job.model, np.array(job.times_s)
        parameters = to_parameters(np.array(job.parameters), job.tissues)
        problem = build_problem(model, read_vtu(model.mesh), parameters)
        for most in LIMITS:
            steps = replace(build_steps(model), max_iterations=most, max_cuts=0)
            result = solve(problem, steps=steps, store="peak")
            if not result.completed:
                break
        else:
            raise RuntimeError(f"site {model.name} completes with one iteration a step")
        slopes = np.zeros((times.size, len(job.parameters))) if job.sensitivities else None
        return Simulation(
            model.name, result.force_at(times), slopes, False, result.reason, 0.0, dict(result.statistics)
        )


def run_failing(study: Study, rate: float, seed: int) -> Record:
    """The identification with failures, beside that of ``clean``: parameters, and forces at all sites."""
    began = cpu_s()
    clean = study.clean()
    copy = study.copy(f"failures-{rate:g}-{seed}", study.made)
    told: Record = {"case": f"{100 * rate:g} % fail, draw {seed}", "refused": ""}
    try:
        with share_executor(Failing(rate, seed)):
            run_study(load_study(copy), until="predict", listener=quiet)
        told |= outcome(copy) | compared(copy, clean)
    except LimbfitError as error:
        told["refused"] = str(error)
    told |= simulated(copy)
    shutil.rmtree(copy)
    return told | {"cpu_s": cpu_s() - began}


def simulated(copy: Path) -> Record:
    """How many simulations an identification and its prediction kept, and how many of them failed."""
    stages = [copy / "results" / stage / RUNS for stage in ("calibrate", "predict")]
    files = {file.name: file for stage in stages for file in stage.glob("*.npz")}
    completed = [json.loads(str(np.load(file)["facts"]))["completed"] for file in files.values()]
    return {"simulations": len(completed), "failed": completed.count(False)}


def compared(copy: Path, clean: Path) -> Record:
    """Two identifications: ratios of parameters, largest difference of forces over the peak, in percent."""
    ours, theirs = outcome(copy), outcome(clean)
    forces, unknown = {}, []
    for spot in SPOTS:
        if ours["error_percent_by_site"][spot.name] is None:
            unknown.append(spot.name)
            continue
        one, other = (
            read_curves(folder / "results" / "predict" / f"{spot.name}.csv")["force_simulated_N"]
            for folder in (copy, clean)
        )
        forces[spot.name] = float(100 * np.abs(one - other).max() / other.max())
    ratios = np.array(ours["parameters"]) / np.array(theirs["parameters"])
    return {
        "parameter_ratios": dict(zip(NAMES, ratios.tolist())),
        "force_difference_percent": forces,
        "not_predicted": unknown,
        "error_undisturbed_percent": theirs["error_percent"],
        "evaluations_undisturbed": theirs["evaluations"],
    }


def line_failing(case: Record) -> str:
    head = f"{case['case']}: {case['failed']} of {case['simulations']} simulations failed"
    if case["refused"]:
        return f"{head}; refused: {case['refused']}"
    ratios = np.abs(np.log(list(case["parameter_ratios"].values())))
    worst = NAMES[int(ratios.argmax())]
    return (
        f"{head}; error {case['error_percent']:.3f} % ({case['error_undisturbed_percent']:.3f} %), "
        f"evaluations {case['evaluations']} ({case['evaluations_undisturbed']}), forces within "
        f"{max(case['force_difference_percent'].values()):.2f} %, {worst} differs most, by "
        f"{100 * np.expm1(ratios.max()):.1f} %; not predicted: {case['not_predicted'] or 'none'}; "
        f"{'; '.join(case['reasons'])}; {case['cpu_s']:.0f} s"
    )


def summary_failing(cases: Sequence[Record]) -> Record:
    ended = [case for case in cases if not case["refused"]]
    return {
        "runs": len(cases),
        "ended": len(ended),
        "failed_percent": 100
        * sum(c["failed"] for c in cases)
        / max(sum(c["simulations"] for c in cases), 1),
        "largest_force_difference_percent": max(
            (max(c["force_difference_percent"].values()) for c in ended), default=None
        ),
        "parameter_ratios": {
            name: [min(values), max(values)]
            for name in NAMES
            if (values := [case["parameter_ratios"][name] for case in ended])
        },
    }
