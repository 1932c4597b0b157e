"""A small study that every test may copy: a rounded stump around a bone, two sites with records."""

import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv

from acquiring import ready
from browsing import launch, open_page, playwright, serve
from editing import write_record
from limbfit.cli import main
from limbfit.errors import InputError
from limbfit.fe.solution.compiling import are_compiled
from limbfit.febio import find_febio

__all__ = ["launch", "open_page", "playwright", "ready", "serve"]

# Where the tests run in the background of a script, interrupts are ignored, and so they would be in the
# processes that tests interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


compiling: list[subprocess.Popen[bytes]] = []


def pytest_sessionstart(session: pytest.Session) -> None:
    """After an installation one process compiles the kernels while tests are collected, not every worker."""
    if not hasattr(session.config, "workerinput") and not are_compiled():
        words = "from limbfit.fe.solution.compiling import compile_kernels; compile_kernels()"
        compiling.append(subprocess.Popen([sys.executable, "-c", words]))


def pytest_collection_finish() -> None:
    """No test begins before: what a process compiles for itself differs in the last digits."""
    for one in compiling:
        one.wait()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished() -> None:
    pytest_collection_finish()


STUDY = """
[study]
name = "stump"
[surfaces]
skin = "skin.stl"
bones = { tibia = "tibia.stl" }
[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [40.0, 0.0, 60.0]
[[sites]]
name = "2"
trace = "2.csv"
position = [0.0, 40.0, 50.0]
"""


def coarse_mesh(element: str = "tet4", edge_near_mm: float = 8.0) -> str:
    """Settings of the study with which a simulation takes a second or two, in this process."""
    return f"""
[execution]
workers = 1
[mesh]
element = "{element}"
edge_near_mm = {edge_near_mm}
edge_far_mm = 24.0
near_radius_mm = 8.0
growth = 1.0
flatness = 2.0
[solver]
load_steps = 4
unload_steps = 3
"""


COARSE = (
    coarse_mesh()
    + """
[calibration]
max_iterations = 2
[material]
start = { c_kPa = 6.0, m = 4.0, gamma = 1.0, tau_s = 1.0 }
"""
)


def stump(radius: float, length: float, top: float) -> pv.PolyData:
    """Half an ellipsoid of revolution about z, closed by a flat cap at ``top``, outward."""
    whole = pv.Icosphere(radius=1.0, nsub=4)
    whole.points *= [radius, radius, length]
    whole.points[:, 2] += top
    half = whole.clip_closed_surface("-z", origin=(0, 0, top))
    return half.triangulate().clean().compute_normals(auto_orient_normals=True, consistent_normals=True)


def write_trace(path, *, depth=5.0, peak=6.0, rate=100.0):
    random, touch = np.random.default_rng(1), 0.4
    speed, span = 0.96, (depth + touch) / 0.96
    time = np.arange(0.0, 2 * span, 1 / rate)
    displacement = speed * (span - np.abs(time - span))
    force = peak * np.clip((displacement - touch) / depth, 0, None) ** 1.3
    force += random.normal(0, 0.03, time.size)
    write_record(path, np.column_stack([time, displacement, force]))


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pristine")
    stump(42.0, 150.0, 120.0).save(folder / "skin.stl")
    stump(13.0, 125.0, 126.0).save(folder / "tibia.stl")
    for name in ("1", "2"):
        write_trace(folder / f"{name}.csv")
    (folder / "study.toml").write_text(STUDY)
    return folder


@pytest.fixture
def study(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "study")


@pytest.fixture
def coarse_settings() -> str:
    """``COARSE`` for tests in folders with a conftest of their own."""
    return COARSE


@pytest.fixture
def commands_unasked(monkeypatch) -> None:
    """``limbfit check`` looks at the inputs alone: what commands would refuse takes half of its time."""
    monkeypatch.setattr("limbfit.pipeline.commands.check.list_refused_commands", lambda *given: [])


def call(monkeypatch, capture, *words: object) -> tuple[int, str, str]:
    monkeypatch.setattr("sys.argv", ["limbfit", *map(str, words)])
    try:
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    shown = capture.readouterr()
    return code, shown.out, shown.err


@pytest.fixture
def limbfit(monkeypatch, capsys):
    """Run a command; returns (exit code, standard output, standard error)."""
    return partial(call, monkeypatch, capsys)


@pytest.fixture
def limbfit_and_libraries(monkeypatch, capfd):
    """The same with what C libraries print."""
    return partial(call, monkeypatch, capfd)


@pytest.fixture(scope="session")
def febio() -> Path:
    """FEBio itself: that of ``FEBIO_CMD``, of the path, or beside the repository."""
    for given in (None, Path(__file__).parents[2] / "shared" / "febio" / "febio4"):
        try:
            return find_febio(given)
        except InputError:
            assert "FEBIO_CMD" not in os.environ  # which names none that can be run
    pytest.skip("there is no febio4 on the path, and none beside the repository")
