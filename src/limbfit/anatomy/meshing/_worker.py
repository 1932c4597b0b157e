"""What every mesher's process does around its work."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Callable

import numpy as np

Arrays = dict[str, np.ndarray]
_PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>


def work(remesh: Callable[[Arrays], Arrays]) -> None:
    """From the task file to the mesh file that the command line names."""
    _end_with_parent()
    source, target = sys.argv[1:3]
    with np.load(source) as stored:
        outcome = remesh(dict(stored))
    np.savez(target, allow_pickle=False, **outcome)


def _end_with_parent() -> None:
    """On Linux: a mesher would not hear of a killed run, and keep a core until it is done."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
