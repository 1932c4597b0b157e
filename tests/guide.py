"""The Python files that docs/extending.md shows."""

from __future__ import annotations

import re
from pathlib import Path

GUIDE = Path(__file__).parents[1] / "docs" / "extending.md"


def from_the_guide(word: str, file: Path) -> Path:
    """``file``, written with the one block of Python that holds ``word``."""
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if word in block]
    file.write_text(code, encoding="utf-8")
    return file
