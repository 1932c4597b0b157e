"""The verbs of the experiments: each runs one, then prints its JSON, or tells of it in its own words."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import limbfit

from .console import STDOUT, listening, print_json

VERBS: list[Callable[..., None]] = []


def run_verb(
    study: Path, name: str, tell: Callable[[dict[str, Any]], None], *, as_json: bool, **options: Any
) -> None:
    """Do the experiment ``name`` with ``options``, tell of it, and say where it is stored."""
    with listening() as listener:
        found = limbfit.run_experiment(limbfit.load_study(study), name, listener=listener, **options)
    if as_json:
        print_json(found)
        return
    tell(found)
    STDOUT.print(f"stored in {found['folder']}; limbfit report shows it", soft_wrap=True)
