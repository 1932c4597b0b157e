"""Studies and records as users write and change them, what is stored, and what a change makes stale."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from limbfit.arrays import Array
from limbfit.pipeline.commands.run import compute_keys
from limbfit.study import Study, load_study


def write_study(folder: Path, text: str, files: Sequence[str] = ("skin.stl", "1.csv")) -> Study:
    """The study of a text; the files that it names are there, if only as empty ones."""
    for name in files:
        (folder / name).touch()
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return load_study(folder)


def edit(study: Path, old: str, new: str, count: int = -1) -> None:
    """Replace what stands in the file wherever it stands, or ``count`` times; it has to be there."""
    file = study / "study.toml"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, count), encoding="utf-8")


def append(study: Path, text: str) -> None:
    with (study / "study.toml").open("a", encoding="utf-8") as stream:
        stream.write(text)


def write_record(file: Path, table: Array) -> None:
    """A record of times, displacements and forces in columns."""
    np.savetxt(file, table, delimiter=",", header="time_s,displacement_mm,force_N", comments="")


def rewrite(record: Path, change: Callable[[Array], Array]) -> None:
    write_record(record, change(np.loadtxt(record, delimiter=",", skiprows=1)))


def list_stale(before: Study, after: Study) -> set[str]:
    """The stages of a study that are others in another study."""
    then, now = compute_keys(before), compute_keys(after)
    return {stage for stage in then if then[stage] != now[stage]}


@contextmanager
def rewritten(file: Path) -> Iterator[Any]:
    """The content of a stored JSON file, which is written again with what is changed of it within."""
    content = json.loads(file.read_text())
    yield content
    file.write_text(json.dumps(content))
