"""Stored results of which a test states what it is about."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from limbfit.results.base import ResultPart, StoredResult


def complete(model: type[ResultPart], content: Any) -> Any:
    """The content with every key that its model requires: null, nothing or zero where it has none."""
    if isinstance(content, dict):
        for key, field in model.model_fields.items():
            if key in content:
                content[key] = _complete_value(field.annotation, content[key])
            elif field.is_required():
                content[key] = _make_empty(field.annotation)
    return content


def write_result(results: Path, model: type[StoredResult], content: Any, name: str = "") -> None:
    """Write the content, completed, into the model's file below the results; ``name`` is the star's."""
    file = results / model.FILE.replace("*", name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(complete(model, content)))


def _complete_value(kind: Any, value: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, ResultPart):
        return complete(kind, value)
    parts = get_args(kind)
    if get_origin(kind) is Mapping:
        return {key: _complete_value(parts[1], one) for key, one in value.items()}
    if get_origin(kind) is Sequence:
        return [_complete_value(parts[0], one) for one in value]
    models = [part for part in parts if isinstance(part, type) and issubclass(part, ResultPart)]
    return complete(models[0], value) if models else value


def _make_empty(kind: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, ResultPart):
        return complete(kind, {})
    if type(None) in get_args(kind):
        return None
    if get_origin(kind) in (UnionType, Union):
        return _make_empty(get_args(kind)[0])
    if get_origin(kind) is tuple:
        return [_make_empty(part) for part in get_args(kind)]
    return {Mapping: {}, dict: {}, Sequence: [], str: "", bool: False, int: 0, float: 0.0}[
        get_origin(kind) or kind
    ]
