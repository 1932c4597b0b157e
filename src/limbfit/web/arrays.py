"""Named arrays as one block of bytes that a script reads without copying.

The block is: 8 bytes ``LFARRAY1``; the length of the head, uint32; the head, JSON padded with spaces so that
what follows stands at a multiple of 8; the arrays, each at a multiple of 8 from there on. All numbers are
little-endian. The head has ``arrays``: name to ``type`` (``f4``, ``u4``, ``u2``, ``u1``, ``i4``), ``shape``
and ``at`` (bytes from the end of the head), and ``facts``: any JSON. ``static/arrays.js`` reads it.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"LFARRAY1"
_TYPES = {"f4", "u4", "u2", "u1", "i4"}
_STEP = 8


def pack(arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any] | None = None) -> bytes:
    """The arrays and facts as one block; arrays must already have one of the types. Raises `ValueError` for
    an array of another type, or facts that are not finite JSON.
    """
    table, parts, at = {}, [], 0
    for name, values in arrays.items():
        kind = values.dtype.str[1:]
        if kind not in _TYPES:
            raise ValueError(f"array {name!r} has type {values.dtype}, not one of {sorted(_TYPES)}")
        data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
        table[name] = {"type": kind, "shape": list(values.shape), "at": at}
        parts.append(data + b"\0" * (-len(data) % _STEP))
        at += len(parts[-1])
    head = json.dumps({"arrays": table, "facts": dict(facts or {})}, allow_nan=False).encode()
    head += b" " * (-(len(MAGIC) + 4 + len(head)) % _STEP)
    return b"".join([MAGIC, len(head).to_bytes(4, "little"), head, *parts])
