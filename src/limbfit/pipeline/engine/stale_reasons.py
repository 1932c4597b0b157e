"""Why a stage is stale: what its key was made of then, beside what it would be made of now.

Only digests are kept, so that no setting or file name leaves a trace in the results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..._version import __version__
from ...results.runs import StageParts
from ...study import Study
from .digests import code_parts, compute_digest
from .keys import Keys, Stage, select_records_read
from .provenance import list_input_files

_FEW = 4  # causes of one kind that are named


def collect_parts(stage: Stage, known: Keys, study: Study, keys: Mapping[str, str]) -> StageParts:
    """Digests of the settings, inputs, files of code and keys of lower stages that make up a stage's key."""
    stated = study.model_dump(mode="json")
    settings = dict(_iterate_leaves(stage.read(stated), ""))
    for site in stated["sites"]:
        settings |= dict(
            _iterate_leaves({key: site[key] for key in stage.site_keys}, f"sites.{site['name']}.")
        )
    for row, read in zip(stated["records"], select_records_read(stage, stated)):
        settings |= dict(_iterate_leaves(read, f"records.{row['site']}-{row['name']}."))
    names = {path: key for key, path in study.inputs.items()}
    files = list_input_files(study).get(stage.name, [])
    return StageParts(
        settings={name: compute_digest(value) for name, value in settings.items()},
        inputs={names.get(path, "labels corrected by hand"): known.digests[path][:16] for path in files},
        code=code_parts(stage.run) | {"limbfit": __version__},
        stages={below: keys[below] for below in stage.needs if below in keys},
    )


def _iterate_leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _iterate_leaves(part, f"{name}{key}.")
    else:
        yield name.removesuffix("."), value


def describe_causes(before: StageParts | None, now: StageParts) -> list[str]:
    """What differs, in words; what is above a lower stage's change comes last."""
    if before is None:
        return ["made by an older version, which did not store what its key depends on"]
    found = []
    words = {
        "settings": "setting {} changed",
        "inputs": "input file {} changed",
        "stages": "stage {} changed",
    }
    for kind, text in words.items():
        names = _find_different(getattr(before, kind), getattr(now, kind))
        found += [text.format(_list_few(names))] if names else []
    code, then = _find_different(before.code, now.code), before.code.get("limbfit")
    if then != __version__:
        found.append(f"limbfit was {then}, is {__version__}")
    elif code:
        found.append(f"code of {_list_few(code)} changed")
    return found or ["its options changed"]


def _list_few(names: list[str]) -> str:
    return ", ".join(names[:_FEW]) + (f" and {len(names) - _FEW} more" if len(names) > _FEW else "")


def _find_different(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    return [name for name in {**before, **now} if before.get(name) != now.get(name)]
