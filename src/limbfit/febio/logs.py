"""Log files of FEBio: ``*Step``, ``*Time``, ``*Data`` and one line per item, per step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ProblemError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Log:
    """Values (n, i, k) of ``i`` items at ``n`` times (n,) s, in FEBio's units; ``names`` of the k columns."""

    times: Array
    names: tuple[str, ...]
    values: Array

    def column(self, name: str) -> Array:
        """Values (n,) of the first item."""
        return self.values[:, 0, self.names.index(name)]


def read_log(path: str | Path) -> Log:
    """Read a log file of FEBio; a last step that was not written to its end is left out.

    Raises
    ------
    ProblemError
        Where the file is missing, holds no complete step, or a line that is no number.
    """
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise ProblemError(error.strerror or "cannot be read", file=path) from error
    times: list[float] = []
    steps: list[list[list[float]]] = []
    names: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n")[:-1], 1):  # a line without end was cut short
        try:
            if line.startswith("*Time"):
                times.append(float(line.partition("=")[2]))
                steps.append([])
            elif line.startswith("*Data"):
                names = tuple(name.strip() for name in line.partition("=")[2].split(";"))
            elif line.strip() and not line.startswith("*"):
                steps[-1].append([float(value) for value in line.split(",")[1:]])
        except (ValueError, IndexError) as error:
            raise ProblemError(
                f"{line!r} is not a line of a FEBio log", file=path, place=str(number)
            ) from error
    items = len(steps[0]) if steps else 0
    whole = [[len(row) for row in step] == [len(names)] * items for step in steps]
    count = whole.index(False) if False in whole else len(whole)
    if not count or not items:
        raise ProblemError("holds no complete step of FEBio", file=path)
    return Log(np.array(times[:count]), names, np.array(steps[:count]))
