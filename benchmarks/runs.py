"""What running costs beside solving: schedulers, worker processes, memory and disk of simulations.

    python benchmarks/runs.py scheduler --tasks 1000
    python benchmarks/runs.py throughput --divisions 8 --rounds 3
    python benchmarks/runs.py simulation --divisions 13 --sites 4

``scheduler``: seconds per task of every executor, of jobs that do nothing and of jobs as large as real ones.
``throughput``: the same simulations at independent sites by one worker process and by two, in turn.
``simulation``: one site after the other in one worker: CPU time, largest memory, size on disk.
Sites are structured blocks of quadratic tetrahedra under the square punch; ``divisions`` cells along 60 mm.
With ``--json FILE`` the figures are also stored.
"""

import argparse
import json
import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from runs_jobs import TISSUES, answer, bind, measured, nothing, stored_fields

from limbfit.bench.timing import DEPTH, build_block_model, build_layered_block
from limbfit.execution import DaskExecutor, Executor, ProcessExecutor, SerialExecutor
from limbfit.indentation import SimulationJob, SiteModel, simulate
from limbfit.mesh import write_vtu
from limbfit.pipeline.simulation.simulations import CURVE_POINTS, SimulationCache
from limbfit.study import SolverTable
from limbfit.study.meshing import MeshTable

SOFT, STIFF = (6.0, 5.0, 1.5, 0.6, 4.0, 4.0, 1.5, 0.6), (9.0, 6.0, 2.0, 0.5, 4.0, 4.0, 3.0, 0.3)


def site(folder: Path, name: str, divisions: int) -> SiteModel:
    """A block as the mesh of a site; its lower face is fixed. In and out as the robot of the study does."""
    block = build_layered_block("tet10", divisions)
    low = np.flatnonzero(block.points[:, 2] <= -DEPTH)
    mesh = replace(block, node_sets={"fixed_bottom": low})
    write_vtu(mesh, folder / f"{name}.vtu")
    return build_block_model(name, folder / f"{name}.vtu", SolverTable(), MeshTable().element)


def job_of(model: SiteModel, parameters: tuple[float, ...], sensitivities: bool = True) -> SimulationJob:
    times = np.linspace(0.0, model.knots_s[-1], CURVE_POINTS)
    return SimulationJob(model, TISSUES, parameters, tuple(times.tolist()), sensitivities)


@contextmanager
def executors(workers: int) -> Iterator[dict[str, Executor]]:
    with ProcessExecutor(workers) as pool, DaskExecutor.from_queue("local", workers) as dask:
        yield {"in this process": SerialExecutor(), "processes": pool, "Dask": dask}


def scheduler(tasks: int, workers: int) -> list[dict[str, Any]]:
    """Seconds per task, wall and of this process's CPU, after a first map that starts the workers."""
    model = SiteModel("1", Path("/studies/patient/results/mesh/1.vtu"), "0" * 64, *[(0.0, 0.0, 1.0)] * 4)
    large = job_of(model, STIFF)
    kinds = {"nothing": (nothing, 0), "a simulation's job and answer": (answer, large)}
    rows = []
    with executors(workers) as all_of_them:
        for name, executor in all_of_them.items():
            for kind, (function, job) in kinds.items():
                list(executor.map(function, [job] * 4 * workers))
                wall, own = time.perf_counter(), time.process_time()
                list(executor.map(function, [job] * tasks, keys=[str(i % 9) for i in range(tasks)]))
                wall, own = time.perf_counter() - wall, time.process_time() - own
                rows.append(
                    {"executor": name, "job": kind, "ms": 1e3 * wall / tasks, "own_ms": 1e3 * own / tasks}
                )
    sizes = {
        "job_bytes": len(pickle.dumps((simulate, large))),
        "answer_bytes": len(pickle.dumps(answer(large))),
    }
    return [*rows, sizes]


def throughput(divisions: int, rounds: int) -> list[dict[str, Any]]:
    """Simulations per second of one worker and of two, each with one thread; first runs are not counted."""
    rows = []
    with tempfile.TemporaryDirectory() as folder, ProcessExecutor(1) as one, ProcessExecutor(2) as two:
        models = [site(Path(folder), str(i), divisions) for i in range(4)]
        jobs = [job_of(model, SOFT) for model in models] + [job_of(model, STIFF) for model in models]
        keys = [str(i % 2) for i in range(len(jobs))]  # two sites for each of two workers
        for executor in (one, two):
            list(executor.map(bind, range(executor.workers), keys[: executor.workers]))
            list(executor.map(simulate, jobs[:4], keys[:4]))
        for _ in range(rounds):
            wall, cpu = [], []
            for executor in (one, two):
                start = time.perf_counter()
                made = list(executor.map(measured, jobs, keys))
                wall.append(time.perf_counter() - start)
                cpu.append(sum(facts["cpu_s"] for _, facts in made))
            rows.append(
                {"one_s": wall[0], "two_s": wall[1], "one_cpu_s": cpu[0], "two_cpu_s": cpu[1]}
                | {"ratio": wall[0] / wall[1]}
            )
    return rows


def simulation(divisions: int, sites: int) -> list[dict[str, Any]]:
    """Sites in turn in one worker, each with derivatives, then without, as a calibration asks for them."""
    rows = []
    with tempfile.TemporaryDirectory() as name, ProcessExecutor(1) as executor:
        folder = Path(name)
        cache = SimulationCache(folder / "runs")
        for i in range(sites):
            model = site(folder, str(i), divisions)
            for sensitivities in (True, False):
                job = job_of(model, STIFF, sensitivities)
                ((made, facts),) = executor.map(measured, [job], [model.name])
                cache.keep(job, made)
                size = max((folder / "runs").glob("*.npz"), key=lambda file: file.stat().st_mtime_ns)
                rows.append(
                    {"site": i, "derivatives": sensitivities, "completed": made.completed}
                    | {"unknowns": made.facts["unknowns"], "mesh_kB": model.mesh.stat().st_size / 1e3}
                    | {"kept_kB": size.stat().st_size / 1e3, **facts}
                )
                print(rows[-1], flush=True)
        fields = folder / "fields.vtu"
        list(executor.map(stored_fields, [(model, STIFF, fields)], [model.name]))
        rows.append({"fields_kB": fields.stat().st_size / 1e3})
    return rows


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["scheduler", "throughput", "simulation"])
    parser.add_argument("--tasks", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--divisions", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--sites", type=int, default=4)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(words)
    if given.what == "scheduler":
        rows = scheduler(given.tasks, given.workers)
    elif given.what == "throughput":
        rows = throughput(given.divisions, given.rounds)
    else:
        rows = simulation(given.divisions, given.sites)
    for row in rows:
        print(
            "  ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
                for key, value in row.items()
            )
        )
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
