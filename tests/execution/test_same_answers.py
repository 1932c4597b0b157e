"""A simulation's answer depends on its job alone: not on the order, the executor or the number of workers."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from layered import build_block_site, layered_block
from limbfit.execution import ProcessExecutor, SerialExecutor
from limbfit.indentation import SimulationJob, simulate
from limbfit.pipeline.commands.run import ensure_compiled
from limbfit.study import SolverTable

TISSUES = ("skin", "muscle")
PARAMETERS = (
    (5.0, 5.0, 1.0, 1.0, 5.0, 5.0, 1.0, 1.0),
    (4.2, 6.0, 1.5, 0.8, 4.2, 6.0, 1.5, 0.8),
    (8.8, 6.0, 2.0, 0.6, 4.45, 4.55, 2.95, 0.31),
)


@pytest.fixture(scope="module")
def jobs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blocks")
    steps = SolverTable(load_steps=5, unload_steps=3)
    mesh = layered_block((3.0, 12.0), TISSUES)
    models = [
        build_block_site(name, folder / f"{name}.vtu", mesh, depth, steps)
        for name, depth in (("a", 4), ("b", 5))
    ]
    times = tuple(np.linspace(0.0, models[0].knots_s[-1], 21))
    return [SimulationJob(model, TISSUES, p, times) for p in PARAMETERS for model in models]


def assert_equal(found, wanted):
    for one, other in zip(found, wanted, strict=True):
        assert one.completed
        assert np.array_equal(one.force_N, other.force_N)
        assert np.array_equal(one.jacobian, other.jacobian)


def test_the_order_of_simulations_changes_nothing(jobs):
    forwards = [simulate(job) for job in jobs[:4]]
    backwards = [simulate(job) for job in jobs[3::-1]]
    assert_equal(forwards, backwards[::-1])


def test_a_first_guess_is_the_job_s_own_and_changes_nothing_but_the_work(jobs):
    known = simulate(jobs[0])
    near = replace(jobs[0], parameters=tuple(1.05 * p for p in PARAMETERS[0]))
    warm = replace(near, starts=(jobs[0].parameters,))
    after_its_start = simulate(warm)
    cold = simulate(near)  # now this is the newest simulation from rest, and the start has to be done again
    without = simulate(warm)
    assert_equal([after_its_start], [without])
    assert_equal([simulate(jobs[0])], [known])
    assert after_its_start.facts["newton_iterations"] < 0.7 * cold.facts["newton_iterations"]
    assert after_its_start.force_N == pytest.approx(cold.force_N, abs=1e-4 * cold.force_N.max())


def test_the_way_to_an_answer_does_not_change_its_force(jobs):
    """Started from tissue that sinks in too far: its raised penalty went over, and 8e-4 of force with it."""
    deep = replace(jobs[1], parameters=PARAMETERS[2])
    stiffening = (1.0, 18.0, 0.02, 1.0) * 2
    cold, before = simulate(deep), simulate(replace(deep, parameters=stiffening))
    warm = simulate(replace(deep, starts=(stiffening,)))
    assert warm.force_N == pytest.approx(cold.force_N, abs=1e-4 * cold.force_N.max())
    assert [doubt.kind for doubt in before.doubts] == ["sunk"]
    assert len({one.facts["penalty_per_mm"] for one in (cold, before, warm)}) == 1


@pytest.mark.slow
def test_executors_and_numbers_of_workers_give_the_same_bits(jobs):
    ensure_compiled()  # as every command does before it solves
    keys = [job.model.name for job in jobs]
    found = []
    for executor in (SerialExecutor(), ProcessExecutor(1), ProcessExecutor(2)):
        with executor:
            found.append(list(executor.map(simulate, jobs, keys=keys)))
    with ProcessExecutor(2) as executor:
        found.append(list(executor.map(simulate, jobs[::-1]))[::-1])
    for other in found[1:]:
        assert_equal(other, found[0])


def test_records_are_the_same_bits_whatever_number_of_threads_numpy_is_given(study, tmp_path):
    for file in (study / "1.csv", study / "2.csv"):  # as long as real ones
        header, short = file.read_text().splitlines()[0], np.loadtxt(file, delimiter=",", skiprows=1).T
        times = np.linspace(short[0][0], short[0][-1], 5000)
        rows = [np.interp(times, short[0], row) for row in short]
        rows[-1] += 0.01 * np.random.default_rng(0).normal(size=len(times))
        np.savetxt(file, np.transpose(rows), delimiter=",", header=header, comments="")
    found = []
    for threads in ("1", "4"):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        folder = shutil.copytree(study, tmp_path / threads)
        command = [sys.executable, "-m", "limbfit", "run", str(folder), "--until", "traces"]
        subprocess.run(command, env=environment, check=True, capture_output=True)
        files = sorted((folder / "results" / "traces").glob("*.npy"))
        assert files
        found.append([file.read_bytes() for file in files])
    assert found[0] == found[1]
