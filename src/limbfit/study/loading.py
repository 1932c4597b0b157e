"""Reading a study; errors name the file, the key and the remedy."""

import json
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ..anatomy.sites.markups import read_markups
from ..errors import StudyError, add_location
from ..extensions import load_extensions
from .study import Study
from .unused_keys import check_unused_keys


def load_study(path: str | Path, *, recorded: bool = True) -> Study:
    """Read and check a study; ``path`` is the file or its folder.

    Parameters
    ----------
    recorded : the records of the sites must exist; not where they are to be made.

    Raises
    ------
    StudyError
        With the file, the key and the remedy.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "study.toml"
    if not file.is_file():
        raise StudyError("no such study", file=file, remedy="give a study.toml or the folder that holds one")
    try:  # "-sig": editors on Windows may begin a file with a mark
        content = tomllib.loads(file.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StudyError(f"not valid TOML: {error}", file=file) from None
    notes = _place_by_markups(content, file)
    _load_extensions(content, file)
    with add_location(file=file):
        for key in ("file", "notes"):  # of a study, but none of its file
            if key in content:
                raise StudyError("unknown key", place=key, remedy="see docs/study.md for the keys")
        try:  # as JSON, of which neither "12" nor true is a number
            text = json.dumps(content | {"file": str(file), "notes": notes}, default=str)
            study = Study.model_validate_json(text, strict=True)
        except ValidationError as error:
            raise _build_study_error(error, content) from None
        for place, path in study.inputs.items():
            at = study.path(path)
            if (recorded or not place.startswith(("sites.", "records."))) and not at.exists():
                raise StudyError(f"{path} does not exist", place=place)
            if study.results.resolve().is_relative_to(at.resolve()):
                what = f"{path} holds the results of the study, and so changes with every run"
                raise StudyError(what, place=place, remedy="give it a folder of its own")
        check_unused_keys(study, content)
    unused = [name for name in study.indenters if name not in study.used_indenters]
    what = "no record names it; only limbfit design --protocol does"
    notes = (*notes, *(f"indenters.{name}: {what}" for name in unused))
    return study.model_copy(update={"notes": notes})


def _place_by_markups(content: dict[str, Any], file: Path) -> tuple[str, ...]:
    """Give sites without a place that of the control point of their name; say which points are left over.

    What is malformed is left for the check of the types to refuse.
    """
    table, sites = content.get("markups"), content.get("sites")
    if not isinstance(table, dict) or not isinstance(table.get("file"), str) or not isinstance(sites, list):
        return ()
    source = file.parent / table["file"]
    if not source.is_file():
        raise StudyError(f"{table['file']} does not exist", file=file, place="markups.file")
    points = read_markups(source)
    for site in (site for site in sites if isinstance(site, dict)):
        name = str(site.get("name"))
        is_placed = "position" in site or "near" in site
        with add_location(file=file, place=f"sites.{name}"):
            if is_placed and name in points:
                what = "the site has a place here and a control point in the markups file"
                raise StudyError(what, remedy="leave one of them out")
            if not is_placed and name not in points:
                known = ", ".join(map(repr, points)) or "none"
                what = f"no control point of {table['file']} is labelled {name!r}"
                raise StudyError(what, remedy=f"it has {known}")
        if not is_placed:
            site[table.get("gives", "position")] = points[name].tolist()
    unused = sorted(set(points) - {str(site.get("name")) for site in sites if isinstance(site, dict)})
    return (f"control points without a site: {', '.join(unused)}",) if unused else ()


def _load_extensions(content: dict[str, Any], file: Path) -> None:
    """Run the study's own Python files; what is malformed is left for the check of the types to refuse."""
    table = content.get("study")
    named = table.get("extensions", []) if isinstance(table, dict) else []
    if isinstance(named, list) and all(isinstance(name, str) for name in named):
        load_extensions(file.parent / name for name in named)


def _build_study_error(error: ValidationError, content: dict[str, Any]) -> StudyError:
    found = error.errors()
    first = next((one for one in found if one["type"] == "value_error"), found[0])  # it says most
    more = len(found) - 1
    place, kind, given = _name_place(first["loc"], content), first["type"], first["input"]
    what, remedy = first["msg"].removeprefix("Value error, "), None
    if kind == "extra_forbidden":
        what, remedy = "unknown key", "see docs/study.md for the keys"
    elif kind == "string_pattern_mismatch":
        what, remedy = f"{given!r} is no name", "begin with a letter; then A to Z, digits or _, up to 30"
    elif kind == "tuple_type" and isinstance(given, dict):
        what, remedy = "one table, and not a list of tables", f"write it in two brackets: [[{place}]]"
    elif kind in ("model_type", "dict_type"):
        what = "Input should be a table"
    return StudyError(what + (f" (and {more} more)" if more else ""), place=place, remedy=remedy)


def _name_place(keys: tuple[int | str, ...], content: Any) -> str | None:
    """Name the place that ``keys`` lead to, as ``sites.05.weight``; a table without a name by its number."""
    parts = []
    for depth, key in enumerate(keys):
        try:
            content = content[key]
        except (LookupError, TypeError):  # a key that is missing, or stands for a type that a value may have
            content = None
        part = str(key + 1 if isinstance(key, int) else key)
        if isinstance(key, int) and isinstance(content, dict) and keys[depth + 1 :] != ("name",):
            part = "-".join(str(content[name]) for name in ("site", "name") if name in content) or part
        parts.append(part)
    return ".".join(part for part in parts if "[" not in part) or None
