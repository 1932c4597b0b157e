"""limbfit: patient-specific viscoelastic finite-element models of residual limbs.

Everything the command line does is one call away: docs/python.md lists the call of every command.

Names are loaded when first used, so that a worker process that only solves does not load images and graphics.
`__init__.pyi` says where they live.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from ._version import __version__

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOME = {
    name.name: node.module
    for node in _STUB.body
    if isinstance(node, ast.ImportFrom) and node.module != "_version"
    for name in node.names
}
__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'limbfit' has no attribute {name!r}")
    return getattr(import_module(f"limbfit.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
