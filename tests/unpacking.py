"""Blocks of arrays read back, as ``static/arrays.js`` reads them."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from limbfit.web import MAGIC


def unpack(block: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and facts of a block.

    Raises
    ------
    ValueError
        When it is not such a block.
    """
    if block[: len(MAGIC)] != MAGIC:
        raise ValueError("not a block of arrays")
    start = len(MAGIC) + 4 + int.from_bytes(block[len(MAGIC) : len(MAGIC) + 4], "little")
    head = json.loads(block[len(MAGIC) + 4 : start])
    arrays = {}
    for name, row in head["arrays"].items():
        count = int(np.prod(row["shape"]))
        values = np.frombuffer(block, np.dtype("<" + row["type"]), count, start + row["at"])
        arrays[name] = values.reshape(row["shape"])
    return arrays, head["facts"]
