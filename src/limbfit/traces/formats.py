"""Files of records as tables of named columns: text, LabVIEW's measurement files, Excel, MATLAB.

Nothing is interpreted here: names, stated units and cells are as they are in the file.

Sources: National Instruments, Specification for the LabVIEW Measurement File (.lvm); npTDMS's documentation.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, whosmat

from ..errors import TraceError
from ..extensions import import_extra

TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".asc", ".lvm")  # that rigs give to tables
BINARY_SUFFIXES = (".mat", ".tdms", ".xlsx", ".xlsm", ".xls")  # of files that are no text
MAX_PREAMBLE = 1000  # lines before the header
MAX_SAMPLES = 20_000_000
TIME = "time_s"  # the key of the times
_END_OF_HEADER = "***End_of_Header***"
_X = "X_Value"  # LabVIEW's name of the times

Names = Mapping[str, str]  # of columns, by the keys of [traces]
Row = tuple[int, list[str]]  # the number of a line, and its cells


@dataclass(frozen=True)
class ColumnTable:
    """Columns of a file by their position.

    ``names``, ``units``: of the columns; a unit is "" where the file states none. ``rows``: of a table of
    text. ``vectors``: of a file that holds numbers, one for each name. ``notes``: what was done to read it,
    in words.
    """

    names: Sequence[str]
    units: Sequence[str]
    rows: Sequence[Row] = ()
    vectors: Sequence[Any] = ()
    notes: tuple[str, ...] = ()


def read_table(file: Path, columns: Names) -> ColumnTable:
    """The table of a file, by its suffix; it has the columns that are named.

    Raises `TraceError` if the file cannot be read, or holds no table with these columns.
    """
    if not file.is_file():
        raise TraceError("no such file")
    suffix = file.suffix.lower()
    if suffix == ".mat":
        return _read_mat(file, columns)
    if suffix == ".tdms":
        return _read_tdms(file, columns)
    if suffix in (".xlsx", ".xlsm"):
        return _read_excel(file, columns)
    if suffix == ".xls":
        raise TraceError("an Excel file from before 2007", remedy="save it as .xlsx")
    text, note = _decode(file)
    is_labview = suffix == ".lvm" and text.startswith("LabVIEW Measurement")
    try:
        table = (_read_lvm if is_labview else _read_text)(text, columns)
    except csv.Error as error:
        raise TraceError(f"not a text table ({error})", remedy="export it again") from None
    return replace(table, notes=note + table.notes)


def is_number(cell: str) -> bool:
    """True for a number with a decimal point or comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _check_names(names: Sequence[str], columns: Names) -> None:
    for key, name in columns.items():
        if name not in names:
            shown = ", ".join(repr(n[:40]) for n in [n for n in names if n][:8])
            remedy = f'rename the column, or name it in the study: [traces] {key} = "..."'
            raise TraceError(f"no column {name!r}; it has {shown}", place="header", remedy=remedy)


# --- text


def _decode(file: Path) -> tuple[str, tuple[str, ...]]:
    """The text of a file and the note on its encoding."""
    data = file.read_bytes()
    is_utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    if b"\0" in data[:4096] and not is_utf16:
        raise TraceError("not a text table", remedy="give CSV with one header line, or MAT")
    name, encoding = ("UTF-16", "utf-16") if is_utf16 else ("UTF-8", "utf-8-sig")
    try:
        return data.decode(encoding), ("the text is UTF-16",) if is_utf16 else ()
    except UnicodeDecodeError as error:
        raise TraceError(f"not {name} text ({error.reason})", remedy="save as UTF-8") from None


def _split(lines: Sequence[str], delimiter: str, start: int = 0) -> list[Row]:
    """The cells of lines that are neither empty nor comments; ``start`` lines come before them."""
    reader = csv.reader(lines, delimiter=delimiter)
    rows = [(start + reader.line_num, [cell.strip() for cell in row]) for row in reader]
    return [row for row in rows if any(row[1]) and not row[1][0].startswith("#")]


def _find_delimiter(line: str, columns: Names) -> str:
    """What splits a line into most of the named columns; where none does, what is there most often."""

    def count(delimiter: str) -> tuple[int, int]:
        cells = {cell for _, row in _split([line], delimiter) for cell in row}
        return len(cells & set(columns.values())), line.count(delimiter)

    return max("\t;,", key=count)


def _read_text(text: str, columns: Names) -> ColumnTable:
    lines = text.splitlines()
    single = [
        _split([line], _find_delimiter(line, columns), i) for i, line in enumerate(lines[:MAX_PREAMBLE])
    ]
    header = _find_header([row for rows in single for row in rows], columns)
    number = header[0]
    delimiter = _find_delimiter(lines[number - 1], columns)
    rows = _split(lines[number:], delimiter, number)
    if delimiter != ",":
        _check_decimal_signs(rows, [header[1].index(name) for name in columns.values()])
        rows = [(i, [cell.replace(",", ".") for cell in row]) for i, row in rows]
    return _build_table(header, rows, columns, has_preamble=any(single[: number - 1]))


