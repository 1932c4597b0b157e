"""Documented names that have become others: the old ones keep working, with a warning."""

import sys
import warnings
from collections.abc import Mapping
from typing import Any


def find_renamed(module: str, name: str, renamed: Mapping[str, str]) -> Any:
    """Return what a module's old ``name`` stands for; for the module's ``__getattr__``. Raises
    `AttributeError` where the module never had the name.
    """
    if name not in renamed:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    new = renamed[name]
    warnings.warn(f"{module}.{name} is now called {new}", FutureWarning, stacklevel=3)
    return getattr(sys.modules[module], new)
