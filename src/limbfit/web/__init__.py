"""What the report and the studio show in a browser alike: arrays for scripts, shapes of limbs, scripts.

``static`` holds the scripts and style sheets, and below ``vendor`` the libraries they use (VENDOR.md).
Nothing here knows a study or a page.

What `pack` makes is read by a script without copying: 8 bytes ``LFARRAY1``; the length of the head, uint32;
the head, JSON padded with spaces so that what follows stands at a multiple of 8; the arrays, each at a
multiple of 8 from there on. All numbers are little-endian. The head has ``arrays``: name to ``type`` (``f4``,
``u4``, ``u2``, ``u1``, ``i4``), ``shape`` and ``at`` (bytes from the end of the head), and ``facts``: any
JSON. ``static/arrays.js`` reads it.
"""

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

STATIC = Path(__file__).parent / "static"
_MODULE_LINES = re.compile(r"^import .*;\n|^export (?=(?:const|function|class|async) )", re.MULTILINE)


def read_asset(name: str) -> str:
    """The text of a file of ``static``, for example ``vendor/uPlot.min.css``."""
    return (STATIC / name).read_text(encoding="utf-8")


def build_inline_script(*names: str) -> str:
    """Scripts one after the other as one classic script, which needs no server.

    Modules lose their one-line imports and the word ``export``: what they name must be in an earlier file.
    Whatever would end a ``<script>`` element is refused.
    """
    text = "\n".join(_MODULE_LINES.sub("", read_asset(name)) for name in names)
    if re.search(r"</script|<!--", text, re.IGNORECASE):
        raise ValueError("a script must not hold what ends a script element")
    return text


def compute_integrity(script: str) -> str:
    """The source of a script in a content security policy: only this very text may run."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


MAGIC = b"LFARRAY1"
_TYPES = {"f4", "u4", "u2", "u1", "i4"}
_STEP = 8


def pack(arrays: Mapping[str, NDArray[Any]], facts: Mapping[str, Any] | None = None) -> bytes:
    """The arrays and facts as one block; `ValueError` for other types, and for facts that are no JSON."""
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
