"""Kernels compiled beforehand are those that an indentation needs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
from numba.core import event

from limbfit.bench.timing import build_punched_block
from limbfit.fe import StepControl, are_compiled, compile_kernels, solve

assert not are_compiled()
compile_kernels()
assert are_compiled()
made = []

class Listener(event.Listener):
    def on_start(self, found):
        made.append(found.data["dispatcher"].py_func.__qualname__)

    def on_end(self, found):
        pass

event.register("numba:compile", Listener())
for element in ("tet10p0", "tet10g8p0"):
    solve(build_punched_block(element, 3), steps=StepControl(times=(0.5, 1.0)), sensitivities=True)
print(*made)
"""


FEW = """
import numpy as np
import limbfit.fe
from limbfit.shapes.shape import _rotate_about_axis

_rotate_about_axis(np.ones((1, 3)), np.ones(1), np.ones((1, 2)), np.ones((1, 3)))
"""


def run_script(script: str, cache: Path) -> str:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", script]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
def test_an_indentation_compiles_nothing_more(tmp_path) -> None:
    assert run_script(SCRIPT, tmp_path).split() == []


def test_a_kernel_that_is_older_than_the_source_of_another_is_compiled_anew(tmp_path) -> None:
    run_script(FEW, tmp_path)
    stored = list(tmp_path.rglob("*.nbi"))
    assert stored
    made = [file.stat().st_mtime for file in stored]
    run_script(FEW, tmp_path)
    assert [file.stat().st_mtime for file in stored] == made
    for file in stored:
        os.utime(file, (0.0, 0.0))
    run_script("import limbfit.fe", tmp_path)
    assert not any(file.exists() for file in stored)
