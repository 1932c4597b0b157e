"""Records from CSV tables and MAT files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.io import loadmat, whosmat

from ..errors import TraceError
from .numerics import Array
from .record import COLUMNS, Trace, check_trace

MAX_SAMPLES = 20_000_000


def read_trace(path: str | Path, columns: tuple[str, str, str] = COLUMNS) -> Trace:
    """Read and check a record from a CSV table (comma, semicolon or tab) or a MAT file (version 5).

    Parameters
    ----------
    path : the file; ``.mat`` is read as MATLAB's, anything else as text with one header line.
    columns : the names of time (s), displacement (mm) and force (N) in it.

    Raises
    ------
    TraceError
        With the file, the row or column, and the remedy.
    """
    file = Path(path)
    found = read_columns(file, columns)
    trace = Trace(*(found[name] for name in columns))
    check_trace(trace, columns=columns, file=file)
    return trace


def read_columns(
    file: Path,
    columns: Sequence[str],
    wanted: Callable[[str], bool] = lambda name: False,
    gaps: bool = False,
) -> dict[str, Array]:
    """The named columns of a file that `read_trace` could read, and all others that are ``wanted``.

    With ``gaps`` an empty cell of a table is nan.

    Raises
    ------
    TraceError
        With the file, the row or column, and the remedy.
    """
    if not file.is_file():
        raise TraceError("no such file", file=file)
    if file.suffix.lower() == ".mat":
        found = _read_mat(file, columns, wanted)
    else:
        found = _read_table(file, columns, wanted, "nan" if gaps else "")
    return {name: np.asarray(c, dtype=np.float64) for name, c in found.items()}


def _chosen(
    known: Sequence[str], columns: Sequence[str], wanted: Callable[[str], bool], file: Path
) -> list[str]:
    """The columns to be read; those that are named must be there."""
    for name in columns:
        _column(known, name, file)
    return [*columns, *(name for name in known if wanted(name) and name not in columns)]


def _read_table(
    file: Path, columns: Sequence[str], wanted: Callable[[str], bool], empty: str
) -> dict[str, Array]:
    with file.open("rb") as stream:
        if b"\0" in stream.read(4096):
            raise TraceError("not a text table", file=file, remedy="give CSV with one header line, or MAT")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise TraceError(f"not UTF-8 text ({error.reason})", file=file, remedy="save as UTF-8") from None
    numbered = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not numbered:
        raise TraceError("the file is empty", file=file)
    header = numbered[0][1]
    delimiter = max("\t;,", key=header.count)
    names = [name.strip().strip('"') for name in header.split(delimiter)]
    cells = [(i, [cell.strip() or empty for cell in line.split(delimiter)]) for i, line in numbered[1:]]
    if delimiter != ",":
        cells = [(i, [cell.replace(",", ".") for cell in row]) for i, row in cells]
    chosen = _chosen(names, columns, wanted, file)
    return {name: _numbers(cells, names.index(name), name, file) for name in chosen}


def _column(names: Sequence[str], name: str, file: Path) -> None:
    if name in names:
        return
    shown = ", ".join(repr(n[:40]) for n in names[:8])
    raise TraceError(
        f"no column {name!r}; it has {shown}",
        file=file,
        place="header",
        remedy="rename the column, or name it in [traces] of the study",
    )


def _numbers(cells: list[tuple[int, list[str]]], place: int, name: str, file: Path) -> Array:
    try:
        return np.array([float(row[place]) for _, row in cells])
    except (ValueError, IndexError):
        for line, row in cells:
            _cell(row, place, file, f"line {line}, column {name}")
        raise


def _cell(row: list[str], place: int, file: Path, where: str) -> None:
    if place >= len(row):
        raise TraceError("the row is too short", file=file, place=where) from None
    try:
        float(row[place])
    except ValueError:
        raise TraceError(f"{row[place].strip()[:40]!r} is not a number", file=file, place=where) from None


def _read_mat(file: Path, columns: Sequence[str], wanted: Callable[[str], bool]) -> dict[str, Array]:
    """Variables, or fields of one struct."""
    try:
        sizes = {name: int(np.prod(shape)) for name, shape, _ in whosmat(file)}
        if sum(sizes.values()) > MAX_SAMPLES:
            raise TraceError(f"larger than {MAX_SAMPLES} numbers", file=file)
        content = {k: v for k, v in loadmat(file, squeeze_me=True).items() if not k.startswith("__")}
    except TraceError:
        raise
    except NotImplementedError:
        raise TraceError("MAT version 7.3", file=file, remedy="save it in MATLAB with '-v7'") from None
    except Exception as error:  # a broken file can fail anywhere in the parser
        raise TraceError(f"not a readable MAT file ({type(error).__name__})", file=file) from None
    structs = [v for v in content.values() if isinstance(v, np.ndarray) and v.dtype.names and v.shape == ()]
    if columns[0] not in content and len(structs) == 1:
        content = {name: structs[0][name].item() for name in structs[0].dtype.names}
    chosen = _chosen(list(content), columns, wanted, file)
    return {name: _mat_vector(content[name], name, file) for name in chosen}


def _mat_vector(value: object, name: str, file: Path) -> Array:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.squeeze().ndim != 1:
        raise TraceError("not a vector of real numbers", file=file, place=name)
    return array.squeeze().astype(np.float64)
