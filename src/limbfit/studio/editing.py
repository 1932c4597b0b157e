"""Changes of ``study.toml`` that keep its comments, its order and its layout.

Every change is made on the text, written beside the file, read back as a study, and only then put in its
place: a change that the study file's own checks refuse leaves the file as it was.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT

from ..errors import StudyError
from ..study import Record, Study, load_study

POSITION_DIGITS = 2  # of a place in mm


def edit_study(file: Path, change: Callable[[tomlkit.TOMLDocument], None]) -> Study:
    """Change the study file and return the changed study.

    Parameters
    ----------
    file : the ``study.toml``.
    change : alters the document it is given.

    Raises
    ------
    StudyError
        Where the file is not TOML, or the study would not be valid; the file is left as it was.
    """
    try:
        document = tomlkit.parse(file.read_text(encoding="utf-8"))
    except (TOMLKitError, UnicodeDecodeError) as error:
        raise StudyError(f"not valid TOML: {error}", file=file) from None
    change(document)
    handle, name = tempfile.mkstemp(prefix=".study-", suffix=".toml", dir=file.parent)
    written = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            text = tomlkit.dumps(document)
            stream.write(text if text.endswith("\n") else f"{text}\n")
        try:
            load_study(written, recorded=False)
        except StudyError as error:
            raise StudyError(error.what, file=file, place=error.place, remedy=error.remedy) from None
        os.chmod(written, file.stat().st_mode & 0o777)
        os.replace(written, file)
    except BaseException:
        written.unlink(missing_ok=True)
        raise
    return load_study(file, recorded=False)


def set_site(file: Path, site: str, values: Mapping[str, Any]) -> Study:
    """Set keys of a site, such as ``position``, ``name``, ``fitted`` or ``touch_down_s``; None removes one.

    A new place removes ``near``, and the other way round: a site has one of them.
    """
    return edit_study(file, lambda document: _assign(_find_table(document, site, file), values))


def set_record(file: Path, record: Record, values: Mapping[str, Any]) -> Study:
    """Set keys of a record where the study file states it, such as ``touch_down_s``; None removes one."""
    if record.name == record.site.name:
        return set_site(file, record.name, values)

    def change(document: tomlkit.TOMLDocument) -> None:
        for table in document["records"]:
            if f"{table['site']}-{table['name']}" == record.name:
                _assign(table, values)

    return edit_study(file, change)


def add_site(file: Path, name: str, position: Sequence[float], values: Mapping[str, Any]) -> Study:
    """Append a site at a place (LPS, mm) with more keys: ``depth_mm`` or ``trace``, ``region``, ``axis``."""

    def change(document: tomlkit.TOMLDocument) -> None:
        sites = document.get("sites")
        if not isinstance(sites, list):
            raise StudyError("the study has no [[sites]] to add to", file=file, place="sites")
        table = tomlkit.table()
        _assign(table, {"name": name, "position": position, **values})
        sites.append(table)

    return edit_study(file, change)


def remove_site(file: Path, name: str) -> Study:
    """Take a site out of the study; its record stays where it is."""

    def change(document: tomlkit.TOMLDocument) -> None:
        _find_table(document, name, file)
        sites = document["sites"]
        del sites[[str(site.get("name")) for site in sites].index(name)]

    return edit_study(file, change)


def set_key(file: Path, table: str, key: str, value: Any) -> Study:
    """Set (or with None remove) one key of one table, such as ``segmentation`` and ``labels``."""

    def change(document: tomlkit.TOMLDocument) -> None:
        if table not in document:
            document[table] = tomlkit.table()
        _assign(document[table], {key: value})

    return edit_study(file, change)


def set_area(file: Path, name: str, values: Mapping[str, Any]) -> Study:
    """Change an area of ``[[socket.areas]]``, or add one of that name; None removes a key."""

    def change(document: tomlkit.TOMLDocument) -> None:
        rows = _ensure_areas(document)
        area = next((row for row in rows if str(row.get("name")) == name), None)
        if area is None:
            area = tomlkit.table() if isinstance(rows, AoT) else tomlkit.inline_table()
            _assign(area, {"name": name, **values})
            rows.append(area)
        else:
            _assign(area, values)

    return edit_study(file, change)


def remove_area(file: Path, name: str) -> Study:
    """Take an area out of the study file. Raises `StudyError` where there is none of that name."""

    def change(document: tomlkit.TOMLDocument) -> None:
        rows = _ensure_areas(document)
        names = [str(row.get("name")) for row in rows]
        if name not in names:
            raise StudyError(f"no area is named {name!r}", file=file, place="socket.areas")
        del rows[names.index(name)]

    return edit_study(file, change)


def set_trimline(file: Path, points: Sequence[Sequence[float]] | None) -> Study:
    """State ``socket.trimline`` (LPS, mm) in the place of any other brim; None: there is the default one."""

    def change(document: tomlkit.TOMLDocument) -> None:
        table = _ensure_socket(document)
        for key in ("trim_mm", "trim_planes", "trimline"):
            table.pop(key, None)
        if points is not None:
            rows = tomlkit.array()
            rows.extend([[round(float(x), POSITION_DIGITS) + 0.0 for x in point] for point in points])
            table["trimline"] = rows.multiline(True)

    return edit_study(file, change)


def _ensure_areas(document: tomlkit.TOMLDocument) -> Any:
    """The list of areas, made where there is none."""
    table = _ensure_socket(document)
    if "areas" not in table:
        table["areas"] = tomlkit.aot()
    return table["areas"]


def _ensure_socket(document: tomlkit.TOMLDocument) -> Any:
    """The table ``[socket]``, made where there is none."""
    if "socket" not in document:
        document["socket"] = tomlkit.table()
    return document["socket"]


def _find_table(document: tomlkit.TOMLDocument, name: str, file: Path) -> Any:
    sites = document.get("sites")
    for site in sites if isinstance(sites, list) else ():
        if str(site.get("name")) == name:
            return site
    raise StudyError(f"no site is named {name!r}", file=file, place="sites")


def _assign(table: Any, values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        if value is None:
            table.pop(key, None)
            continue
        if key in ("position", "near"):
            table.pop("near" if key == "position" else "position", None)
            value = [round(float(x), POSITION_DIGITS) for x in value]
        if isinstance(value, (list, tuple)):
            value = [float(x) if isinstance(x, float) else x for x in value]
        table[key] = value
