"""The folder of a study: paths stay inside it, and fingerprints show which of its files have changed."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..pipeline.commands.acquire import FOLDER as ACQUIRED
from ..pipeline.engine.store import Store
from ..study import Study, load_study

Json = dict[str, Any]  # what an answer holds


@dataclass(frozen=True)
class StudyFolder:
    """The folder of one study, by its file; nothing is kept in memory between requests."""

    file: Path

    @property
    def folder(self) -> Path:
        return self.file.parent

    @property
    def results(self) -> Path:
        return self.folder / "results"

    @property
    def store(self) -> Store:
        return Store(self.results)

    @property
    def logs(self) -> list[Path]:
        """The logs of runs, the newest last."""
        return sorted((self.results / "log").glob("*.jsonl"))

    @property
    def is_new(self) -> bool:
        """True where there is no study file yet."""
        return not self.file.is_file()

    def load(self) -> Study:
        """The study as its file now states it; its records need not exist yet."""
        return load_study(self.file, recorded=False)

    def artefact(self, *parts: str) -> Path:
        """The path of a file under ``results/``, given as plain names, one for each part. Raises `InputError`
        where a part is no plain name, or the file lies outside of ``results/`` (by a link), and
        `FileNotFoundError` where there is none.
        """
        return resolve_inside(self.results, *parts)

    def changes(self) -> dict[str, str]:
        """A fingerprint of each thing that a page may have to read again."""
        results = self.results
        work = results.glob(".work-calibrate-*/runs")
        files: dict[str, Iterable[Path]] = {
            "study": [self.file],
            "stages": [*sorted(results.glob("*/stage.json")), *sorted(results.glob(".work-*"))],
            "labels": [results / place / "labels.seg.nrrd" for place in ("segment", "by-hand")],
            "log": [*self.logs[-1:], *work],
            "acquired": sorted(self.folder.glob(f"{ACQUIRED}/*/*")),
        }
        return {topic: compute_fingerprint(paths) for topic, paths in files.items()}


def resolve_inside(root: Path, *parts: str, is_new: bool = False) -> Path:
    """The path of a file below ``root``, given by its parts; see `StudyFolder.artefact` for the errors.

    ``is_new``: it need not be there.
    """
    for part in parts:
        is_plain = bool(part) and part.isprintable() and not set(part) & set('/\\:*?"<>|')
        if not is_plain or part.startswith("."):
            raise InputError("not the name of a file of the study", remedy="names have no path in them")
    path = root.joinpath(*parts)
    if not path.resolve().is_relative_to(root.resolve()):
        raise InputError(f"the file lies outside of {root.name}")
    if not is_new and not path.is_file():
        raise FileNotFoundError("/".join(parts))
    return path


def compute_fingerprint(files: Iterable[Path]) -> str:
    """A text that changes when one of the files is written, appears or disappears."""
    states: list[Any] = []
    for file in files:
        try:
            stat = file.stat()
        except OSError:
            states.append((file.name, None))
        else:
            states.append((str(file), stat.st_mtime_ns, stat.st_size, stat.st_ino))
    return hashlib.sha256(repr(states).encode()).hexdigest()[:16]
