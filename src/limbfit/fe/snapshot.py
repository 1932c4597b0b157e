"""A simulation between two steps as JSON values and arrays, which a file can keep, to be gone on with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Kind = TypeVar("Kind")


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What is known after a step: ``facts`` that JSON can hold, and ``arrays``, both by name."""

    facts: Mapping[str, Any]
    arrays: Mapping[str, Array]

    @classmethod
    def of(cls, **values: Any) -> Snapshot:
        """Of dataclasses, sequences, arrays and plain values; what is in something is named after a dot."""
        facts: dict[str, Any] = {}
        arrays: dict[str, Array] = {}
        for name, value in values.items():
            _flatten(name, value, facts, arrays)
        return cls(facts, arrays)

    def like(self, name: str, pattern: Kind) -> Kind:
        """The value of that name, a dataclass of the kind of ``pattern``, whose other fields it takes."""
        known = {}
        for one in fields(pattern):  # type: ignore[arg-type]
            inner, old = f"{name}.{one.name}", getattr(pattern, one.name)
            if inner in self.arrays or inner in self.facts:
                known[one.name] = self[inner]
            elif is_dataclass(old):
                known[one.name] = self.like(inner, old)
        return replace(pattern, **known)  # type: ignore[type-var]

    def __getitem__(self, name: str) -> Any:
        """An array, or a plain value."""
        return self.arrays[name] if name in self.arrays else self.facts[name]


@dataclass(frozen=True)
class Checkpoints:
    """When a simulation is kept: after the steps at ``times`` (s) ``keep`` is given a `Snapshot`."""

    times: Sequence[float]
    keep: Callable[[Snapshot], None]

    def at(self, time: float) -> bool:
        return bool(np.isclose(time, self.times, rtol=1e-9, atol=0.0).any())


def _flatten(name: str, value: Any, facts: dict[str, Any], arrays: dict[str, Array]) -> None:
    if isinstance(value, np.ndarray):
        arrays[name] = value
    elif is_dataclass(value):
        for one in fields(value):
            _flatten(f"{name}.{one.name}", getattr(value, one.name), facts, arrays)
    elif isinstance(value, (list, tuple)) and any(is_dataclass(one) for one in value):
        for i, one in enumerate(value):
            _flatten(f"{name}.{i}", one, facts, arrays)
    else:
        facts[name] = value
