"""The solver's kernels, compiled once for all workers, beside the work that does not need them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from ...execution import run_in_background
from ...fe import are_compiled, compile_kernels


@contextmanager
def compile_in_background(wanted: bool = True) -> Iterator[Callable[[], None]]:
    """The block is given a function that waits until the kernels are there, where they are ``wanted``.

    Where they are not stored yet, one process compiles them while the block goes on: workers that began to
    solve at the same time would each compile them all.
    """
    if not wanted or are_compiled():
        yield lambda: None
        return
    with run_in_background(_compile, None) as wait:
        yield wait


def _compile(_: None) -> None:
    compile_kernels()
