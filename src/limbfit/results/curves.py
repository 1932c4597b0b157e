"""Curves and tables of numbers as CSV files."""

from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError


def read_curves(file: Path) -> dict[str, Array]:
    """Read the columns (n,) of a CSV of numbers, by their heads. Raises `InputError` for any other file."""
    lines = file.read_text(encoding="utf-8").splitlines()
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    try:
        values = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"not readable: {error}", file=file, remedy="run its stage again") from None
    if values.shape[1:] != (len(names),):
        raise InputError("its rows do not fit its header", file=file, remedy="run its stage again")
    return {name: values[:, i] for i, name in enumerate(names)}
