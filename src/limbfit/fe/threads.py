"""Threads that share one simulation, kept out of each other's way."""

import ctypes
import functools
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController, threadpool_info


@functools.cache
def get_thread_pool(threads: int) -> ThreadPoolExecutor:
    """Workers for compiled kernels that let go of the interpreter; kept for the life of the process."""
    return ThreadPoolExecutor(threads)


def limit_numpy_threads() -> AbstractContextManager[object]:
    """While this lasts, NumPy's own linear algebra runs on one thread.

    Its arrays are small here, and its idle threads would spin on the cores that the solver works on.
    """
    return _find_openblas().limit(limits=1)


@functools.cache
def _find_openblas() -> ThreadpoolController:
    """OpenBLAS alone: a limit on all libraries, once lifted, would leave MKL with one thread."""
    return ThreadpoolController().select(internal_api="openblas")


def silence_openmp() -> None:
    """Let Intel's OpenMP threads sleep at once between factorisations instead of spinning for 0.2 s."""
    for library in threadpool_info():
        if library["prefix"] == "libiomp":
            ctypes.CDLL(library["filepath"]).kmp_set_blocktime(0)
