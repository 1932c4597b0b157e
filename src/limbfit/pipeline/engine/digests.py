"""Digests of what decides an answer: values, files, and source code.

The source of a function is its module, what that imports, and the files beside them.
A name imported from a package is followed to the module that defines it: a package's ``__init__`` that only
hands names on is no reason for all of the package to count.
"""

import ast
import hashlib
import inspect
import json
import re
from collections.abc import Callable, Collection
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from ..._version import __version__
from ...folders import list_files

PACKAGE = Path(__file__).parents[2]
_DEFINITION = re.compile(r"^(?:def |class |async |@)", re.MULTILINE)
_LAZY = "_HOME"  # name of the table of an ``__init__`` that loads its names when they are first used


def compute_digest(*parts: Any) -> str:
    """A short stable digest of JSON-like values, and arrays."""
    text = json.dumps(parts, sort_keys=True, default=to_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def to_plain(value: Any) -> Any:
    """NumPy scalars and arrays, and collections such as ranges, as what JSON knows."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return list(value) if isinstance(value, Collection) else str(value)


def find_data_files(path: Path) -> list[Path]:
    """The files that hold the voxels of an image of which ``path`` is the header (.mhd, .nhdr); else none."""
    if path.suffix.lower() not in (".mhd", ".nhdr"):
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    names = [re.split("[=:]", line, maxsplit=1)[-1].strip() for line in lines]
    return [file for name in names if name and (file := path.parent / name).is_file()]


def compute_file_digest(file: Path) -> str:
    """SHA-256 of what one file holds."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def compute_input_digest(path: Path) -> str:
    """SHA-256 of an input: a file, a header with its voxels, or names and contents below a folder."""
    files = list_files(path) if path.is_dir() else [path, *find_data_files(path)]
    if files == [path]:
        return compute_file_digest(path)
    sha = hashlib.sha256()
    for file in files:
        sha.update(file.relative_to(path).as_posix().encode() if path.is_dir() else b"")
        sha.update(file.read_bytes())
    return sha.hexdigest()


def find_sources(function: Callable[..., Any]) -> tuple[Path, ...]:
    """Every file that decides what a function does, sorted: modules, templates, scripts, styles.

    Other packages are left out: their versions are stored beside each result.
    """
    return _find_closure(Path(inspect.getfile(function)))


@cache
def code_digest(function: Callable[..., Any]) -> str:
    """Digest of `find_sources` a function: what it made is stale when any of them has changed."""
    return compute_digest(__version__, code_parts(function))


def code_parts(function: Callable[..., Any]) -> dict[str, str]:
    """Digest of each of `find_sources` a function, by its path in the package."""
    return {format_source(file): _digest(file) for file in find_sources(function)}


@cache
def format_source(file: Path) -> str:
    """A source file's path in the package; the name alone of one that is outside."""
    return file.relative_to(PACKAGE).as_posix() if file.is_relative_to(PACKAGE) else file.name


_digest = cache(compute_file_digest)


@cache
def _find_closure(file: Path) -> tuple[Path, ...]:
    found: set[Path] = set()
    waiting = [file]
    while waiting:
        here = waiting.pop()
        if here not in found:
            found.add(here)
            if here.suffix == ".py":
                imports, beside, _ = _read(here)
                waiting += [home for place, name in imports for home in _find_homes(place, name)]
                waiting += beside
    return tuple(sorted(found))


class _Module(NamedTuple):
    """What the text of a module says: its imports (place without suffix, name), files that it names, lazy
    names."""

    imports: list[tuple[Path, str]]
    beside: tuple[Path, ...]
    lazy: dict[str, Path]


@cache
def _read(file: Path) -> _Module:
    imports: list[tuple[Path, str]] = []
    lazy: dict[str, Path] = {}
    text = file.read_text(encoding="utf-8")
    for node in ast.walk(_parse_head(text)):
        if isinstance(node, ast.Import):
            paths = [alias.name.split(".") for alias in node.names]
            imports += [(_place(path[:-1]), path[-1]) for path in paths if path[0] == PACKAGE.name]
        elif isinstance(node, ast.ImportFrom):
            path = node.module.split(".") if node.module else []
            place = file.parents[node.level - 1].joinpath(*path) if node.level else _place(path)
            if node.level or path[0] == PACKAGE.name:
                imports += [(place, alias.name) for alias in node.names]
        elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == _LAZY:
            homes = ast.literal_eval(node.value) if isinstance(node.value, ast.Dict) else _read_stub(file)
            lazy = {name: file.parent.joinpath(*home.split(".")) for name, home in homes.items()}
    return _Module(imports, _find_beside(file, text), lazy)


def _parse_head(text: str) -> ast.Module:
    """What stands before the first function or class of a module: imports stand nowhere else, and reading the
    rest takes most of the time."""
    first = _DEFINITION.search(text)
    try:
        return ast.parse(text[: first.start()] if first else text)
    except SyntaxError:  # that line was one of a string
        return ast.parse(text)


def _find_beside(file: Path, text: str) -> tuple[Path, ...]:
    """Files beside the module that it names in a string, and those in a folder that is no package."""
    names = {name for name in _list_names(file.parent) if name in text}
    if not names:  # as a rule: it spares the walk through all expressions
        return ()
    values = (node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant))
    places = [file.parent / name for name in names.intersection(v for v in values if isinstance(v, str))]
    inside = [path for place in places for path in place.rglob("*") if path.is_file()]
    return (*(place for place in places if place.is_file()), *inside)


@cache
def _list_names(folder: Path) -> frozenset[str]:
    """The files of a folder, and the folders in it that are no packages."""
    own = ("__init__.py", "__pycache__")
    return frozenset(
        path.name for path in folder.iterdir() if path.name not in own and not (path / "__init__.py").exists()
    )


def _read_stub(file: Path) -> dict[str, str]:
    """The homes of the names in the stub beside an ``__init__`` that loads them by it."""
    stub = ast.parse(file.with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom) and node.module]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def _place(path: list[str]) -> Path:
    return PACKAGE.parent.joinpath(*path)


def _find_homes(place: Path, name: str) -> list[Path]:
    """The file that holds a name imported from ``place``: a module in it, or the one that defines the name.

    A lazy package that is imported as a whole may load any of its names.
    """
    inside = _find_file(place / name)
    if inside is not None:
        names = _read(inside).lazy if inside.name == "__init__.py" else {}
        return [inside, *(home for each, its in names.items() for home in _find_homes(its, each))]
    file = _find_file(place)
    if file is None:
        raise FileNotFoundError(f"no module {place}")
    if file.name == "__init__.py":
        known = _read(file)
        if name in known.lazy:
            return _find_homes(known.lazy[name], name)
        for home, handed_on in known.imports:
            if handed_on == name:
                return _find_homes(home, name)
    return [file]


@cache
def _find_file(place: Path) -> Path | None:
    files = place.with_name(f"{place.name}.py"), place / "__init__.py"
    return next((file for file in files if file.is_file()), None)