def _check_decimal_signs(rows: Sequence[Row], places: Sequence[int]) -> None:
    """Refuse points beside commas in the named columns: one of the two groups thousands, or both are decimal
    signs, and nobody knows which.
    """
    named = [(i, row[place]) for i, row in rows for place in places if place < len(row)]
    found = [
        next(((i, cell) for i, cell in named if sign in cell and ":" not in cell), None) for sign in ".,"
    ]
    if None in found:
        return
    (_, point), (line, comma) = (one for one in found if one is not None)
    what = f"{comma[:40]!r} has a comma, and {point[:40]!r} a point"
    remedy = "export numbers with one decimal sign, and without a sign between thousands"
    raise TraceError(what, place=f"line {line}", remedy=remedy)


def _find_header(rows: Sequence[Row], columns: Names) -> Row:
    """The first row that holds all names.

    Raises `TraceError` if none does. It shows the row that holds the most of them; where none holds any,
    the first row that is as wide as the numbers, if there are some.
    """
    if not rows:
        raise TraceError("the file is empty")
    likely = max(rows, key=lambda row: sum(name in row[1] for name in columns.values()))
    if not set(columns.values()) & set(likely[1]):
        width = next((len(row) for _, row in rows if sum(map(is_number, row)) > 1), None)
        if width is None:  # what it holds is not shown: it may be another's file
            raise TraceError("no table: it has none of the columns, and no row of numbers")
        likely = next((row for row in rows if len(row[1]) == width), likely)
    _check_names(likely[1], columns)
    return likely


def _build_table(header: Row, rows: Sequence[Row], columns: Names, has_preamble: bool) -> ColumnTable:
    """The table below a header; its first row may state units: words in each of the named columns."""
    number, names = header
    notes = (f"what stands before the header in line {number} is skipped",) if has_preamble else ()
    first = (rows[0][1] if rows else []) + [""] * len(names)
    below = [first[names.index(name)] for name in columns.values()]
    if all(cell and not is_number(cell) and not any(c.isdigit() for c in cell) for cell in below):
        return ColumnTable(names, first[: len(names)], rows[1:], notes=notes)
    return ColumnTable(names, [""] * len(names), rows, notes=notes)


# --- LabVIEW's measurement files


def _read_lvm(text: str, columns: Names) -> ColumnTable:
    """All segments after each other; ``X_Value`` is the time where no other column is named as that."""
    lines = text.splitlines()
    delimiter = "," if any(line.startswith("Separator,") for line in lines) else "\t"
    tags: dict[str, list[str]] = {}
    rows: list[Row] = []
    segments: list[tuple[dict[str, list[str]], list[Row]]] = []
    in_header = True
    for number, row in _split(lines, delimiter):
        if row[0] == "Channels":
            tags, in_header = {}, True
        if row[0] == _END_OF_HEADER:
            rows, in_header = [], False
            segments.append((tags, rows))
        elif in_header:
            tags[row[0]] = [cell.replace(",", ".") for cell in row[1:]]
        else:
            rows.append((number, [cell.replace(",", ".") for cell in row]))
    with_names = [one for one in segments if one[1]]
    first = with_names[0][1][0] if with_names else _find_header([], columns)
    names = first[1]
    if any(rows[0][1] != names for _, rows in with_names):
        raise TraceError("its segments hold different channels", remedy="save one segment")
    notes: tuple[str, ...] = ()
    if columns[TIME] not in names and "Time" in with_names[0][0].get("X_Dimension", ()):
        names = [columns[TIME] if name == _X else name for name in names]
        notes = (f"the times are LabVIEW's {_X}",)
    rows = [row for tags, rows in with_names for row in _add_times(rows[1:], tags, names, columns[TIME])]
    _find_header([(first[0], names)], columns)
    units = ["", *with_names[0][0].get("Y_Unit_Label", [])] + [""] * len(names)
    return ColumnTable(names, units[: len(names)], rows, notes=notes)


def _add_times(
    rows: Sequence[Row], tags: Mapping[str, list[str]], names: Sequence[str], time: str
) -> list[Row]:
    """The rows of a segment, their times made of ``X0`` and ``Delta_X`` where the file leaves them out.

    Raises `TraceError` if these are not the same for all channels.
    """
    if names[0] != time or any(row[0] for _, row in rows):
        return list(rows)
    starts, steps = (set(filter(None, tags.get(tag, []))) for tag in ("X0", "Delta_X"))
    if len(starts) != 1 or len(steps) != 1 or not all(map(is_number, starts | steps)):
        remedy = "save them with one X column, or name a channel of times in the study: [traces] time_s"
        raise TraceError("its channels are not sampled at the same times", place="X0, Delta_X", remedy=remedy)
    start, step = float(starts.pop()), float(steps.pop())
    return [(number, [repr(start + i * step), *row[1:]]) for i, (number, row) in enumerate(rows)]


