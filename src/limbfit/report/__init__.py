"""Stored results to figures, tables and one self-contained HTML file; nothing here solves.

Graphics are loaded when a report is made, not when a study is run.
"""

from importlib import import_module
from typing import Any

_HOME = {"build_report": "build", "draw_cube": "sections.variants"}
__all__ = [*_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
