"""Kernels compiled beforehand are those that an indentation needs."""

import os
import subprocess
import sys

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


@pytest.mark.slow
def test_an_indentation_compiles_nothing_more(tmp_path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []
