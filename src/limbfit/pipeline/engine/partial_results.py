"""What took long and is kept on disk as it finishes: facts and arrays, by the key of what decides them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .storage import to_plain, write_atomically
from .store import EARLIER, RUNS

Facts = dict[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
Made = tuple[Facts, Arrays]


class ResultFiles:
    """One file for each key, in ``folder/runs``.

    ``also`` are folders of earlier results, beside that of interrupted attempts: what is found there is
    copied, since they may be replaced.
    """

    def __init__(self, folder: Path, also: Sequence[Path] = ()) -> None:
        self.folder = folder / RUNS
        self.places = (self.folder, folder / EARLIER, *(place / RUNS for place in also))
        self.folder.mkdir(parents=True, exist_ok=True)

    def find(self, key: str) -> Path | None:
        """The file that is kept under a key."""
        name = f"{key}.npz"
        return next((place / name for place in self.places if (place / name).is_file()), None)

    def get(self, key: str, make: Callable[[], Made]) -> Made:
        """What is kept under a key, or is made now; facts are those that JSON gives back either way."""
        name, found = f"{key}.npz", self.find(key)
        if found is None:
            self.put(key, make())
        elif found.parent != self.folder:
            with write_atomically(self.folder / name) as stream:
                stream.write(found.read_bytes())
        return _read(self.folder / name)

    def put(self, key: str, made: Made) -> None:
        """Keep it under a key, in the place of what was there."""
        facts, arrays = made
        with write_atomically(self.folder / f"{key}.npz") as stream:
            np.savez(stream, facts=json.dumps(facts, default=to_plain), **arrays)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Begun:
    """What is known of something that is not at its end: under the ``key`` that this will have."""

    kept: ResultFiles
    key: str

    @property
    def _name(self) -> str:
        return f"begun-{self.key}"

    def latest(self) -> Made | None:
        """What was put there last; None where it is not begun."""
        found = self.kept.find(self._name)
        return None if found is None else _read(found)

    def put(self, made: Made) -> None:
        """Keep it in the place of what was known before."""
        self.kept.put(self._name, made)

    def drop(self) -> None:
        """It has come to its end, which is stored."""
        (self.kept.folder / f"{self._name}.npz").unlink(missing_ok=True)


def _read(file: Path) -> Made:
    with np.load(file) as stored:
        arrays = {part: stored[part] for part in stored.files if part != "facts"}
        return json.loads(str(stored["facts"])), arrays
