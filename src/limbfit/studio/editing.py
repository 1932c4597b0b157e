"""Changes of ``study.toml`` that keep its comments, its order and its layout.

Every change is made on the text, written beside the file, read back as a study, and only then put in its
place: a change that the study file's own checks refuse leaves the file as it was.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT

from ..errors import StudyError
from ..study import Record
from ..study.writing import store_study

POSITION_DIGITS = 2  # of a place in mm
_LOCK = Lock()  # requests come in threads: each change is made on what the one before it stored


@contextmanager
def edit_study(file: Path) -> Iterator[tomlkit.TOMLDocument]:
    """The study file as a document; what the block changes in it is stored when the block ends.

    Raises `StudyError` where the file is not TOML, or the study would not be valid; the file is left as it
    was.
    """
    with _LOCK:
        try:
            document = tomlkit.parse(file.read_text(encoding="utf-8-sig"))
        except (TOMLKitError, UnicodeDecodeError) as error:
            raise StudyError(f"not valid TOML: {error}", file=file) from None
        yield document
        store_study(document, file)


def set_site(file: Path, site: str, values: Mapping[str, Any]) -> None:
    """Set keys of a site, such as ``position``, ``name``, ``fitted`` or ``touch_down_s``; None removes one.

    A new place removes ``near``: a site has one of them. Its ``[[records]]`` follow a new name.
    """
    with edit_study(file) as document:
        _assign(_find(document.get("sites", []), site, file, "sites"), values)
        for table in document.get("records", []):
            if table["site"] == site:
                table["site"] = values.get("name", site)


def set_record(file: Path, record: Record, values: Mapping[str, Any]) -> None:
    """Set keys of a record where the study file states it, such as ``touch_down_s``; None removes one."""
    if record.name == record.site.name:
        set_site(file, record.name, values)
        return
    with edit_study(file) as document:
        for table in document["records"]:
            if f"{table['site']}-{table['name']}" == record.name:
                _assign(table, values)


def add_site(file: Path, name: str, values: Mapping[str, Any]) -> None:
    """Append a site with its keys: ``position`` or ``near`` (LPS, mm), ``depth_mm``, ``region``."""
    with edit_study(file) as document:
        sites = document.setdefault("sites", tomlkit.aot())
        if not isinstance(sites, list):
            raise StudyError("the study has no [[sites]] to add to", file=file, place="sites")
        _append(sites, {"name": name, **values})


def remove_table(file: Path, place: str, name: str) -> None:
    """Take a site (of ``sites``) or an area (of ``socket.areas``) out of the study file.

    The record of a site stays where it is. Raises `StudyError` where there is none of that name.
    """
    with edit_study(file) as document:
        rows: Any = document
        for key in place.split("."):
            rows = rows.get(key, {})
        found = _find(rows, name, file, place)
        rows.remove(found)


def set_area(file: Path, name: str, values: Mapping[str, Any]) -> None:
    """Change an area of ``[[socket.areas]]``, or add one of that name; None removes a key."""
    with edit_study(file) as document:
        rows = document.setdefault("socket", tomlkit.table()).setdefault("areas", tomlkit.aot())
        area = _find_named(rows, name)
        if area is not None:
            _assign(area, values)
            return
        _append(rows, {"name": name, **values})


def set_trimline(file: Path, points: Sequence[Sequence[float]] | None) -> None:
    """State ``socket.trimline`` (LPS, mm) in the place of any other brim; None: there is the default one."""
    with edit_study(file) as document:
        table = document.setdefault("socket", tomlkit.table())
        for key in ("trim_mm", "trim_planes", "trimline"):
            table.pop(key, None)
        if points is not None:
            rows = tomlkit.array()
            rows.extend([[round(float(x), POSITION_DIGITS) + 0.0 for x in point] for point in points])
            table["trimline"] = rows.multiline(True)


def _find(rows: Any, name: str, file: Path, place: str) -> Any:
    """The table of this name in the list at ``place``. Raises `StudyError` where there is none."""
    found = _find_named(rows, name)
    if found is None:
        kind = place.split(".")[-1].removesuffix("s")
        raise StudyError(f"no {kind} is named {name!r}", file=file, place=place)
    return found


def _find_named(rows: Any, name: str) -> Any:
    """The table of a list that has this name; None where there is none, or no list."""
    tables = rows if isinstance(rows, list) else ()
    return next((table for table in tables if str(table.get("name")) == name), None)


def _append(rows: Any, values: Mapping[str, Any]) -> None:
    """Add a table to a list of tables, in the way in which the others of the list are written."""
    table = tomlkit.table() if isinstance(rows, AoT) else tomlkit.inline_table()
    _assign(table, values)
    rows.append(table)


def _assign(table: Any, values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if value is None:
            table.pop(key, None)
            continue
        if key in ("position", "near"):
            table.pop("near", None)
            value = [round(float(x), POSITION_DIGITS) for x in value]
        table[key] = value
