"""Inputs of other programs: their templates filled in, and written."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from ..arrays import Array
from ..errors import RunError


def format_row(values: Iterable[float]) -> str:
    """Write numbers with commas, so that they are read back exactly."""
    return ",".join(repr(float(value)) for value in values)


def format_fields(values: Iterable[float]) -> str:
    """Write numbers with commas, each in the 20 characters that Abaqus and CalculiX take at most."""
    return ", ".join(f"{float(value):.12g}" for value in values)


def format_ids(nodes: Iterable[int]) -> str:
    """Write nodes as FEBio's numbers, which count from 1."""
    return ",".join(str(int(node) + 1) for node in nodes)


def wrap_numbers(numbers: Iterable[int]) -> str:
    """Write at most 15 numbers in a line, as Abaqus asks; a line that continues ends with a comma."""
    listed = [str(int(number)) for number in numbers]
    return ",\n".join(", ".join(listed[i : i + 15]) for i in range(0, len(listed), 15))


def find_across(direction: Array) -> Array:
    """Return the axis of space (3,) that is most across a direction (3,)."""
    return np.asarray(np.eye(3)[np.argmin(np.abs(direction))])


def write_template(path: str | Path, template: str, **content: Any) -> None:
    """Write a file from one of the templates; raise `RunError` if it cannot be written."""
    environment = Environment(
        loader=PackageLoader("limbfit.febio", "templates"),
        autoescape=select_autoescape(("feb.j2",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"row": format_row, "fields": format_fields, "ids": format_ids}
    environment.filters |= {"wrap": wrap_numbers, "across": find_across}
    text = environment.get_template(template).render(content)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from error
