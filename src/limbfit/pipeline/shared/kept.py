"""What took long and is kept on disk as it finishes: facts and arrays, by the key of what decides them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .artefacts import atomic, plain
from .store import EARLIER, RUNS

Facts = dict[str, Any]
Arrays = Mapping[str, NDArray[np.float64]]
Made = tuple[Facts, Arrays]


class Kept:
    """One file for each key, in ``folder/runs``.

    ``also`` are folders of earlier results, beside that of interrupted attempts: what is found there is
    copied, since they may be replaced.
    """

    def __init__(self, folder: Path, also: Sequence[Path] = ()) -> None:
        self.folder = folder / RUNS
        self.places = (self.folder, folder / EARLIER, *(place / RUNS for place in also))
        self.folder.mkdir(parents=True, exist_ok=True)

    def get(self, key: str, make: Callable[[], Made]) -> Made:
        """What is kept under a key, or is made now; facts are those that JSON gives back either way."""
        name = f"{key}.npz"
        found = next((place / name for place in self.places if (place / name).is_file()), None)
        if found is None:
            facts, arrays = make()
            with atomic(self.folder / name) as stream:
                np.savez(stream, facts=json.dumps(facts, default=plain), **arrays)  # type: ignore[arg-type]
        elif found.parent != self.folder:
            with atomic(self.folder / name) as stream:
                stream.write(found.read_bytes())
        with np.load(self.folder / name) as stored:
            arrays = {part: stored[part] for part in stored.files if part != "facts"}
            return json.loads(str(stored["facts"])), arrays
