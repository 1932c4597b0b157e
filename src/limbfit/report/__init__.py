"""Stored results to figures, tables and one self-contained HTML file; nothing here solves.

Graphics are loaded when a report is made, not when a study is run.
"""

from importlib import import_module
from typing import Any

__all__ = ["build_report"]


def __getattr__(name: str) -> Any:
    if name != "build_report":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.build").build_report
