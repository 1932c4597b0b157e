"""Whether this machine can run limbfit: parts, resources, and a small problem solved for real."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import psutil

from ..._version import __version__
from ...errors import InputError, LimbfitError
from ...execution import THREAD_VARIABLES, ProcessExecutor, count_usable_cores
from ...fe import OgdenQLV
from ...fe.solution.linear import SOLVERS, build_linear_solver, prefers_multigrid
from ...febio.program import find_febio
from ...laws import KPA
from ..engine.provenance import collect_versions, describe_machine, find_version
from ..variants.cube import RAMP_S, compress

NEEDED_GB = 4.0  # of memory, for one site at the paper's size
FREE_GB = 2.0  # of disk, for the results of a study
_SELF_TEST_REMEDY = (
    "run again with LIMBFIT_TRACEBACK=1; if a library was built for another processor, reinstall it"
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox", "msedge")


@dataclass(frozen=True)
class Finding:
    """What one check found: ``state`` is ``ok``, ``warning`` or ``failed``."""

    check: str
    state: str
    found: str
    remedy: str = ""


def _judge(check: str, is_good: bool, found: str, remedy: str, otherwise: str = "failed") -> Finding:
    """``ok``, or the state ``otherwise`` with its remedy."""
    return Finding(check, "ok", found) if is_good else Finding(check, otherwise, found, remedy)


def diagnose(folder: Path = Path(".")) -> dict[str, Any]:
    """Check the installation and the machine; ``folder`` is where studies would lie.

    Returns ``healthy`` (nothing failed) and ``checks``, each with ``check``, ``state`` (``ok``, ``warning``,
    ``failed``), ``found`` and ``remedy``.
    """
    checks = [
        *_check_machine(),
        *_check_solvers(),
        *_check_meshers(),
        *_check_programs(),
        *_check_self_test(),
        *_check_writing(folder),
    ]
    return {
        "healthy": all(one.state != "failed" for one in checks),
        "versions": {"limbfit": __version__, **collect_versions()},
        "machine": describe_machine(),
        "checks": [asdict(one) for one in checks],
    }


def _check_machine() -> Iterator[Finding]:
    yield Finding("limbfit", "ok", f"{__version__}, Python {describe_machine()['python']}")
    required = [line for line in metadata.requires("limbfit") or [] if ";" not in line]  # whatever extras
    names = [re.split("[>=~<]", line)[0].strip() for line in required]
    missing = [name for name in names if find_version(name) is None]
    found = f"missing: {', '.join(missing)}" if missing else "all there"
    yield _judge("libraries", not missing, found, "pip install limbfit")
    usable, there = count_usable_cores(), os.cpu_count() or 1
    set_here = [f"{name}={os.environ[name]}" for name in THREAD_VARIABLES if name in os.environ]
    yield Finding("cores", "ok", f"{usable} of {there} may be used: {usable} workers of one thread each")
    yield Finding("threads", "ok", ", ".join(set_here) or "not set here; workers get one each")
    free = psutil.virtual_memory().available / 1e9
    found = f"{free:.1f} GB free, {free / usable:.1f} GB for each of {usable} workers"
    remedy = f"a site at the paper's size wants {NEEDED_GB:g} GB; use fewer workers (--workers 1)"
    yield _judge("memory", free >= NEEDED_GB, found, remedy, otherwise="warning")


def _check_solvers() -> Iterator[Finding]:
    one = np.array([0, 1], dtype=np.int32), np.array([0], dtype=np.int32)
    working = []
    for name in SOLVERS:
        try:
            solver = build_linear_solver(*one, name)
            solver.factorise(np.array([2.0]))
            assert abs(float(np.ravel(solver.solve(np.array([[1.0]])))[0]) - 0.5) < 1e-6
            working.append(name)
        except Exception:
            continue
    if not working:
        yield Finding("sparse solvers", "failed", "none works", "pip install pypardiso, or limbfit[cholmod]")
        return
    slow = prefers_multigrid()
    found = f"{'multigrid' if slow else working[0]} is used; working: {', '.join(working)}"
    remedy = "a faster one: pip install pypardiso (x86-64), or limbfit[cholmod]"
    yield _judge("sparse solvers", not slow, found, remedy, otherwise="warning")


def _check_meshers() -> Iterator[Finding]:
    """In a process of their own: some crash the interpreter."""
    for name, module, required in (("MMG", "mmgpy", True), ("Netgen", "netgen.meshing", False)):
        command = [sys.executable, "-P", "-c", f"import {module}"]
        try:
            works = subprocess.run(command, capture_output=True, timeout=120, check=False).returncode == 0
        except subprocess.TimeoutExpired:
            works = False
        found = "works" if works else "cannot be loaded" if required else "not installed (optional)"
        remedy = "" if works else f"pip install {'mmgpy' if required else 'limbfit[netgen]'}"
        yield Finding(f"mesher {name}", "ok" if works or not required else "failed", found, remedy)


def _check_programs() -> Iterator[Finding]:
    try:
        yield Finding("FEBio", "ok", find_febio().name)
    except InputError as error:
        yield Finding("FEBio", "ok", f"{error.what} (optional)", error.remedy or "")
    browser = next((name for name in BROWSERS if shutil.which(name)), None)
    if browser or sys.platform in ("win32", "darwin"):
        yield Finding("browser", "ok", browser or "the system's")
    else:
        yield Finding("browser", "ok", "none found here", "copy report.html to a machine that has one")
    for module, use in (("distributed", "--scheduler"), ("dask_jobqueue", "--dask slurm")):
        version = find_version(module.replace("_", "-"))
        remedy = "" if version else f"for {use}: pip install 'limbfit[dask]'"
        yield Finding(module, "ok", version or "not installed (optional)", remedy)


def _check_writing(folder: Path) -> Iterator[Finding]:
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".limbfit-doctor-") as stream:
            stream.write(b"x" * 4096)
            stream.flush()
    except OSError as error:
        why = error.strerror or type(error).__name__
        yield Finding("write access", "failed", f"{folder}: {why}", "work in a folder that can be written")
        return
    free = shutil.disk_usage(folder).free / 1e9
    found = f"{folder}: {free:.1f} GB free"
    remedy = f"a study's results take up to {FREE_GB:g} GB; free some space"
    yield _judge("write access", free >= FREE_GB, found, remedy, otherwise="warning")


def _check_self_test() -> Iterator[Finding]:
    """A slightly compressed cube in a worker process, against Young's modulus."""
    start = perf_counter()
    try:
        with ProcessExecutor(1) as executor:
            found, wanted = next(executor.map(compress_test_cube, [1e-4]))
    except (LimbfitError, ArithmeticError, ImportError, OSError, ValueError) as error:
        yield Finding("self-test", "failed", f"{type(error).__name__}: {error}", _SELF_TEST_REMEDY)
        return
    yield judge_self_test(found, wanted, perf_counter() - start)


def judge_self_test(found: float, wanted: float, seconds: float) -> Finding:
    """A right stress is ``ok`` however long it took: a busy machine compiles for a minute."""
    off = abs(found / wanted - 1.0)
    text = f"stress of a cube {off:.1e} off its closed form, {seconds:.1f} s (the first run compiles)"
    return _judge("self-test", off <= 1e-3, text, _SELF_TEST_REMEDY)


def compress_test_cube(strain: float) -> tuple[float, float]:
    """Stress of a cube in slight uniaxial compression, and what linear elasticity says, kPa."""
    c, ratio = 5.0, 100.0
    material = OgdenQLV(c=c * KPA, m=4.0, gamma=0.0, tau=1.0, kappa_ratio=ratio)
    stress, _, _ = compress(material, np.array([RAMP_S]), 100.0 * strain)
    return float(stress[0]), 9 * ratio * c / (3 * ratio + 1) * strain
