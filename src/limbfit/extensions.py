"""What a study adds to limbfit with Python files of its own: they register, by name, what is theirs.

A file is run once in every process that needs it, workers among them, and again when it has changed.  Its
digest counts wherever it can change an answer.
"""

import sys
from collections.abc import Iterable, Iterator, Mapping
from hashlib import sha256
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, Generic, TypeVar

from .errors import InputError

T = TypeVar("T")
_loaded: dict[Path, str] = {}  # digests of the files that have been run, as they were last
_running: list[Path] = []  # the file that is being run


class Registry(Generic[T]):
    """Things of one kind by name: those of limbfit, which stay, and those that are added."""

    def __init__(self, kind: str, own: Mapping[str, T]) -> None:
        self._kind, self._own = kind, dict(own)
        self._added: dict[str, tuple[T, Path | None]] = {}

    def add(self, name: str, what: T) -> None:
        """Register ``what``; a file may register its own names again, and a session anything. Raises
        `InputError` where the name is taken.
        """
        source = _running[-1] if _running else None
        known = self._added[name][1] if name in self._added else None
        if name in self._own or (known is not None and source is not None and known != source):
            raise InputError(f"the {self._kind} {name!r} exists already", remedy="give yours another name")
        self._added[name] = what, source

    def __getitem__(self, name: str) -> T:
        """What is registered by a name. Raises `InputError` where nothing is."""
        if name in self._own:
            return self._own[name]
        if name in self._added:
            return self._added[name][0]
        remedy = f"use {', '.join(self.names)}, or name the file that registers it in study.extensions"
        raise InputError(f"no {self._kind} is named {name!r}", remedy=remedy)

    def __iter__(self) -> Iterator[T]:
        """What is registered, limbfit's own first."""
        return (self[name] for name in self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """All names, limbfit's own first."""
        return *self._own, *self._added


def load_extensions(files: Iterable[Path]) -> None:
    """Run files that register something, unless that was done. Raises `InputError` for a file that cannot be
    run, with what it raised.
    """
    for file in files:
        digest, place = _compute_digest(file), file.resolve()
        if digest not in _loaded.values():
            _loaded.pop(place, None)  # what it registered is replaced; if it comes back, it is run again
            _run(place, f"limbfit_extension_{digest[:16]}")
            _loaded[place] = digest


def compute_extensions_digest(files: Iterable[Path]) -> str:
    """SHA-256 of what extension files hold; empty where there are none."""
    each = [_compute_digest(file) for file in files]
    return sha256("".join(each).encode()).hexdigest() if each else ""


def _compute_digest(file: Path) -> str:
    try:
        return sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=file) from error


def _run(file: Path, name: str) -> None:
    spec = spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise InputError("is no Python file", file=file, remedy="give a file that ends in .py")
    module = module_from_spec(spec)
    sys.modules[name] = module  # what it defines can then be sent to other processes that have run it
    _running.append(file)
    try:
        # Not by the loader: it would run stored bytecode again after a change within one second.
        exec(compile(file.read_bytes(), file, "exec"), module.__dict__)
    except InputError:
        del sys.modules[name]
        raise
    except Exception as error:
        del sys.modules[name]
        raise InputError(f"{type(error).__name__}: {error}", file=file, place="extension") from error
    finally:
        _running.pop()


def import_extra(module: str, extra: str, refusal: InputError | None = None) -> Any:
    """Import a module of a library that an extra of limbfit installs. Raises `InputError` where it is not
    installed: ``refusal``, where that says better what needs it.
    """
    try:
        return import_module(module)
    except ImportError:
        library, remedy = module.partition(".")[0], f"pip install 'limbfit[{extra}]'"
        raise refusal or InputError(f"{library} is not installed", remedy=remedy) from None
