"""How results are written: JSON, tables and curves as CSV, never half done; and digests of inputs."""

import csv
import json
import os
import uuid
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...results.base import ResultPart

DRAFT = ".part"


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that a reader sees the old file or the new one, never half of it."""
    text = json.dumps(content, indent=1, allow_nan=False, default=to_plain)
    with write_atomically(path) as stream:
        stream.write(text.encode())


def write_result(path: Path, result: ResultPart) -> None:
    """Write a result as JSON; its model has checked it."""
    write_json(path, result.to_plain())


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def to_plain(value: Any) -> Any:
    """NumPy scalars and arrays, and collections such as ranges, as what JSON knows."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, Collection) else str(value)


@contextmanager
def write_atomically(path: Path) -> Iterator[BinaryIO]:
    """A binary stream whose content appears at ``path`` only when the block ends well."""
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}{DRAFT}")
    try:
        with draft.open("xb") as stream:
            yield stream
        os.replace(draft, path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise


def write_table(file: Path, heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """A CSV file with a line of heads; numbers to nine digits, nothing where a value is None."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(heads)
        writer.writerows([_format_cell(value) for value in row] for row in rows)


def write_rows(file: Path, rows: Sequence[ResultPart], leave_out: Sequence[str] = ()) -> None:
    """A CSV file of parts of a result whose keys are its columns, but for some."""
    heads = [key for key in (type(rows[0]).model_fields if rows else ()) if key not in leave_out]
    write_table(file, heads, [[getattr(row, key) for key in heads] for row in rows])


def _format_cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def write_curves(file: Path, **columns: NDArray[np.float64]) -> None:
    """A CSV with named columns of numbers."""
    table = np.column_stack(list(columns.values()))
    np.savetxt(file, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
