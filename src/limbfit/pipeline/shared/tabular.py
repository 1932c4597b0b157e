"""Tables of words and numbers, and curves, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def write_table(file: Path, heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file with a line of heads; numbers to nine digits, nothing where a value is None."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(heads)
        writer.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def write_curves(file: Path, **columns: NDArray[np.float64]) -> None:
    """A CSV with named columns of numbers."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


def read_curves(file: Path) -> dict[str, NDArray[np.float64]]:
    """The columns of a CSV that ``write_curves`` made."""
    names = file.read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    return dict(zip(names, np.loadtxt(file, delimiter=",", skiprows=1, unpack=True), strict=True))