# --- files of libraries that are optional


def _import(module: str, package: str, extra: str, suffix: str) -> Any:
    what = f"files {suffix} are read by {package}, which is not installed"
    remedy = f"pip install 'limbfit[{extra}]', or export the record as CSV"
    return import_extra(module, extra, TraceError(what, remedy=remedy))


def _read_tdms(file: Path, columns: Names) -> ColumnTable:
    """The group that holds the columns, its times by their channel or by the waveform's increment."""
    nptdms = _import("nptdms", "npTDMS", "tdms", file.suffix)
    try:
        groups = [group.channels() for group in nptdms.TdmsFile.read(file).groups()]
    except Exception as error:  # a broken file can fail anywhere in the parser
        raise TraceError(f"not a readable TDMS file ({type(error).__name__})") from None
    others = {name for key, name in columns.items() if key != TIME} or {columns[TIME]}
    fitting = [group for group in groups if others <= {one.name for one in group}]
    if len(fitting) > 1:
        what = f"{len(fitting)} of its groups hold these channels"
        raise TraceError(what, remedy="save one group to a file")
    channels = fitting[0] if fitting else [one for group in groups for one in group]
    names = [one.name for one in channels]
    units = [str(one.properties.get("unit_string", "")) for one in channels]
    vectors = [one[:] for one in channels]
    notes: tuple[str, ...] = ()
    if fitting and columns[TIME] not in names:
        waves = [one for one in channels if one.name in others]
        tracks = [one.time_track() for one in waves if "wf_increment" in one.properties]
        if len(tracks) == len(waves) and all(np.array_equal(track, tracks[0]) for track in tracks):
            names, units, vectors = [columns[TIME], *names], ["s", *units], [tracks[0], *vectors]
            notes = ("the times are those of the waveform",)
    _check_names(names, columns)
    return ColumnTable(names, units, vectors=vectors, notes=notes)


def _read_excel(file: Path, columns: Names) -> ColumnTable:
    """The one sheet that holds the columns; times of day are written as ISO 8601 says."""
    openpyxl = _import("openpyxl", "openpyxl", "excel", file.suffix)
    try:
        book = openpyxl.load_workbook(file, read_only=True, data_only=True)
        sheets: dict[str, list[Row]] = {}
        for sheet in book.worksheets:
            numbered = enumerate(sheet.iter_rows(values_only=True), 1)
            rows = [(i, [_format_cell(value) for value in row]) for i, row in numbered]
            sheets[sheet.title] = [row for row in rows if any(row[1])]
        book.close()
    except Exception as error:  # a broken file can fail anywhere in the parser
        raise TraceError(f"not a readable Excel file ({type(error).__name__})") from None
    needed = set(columns.values())
    fitting = [name for name, rows in sheets.items() if any(needed <= set(row) for _, row in rows)]
    if len(fitting) > 1:
        shown = ", ".join(fitting)
        raise TraceError(f"the sheets {shown} all hold these columns", remedy="keep one of them")
    rows = sheets[fitting[0]] if fitting else max(sheets.values(), key=len)
    header = _find_header(rows[:MAX_PREAMBLE], columns)
    below = [row for row in rows if row[0] > header[0]]
    return _build_table(header, below, columns, has_preamble=rows[0] != header)


def _format_cell(value: Any) -> str:
    """The text of a cell."""
    if hasattr(value, "isoformat"):
        return str(value.isoformat())
    return "" if value is None else str(value).strip()


def _read_mat(file: Path, columns: Names) -> ColumnTable:
    """Variables, or fields of one struct."""
    try:
        sizes = {name: int(np.prod(shape)) for name, shape, _ in whosmat(file)}
        if sum(sizes.values()) > MAX_SAMPLES:
            raise TraceError(f"larger than {MAX_SAMPLES} numbers")
        content = {k: v for k, v in loadmat(file, squeeze_me=True).items() if not k.startswith("__")}
    except TraceError:
        raise
    except NotImplementedError:
        raise TraceError("MAT version 7.3", remedy="save it in MATLAB with '-v7'") from None
    except Exception as error:  # a broken file can fail anywhere in the parser
        raise TraceError(f"not a readable MAT file ({type(error).__name__})") from None
    structs = [v for v in content.values() if isinstance(v, np.ndarray) and v.dtype.names and v.shape == ()]
    if columns[TIME] not in content and len(structs) == 1:
        content = {name: structs[0][name].item() for name in structs[0].dtype.names}
    _check_names(list(content), columns)
    return ColumnTable(list(content), [""] * len(content), vectors=list(content.values()))
