"""What every stored result is: a frozen model that is checked when written and read; and curves as CSV."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from ..arrays import Array
from ..errors import InputError

Parameters = dict[str, dict[str, float]]  # by tissue, then by key
Interval = tuple[float, float]
Intervals = Mapping[str, Mapping[str, Interval]]
Vector = tuple[float, float, float]
Matrix = Sequence[Sequence[float]]


class ResultPart(BaseModel):
    """A table of a stored result: unknown keys and numbers that are not finite are refused.

    A part can be built from any object whose attributes have its keys. A key with a default is left out of
    the file where it was not given.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, from_attributes=True)

    @field_validator("*", mode="before")
    @classmethod
    def _list_array(cls, value: Any) -> Any:
        """An array or number of NumPy as what JSON knows."""
        return value.tolist() if hasattr(value, "tolist") else value

    def to_plain(self) -> dict[str, Any]:
        """Return what JSON knows, with the keys that were given, in the order of the model."""
        return self.model_dump(mode="json", exclude_unset=True)

    @classmethod
    def read_file(cls, file: Path, remedy: str) -> Self:
        """Read a file that is there. Raises `InputError` where it is no JSON, or has other keys."""
        try:
            return cls.model_validate(json.loads(file.read_text(encoding="utf-8")))
        except ValidationError as error:
            raise InputError(_describe_first(error), file=file, remedy=remedy) from None
        except ValueError as error:
            raise InputError(f"not readable: {error}", file=file, remedy=remedy) from None


class StoredResult(ResultPart):
    """A result with a JSON file of its own: ``FILE`` below the results folder, made by ``COMMAND``.

    ``FILE`` has a star where there is a file for each site or stage.
    """

    FILE: ClassVar[str]
    COMMAND: ClassVar[str] = "limbfit run"

    @classmethod
    def find(cls, results: Path, name: str = "") -> Self | None:
        """Read it, ``name`` in place of the star; None where it is not there. Errors as `read_file`."""
        file = results / cls.FILE.replace("*", name)
        return cls.read_file(file, f"run {cls.COMMAND} again") if file.is_file() else None

    @classmethod
    def read(cls, results: Path, name: str = "") -> Self:
        """Read it as `find` does. Raises `InputError` also where it is not there."""
        found = cls.find(results, name)
        if found is None:
            file = results / cls.FILE.replace("*", name)
            raise InputError("not there yet", file=file, remedy=f"run {cls.COMMAND} first")
        return found

    @classmethod
    def find_all(cls, results: Path) -> dict[str, Self]:
        """Read every file that is there, by what stands in place of the star."""
        start, end = cls.FILE.split("*")
        files = sorted(file.relative_to(results).as_posix() for file in results.glob(cls.FILE))
        names = [file.removeprefix(start).removesuffix(end) for file in files]
        # A stage that is not done has a hidden folder.
        return {name: cls.read(results, name) for name in names if not name.startswith(".")}


def _describe_first(error: ValidationError) -> str:
    """The first thing that is wrong, with its key."""
    first = error.errors()[0]
    key = ".".join(map(str, first["loc"]))
    if first["type"] == "missing":
        return f"has no key {key!r}: another version of limbfit wrote it"
    if first["type"] == "extra_forbidden":
        return f"has an unknown key {key!r}: another version of limbfit wrote it"
    return f"is wrong at {key!r}: {first['msg']}"


def read_curves(file: Path) -> dict[str, Array]:
    """Read the columns (n,) of a CSV of numbers, by their heads. Raises `InputError` for any other file."""
    lines = file.read_text(encoding="utf-8").splitlines()
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    try:
        values = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"not readable: {error}", file=file, remedy="run its stage again") from None
    if values.shape[1:] != (len(names),):
        raise InputError("its rows do not fit its header", file=file, remedy="run its stage again")
    return {name: values[:, i] for i, name in enumerate(names)}
