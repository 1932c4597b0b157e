"""What took long and is kept on disk as it finishes: facts and arrays, by the key of what decides them."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from .storage import to_plain, write_atomically
from .store import EARLIER

Facts = dict[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
Made = tuple[Facts, Arrays]


class ResultFiles:
    """One file for each key, in ``folder``.

    ``also`` are folders of earlier results, beside that of interrupted attempts: what is found there is
    copied, since they may be replaced.
    """

    def __init__(self, folder: Path, also: Iterable[Path] = ()) -> None:
        self.folder = folder
        self.places = (folder, folder.parent / EARLIER, *also)
        folder.mkdir(parents=True, exist_ok=True)

    def find(self, key: str) -> Made | None:
        """What is kept whole under a key; facts are those that JSON gives back."""
        own = self._place(key)
        for file in (place / own.name for place in self.places):
            found = read_made(file)
            if found is not None:
                if file != own:
                    with write_atomically(own) as stream:
                        stream.write(file.read_bytes())
                return found
        return None

    def get(self, key: str, make: Callable[[], Made]) -> Made:
        """What is kept under a key, or is made now."""
        found = self.find(key)
        if found is None:
            self.put(key, make())
            found = self.find(key)
            assert found is not None
        return found

    def put(self, key: str, made: Made) -> None:
        """Keep it under a key, in the place of what was there."""
        facts, arrays = made
        with write_atomically(self._place(key)) as stream:
            np.savez(stream, facts=json.dumps(facts, default=to_plain), **arrays)  # type: ignore[arg-type]

    def drop(self, key: str) -> None:
        """Keep nothing under a key."""
        self._place(key).unlink(missing_ok=True)

    def _place(self, key: str) -> Path:
        return self.folder / f"{key}.npz"


def read_made(file: Path) -> Made | None:
    """Facts and arrays of a file of `ResultFiles`; None where there is none, or one that was cut short."""
    try:
        with np.load(file) as stored:
            arrays = {part: stored[part] for part in stored.files if part != "facts"}
            return json.loads(str(stored["facts"])), arrays
    except (FileNotFoundError, EOFError, ValueError, KeyError, BadZipFile):
        return None
