"""Names of segments from other programs, and segments that overlap as one label map."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...errors import LabelError
from ..grid import DEFAULT_NAMES

Mask = NDArray[np.bool_]


def normalise_name(name: str) -> str:
    """Users of other programs write ``Soft Tissue`` or ``soft_tissue``; here it is lower case with spaces.

    Names become names of files, so whatever is not a letter, a digit or one of ``().+-`` becomes a space.
    """
    words = re.sub(r"[^\w().+-]|_", " ", str(name).lower()).strip(" .").split()
    return " ".join(words)[:40] or "unnamed"


def flatten(masks: Sequence[Mask], names: Sequence[str]) -> tuple[NDArray[np.uint8], dict[int, str]]:
    """Overlapping segments as one map: where two overlap the smaller wins, as a bone in a limb does.

    Raises
    ------
    LabelError
        For no segment, or two of one name.
    """
    if not names:
        raise LabelError("the file names no segment", remedy="export it again with its segments")
    if len(set(names)) < len(names):
        raise LabelError("two segments have the same name", remedy="give them different names")
    values = _label_values(names)
    flat = np.zeros(masks[0].shape, dtype=np.uint8)
    for n in sorted(range(len(masks)), key=lambda n: -int(masks[n].sum())):
        flat[masks[n]] = values[n]
    return flat, dict(zip(values, names))


def _label_values(names: Sequence[str]) -> list[int]:
    """The default value of a known name, free values for others."""
    default = {name: value for value, name in DEFAULT_NAMES.items()}
    free = iter(range(len(default) + 1, 256))
    return [default[name] if name in default else next(free) for name in names]
