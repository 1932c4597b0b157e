"""Study files that limbfit writes: each is read back as a study before it takes the place of another."""

import os
import shutil
import tempfile
from pathlib import Path
from typing import Any, Literal

import tomlkit
from pydantic import BaseModel, ConfigDict, Field

from ..errors import StudyError
from .loading import load_study


class NewStudy(BaseModel):
    """What is chosen for a new study; files are paths below its folder.

    ``image`` and ``markers`` are images, or folders of DICOM of which ``series`` and ``markers_series`` are
    chosen; ``skin`` and ``bones`` are closed surfaces in their stead. ``indenter`` and ``sites`` have the
    keys of the study file.
    """

    model_config = ConfigDict(extra="forbid")

    name: str = Field(min_length=1, max_length=200)
    image: str | None = None
    series: str | None = None
    markers: str | None = None
    markers_series: str | None = None
    skin: str | None = None
    bones: dict[str, str] = {}
    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    indenter: dict[str, str | float] = {}
    sites: list[dict[str, Any]] = []


def create_study(folder: Path, new: NewStudy) -> Path:
    """Write a folder's study file. Raises `StudyError` where there is one, or it would not be valid."""
    file = folder / "study.toml"
    if file.exists():
        remedy = "change that one, or choose another folder"
        raise StudyError("there is a study already", file=file, remedy=remedy)
    image = {key: getattr(new, key) for key in ("series", "markers", "markers_series")}
    tables = {
        "study": {"name": new.name},
        "image": {"path": new.image, **image} if new.image else {},
        "surfaces": {"skin": new.skin, "unit": new.unit, "bones": new.bones} if new.skin else {},
        "indenter": new.indenter,
    }
    document = tomlkit.document()
    for key, table in tables.items():
        if stated := {name: value for name, value in table.items() if value}:
            document[key] = stated
    if new.sites:
        document["sites"] = tomlkit.aot()
        for site in new.sites:
            stated = {key: value for key, value in site.items() if value is not None}
            document["sites"].append(tomlkit.item(stated))
    store_study(document, file)
    return file


def store_study(document: tomlkit.TOMLDocument, file: Path) -> None:
    """Put a document in the place of the study file. Raises `StudyError` where it is no valid study."""
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
        if file.exists():
            shutil.copymode(file, written)
        written.replace(file)
    finally:
        written.unlink(missing_ok=True)
