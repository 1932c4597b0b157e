"""The benchmarks measure what they say, and fail in words."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from limbfit.bench.parity import ALL_CASES, CUBES, SOCKET, bench_febio_parity, find_reference, load_case
from limbfit.bench.timing import (
    bench_forward,
    bench_scaling,
    bench_socket,
    build_layered_block,
    build_punched_block,
    choose_divisions,
    fit_exponent,
    measure_max_rss_MB,
    run_in_fresh_process,
    solve_timed,
)
from limbfit.cli import main
from limbfit.errors import InputError
from limbfit.fe import ELEMENTS, StepControl, System
from limbfit.mesh import cell_volumes, check, measure_quality
from reference import REFERENCE, recorded


def silent(done: int, total: int, text: str) -> None:
    assert 0 <= done <= total
    assert text


@pytest.mark.parametrize("cell_type", ["tet4", "tet10", "hex8"])
def test_block_fills_its_box(cell_type):
    mesh = build_layered_block(cell_type, 8)
    check(mesh)
    found = measure_quality(mesh)
    assert found.region_volumes_mm3["skin"] == pytest.approx(60 * 60 * 3)
    assert found.region_volumes_mm3["muscle"] == pytest.approx(60 * 60 * 27)
    skin = mesh.points[mesh.face_sets["skin"]]
    assert (skin[:, :, 2] == 0.0).all()
    normal = np.cross(skin[:, 1] - skin[:, 0], skin[:, 2] - skin[:, 0])[:, 2]
    assert (normal > 0).all()
    assert normal.sum() / (1 if cell_type == "hex8" else 2) == pytest.approx(3600.0)
    assert (mesh.points[mesh.node_sets["bottom"], 2] == -30.0).all()
    assert cell_volumes(mesh).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize("element", list(ELEMENTS))
def test_a_block_of_as_many_unknowns_as_wanted(element):
    divisions = choose_divisions(element, 3000)
    assert System(build_punched_block(element, divisions)).unknowns >= 3000
    assert System(build_punched_block(element, divisions - 1)).unknowns < 3000


def test_exponent_of_a_power_law():
    rows = [{"unknowns": n, "seconds": 3e-7 * n**1.37} for n in (1000, 5000, 80_000)]
    assert fit_exponent(rows, "seconds") == pytest.approx(1.37)


def rss_after(megabytes: int) -> float:
    held = np.ones(megabytes * 131072)
    return measure_max_rss_MB() + 0.0 * held[0]


@pytest.mark.slow
def test_memory_is_that_of_the_process_alone():
    mine = np.ones(400 * 131072)
    small, large = (run_in_fresh_process(rss_after, 1, size) for size in (1, 200))
    assert small < 400 < measure_max_rss_MB()
    assert large - small == pytest.approx(199, abs=15)
    assert mine.all()


@pytest.mark.slow
def test_facts_of_a_timed_simulation():
    facts = solve_timed(build_punched_block("tet4", 6), StepControl(load_steps=3, unload_steps=2), True)
    assert facts["completed"]
    assert facts["steps"] in (4, 5)  # the step before contact ends is put in where that is foreseen
    assert facts["element"] == "tet4"
    assert facts["unknowns"] == System(build_punched_block("tet4", 6)).unknowns
    assert 0 < sum(facts["seconds_by_part"].values()) <= 1.01 * facts["seconds"]
    assert facts["factorisations"] >= 1


@pytest.mark.slow
def test_scaling_in_fresh_processes():
    steps = StepControl(load_steps=2, unload_steps=1)
    found = bench_scaling("tet10", (2000, 6000), 1, paper_divisions=6, tell=silent, control=steps)
    small, large = found["sizes"]
    assert 2000 <= small["unknowns"] < 6000 <= large["unknowns"]
    assert large["cells"] > small["cells"]
    assert found["paper_sized"]["element"] == "tet4"
    assert np.isfinite(found["seconds_exponent"])
    assert all(row["max_rss_MB"] > 50 for row in (small, large))


@pytest.mark.slow
@recorded
def test_a_forward_run_as_febio_has_its_softer_contact():
    own, febio = (
        bench_forward(REFERENCE, "block/block_tet4", as_febio=chosen, tell=silent) for chosen in (False, True)
    )
    assert own["element"] == febio["element"] == "tet4"
    assert febio["peak_force_N"] < own["peak_force_N"] < 1.05 * febio["peak_force_N"]
    assert (own["as_febio"], febio["as_febio"]) == (False, True)


@pytest.mark.febio
@recorded
def test_the_ratio_is_that_of_two_times_measured_in_one_run(febio, monkeypatch):
    monkeypatch.setenv("FEBIO_CMD", str(febio))
    found = bench_forward(REFERENCE, "block/block_hex8", beside_febio=True, tell=silent)
    assert found["febio_seconds"] > 0.5
    assert found["ratio"] == pytest.approx(found["febio_seconds"] / found["seconds"])
    monkeypatch.setenv("FEBIO_CMD", "no-such-program")
    with pytest.raises(InputError, match="no-such-program"):
        bench_forward(REFERENCE, "block/block_hex8", beside_febio=True, tell=silent)


@pytest.mark.febio
@recorded
def test_a_socket_is_timed_beside_febio(febio, monkeypatch):
    monkeypatch.setenv("FEBIO_CMD", str(febio))
    found = bench_socket(REFERENCE, "tube", beside_febio=True, tell=silent)
    assert found["completed"]
    assert found["ratio"] == pytest.approx(found["febio_seconds"] / found["seconds"])
    with pytest.raises(InputError, match="unknown case 'tubes'; use one of slide, cone, cone-load, tube"):
        bench_socket(REFERENCE, "tubes", tell=silent)


@pytest.fixture
def elsewhere(monkeypatch):
    """A folder name that no machine has above its temporary files."""
    name = Path("shared") / "reference-of-this-test"
    monkeypatch.setattr("limbfit.bench.parity.FOLDER", name)
    return name


def test_reference_is_found_beside_the_project(tmp_path, elsewhere):
    folder = tmp_path / elsewhere
    inside = tmp_path / "project" / "src"
    inside.mkdir(parents=True)
    with pytest.raises(InputError, match="--reference"):
        find_reference(inside)
    folder.mkdir(parents=True)
    assert find_reference(inside) == folder


@recorded
def test_every_case_is_there():
    for case in ALL_CASES:
        problem, control, log = load_case(case, REFERENCE)
        assert problem.mesh.cell_type == case.element
        assert len(control.times) == len(log.times) - 1


@recorded
def test_parity_rows():
    (row,) = bench_febio_parity(REFERENCE, cases=CUBES[:1], tell=silent)
    assert (row["case"], row["element"]) == ("cube_skin", "hex8")
    assert row["max_difference_percent"] < 1e-4
    assert row["febio_peak_stress_kPa"] == pytest.approx(25.2, abs=0.05)
    json.dumps(row, allow_nan=False)


@recorded
def test_parity_of_a_socket_is_told_by_its_parts():
    """The input that takes least: each part has its goal, and is within it."""
    rows = bench_febio_parity(REFERENCE, cases=SOCKET[-1:], tell=silent)
    (part,) = SOCKET[-1].parts
    (row,) = rows
    assert (row["case"], row["goal_percent"]) == (f"tube: {part.name}", 1.0)
    assert row["max_difference_percent"] < part.goal
    assert row["febio_peak_displacement_mm"] > 0.5
    json.dumps(row, allow_nan=False)


@recorded
def test_a_missing_case_of_a_socket_is_bad_input(tmp_path):
    with pytest.raises(InputError, match=r"tube\.feb.*--reference"):
        bench_febio_parity(tmp_path, cases=SOCKET[-1:], tell=silent)


def command(monkeypatch, capsys, *words: object) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["limbfit", "bench", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main()
    return int(end.value.code or 0), *capsys.readouterr()


def test_missing_reference_is_bad_input(monkeypatch, capsys, tmp_path, elsewhere):
    monkeypatch.chdir(tmp_path)
    for words in (("febio-parity",), ("forward",)):
        code, out, err = command(monkeypatch, capsys, *words)
        assert (code, out) == (2, "")
        assert str(elsewhere) in err
        assert "--reference" in err


def test_unknown_names_are_bad_input(monkeypatch, capsys, tmp_path):
    code, _, err = command(monkeypatch, capsys, "forward", "--case", "nonsense")
    assert code == 2
    assert "residuum/posterior_tet10" in err
    code, _, err = command(monkeypatch, capsys, "scaling", "--element", "nonsense")
    assert code == 2
    assert "tet10" in err
    (tmp_path / "residuum").mkdir()
    with pytest.raises(InputError, match=r"posterior_tet10\.feb"):
        bench_forward(tmp_path, tell=silent)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_interrupted_benchmark_leaves_nothing_behind():
    words = [sys.executable, "-m", "limbfit", "bench", "scaling", "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert "scaling 0/4" in process.stderr.readline()
        workers: list[str] = []
        for _ in range(200):
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
            workers = children.read_text().split() if children.is_file() else ["unknown"]
            if workers:
                break
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert "interrupted" in err
    assert workers
    for _ in range(100):  # the bookkeeper of multiprocessing outlives its parent by a moment
        left = [worker for worker in workers if Path(f"/proc/{worker}").exists()]
        if not left:
            break
        time.sleep(0.05)
    assert not left
