"""The stored results with their keys as a page of Markdown (docs/results.md)."""

import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Union, get_args, get_origin

from limbfit.results.base import ResultPart
from limbfit.results.study_results import ALL_MODELS

HEAD = """# Results

Made by `python docs/build_results.py`. Every result of a study is a JSON file below `results`.
In Python it is an attribute of [`load_results(study)`](python.md#stored-results) with the same keys, and
`limbfit schema RESULT` prints its JSON schema. Numbers are in the unit of their row. Curves and tables
are CSV files beside these.
"""
_UNITS = ("mm", "mm2", "mm3", "cm3", "N", "Nmm", "kPa", "s", "m_s", "mm_s", "deg", "percent", "GB")
_UNIT_WORDS = {"mm2": "mm²", "mm3": "mm³", "cm3": "cm³", "Nmm": "N mm", "m_s": "m/s", "mm_s": "mm/s"}
_WORDS: Mapping[Any, str] = {
    str: "text",
    float: "number",
    int: "integer",
    bool: "true or false",
    Any: "anything",
    type(None): "null",
}


def build_results_page() -> str:
    """All results with their keys, as Markdown."""
    parts, described = [HEAD], set[type[ResultPart]]()
    for name, model in ALL_MODELS.items():
        parts.append(f"## {name}\n")
        parts.append(f"`{model.FILE.replace('*', '<name>')}`, by `{model.COMMAND}`. {_describe(model)}\n")
        for part in _list_parts(model):
            if part not in described:
                described.add(part)
                parts += [] if part is model else [f"### {part.__name__}\n", f"{_describe(part)}\n"]
                parts.append(_format_table(part))
    return "\n".join(parts)


def _describe(model: type[ResultPart]) -> str:
    return " ".join((model.__doc__ or "").split())


def _list_parts(model: type[ResultPart]) -> Iterator[type[ResultPart]]:
    """The model, then those inside it, each once."""
    found, waiting = list[type[ResultPart]](), [model]
    while waiting:
        here = waiting.pop(0)
        if here not in found:
            found.append(here)
            for field in here.model_fields.values():
                waiting += _find_models(field.annotation)
    yield from found


def _find_models(annotation: Any) -> Iterator[type[ResultPart]]:
    if isinstance(annotation, type) and issubclass(annotation, ResultPart):
        yield annotation
    for part in get_args(annotation):
        yield from _find_models(part)


def _format_table(model: type[ResultPart]) -> str:
    rows = ["| key | value | unit | meaning |", "|---|---|---|---|"]
    for name, field in model.model_fields.items():
        # The unit ends a key, or stands before ``_by_site``.
        plain = name.removesuffix("_by_site")
        unit = max((unit for unit in _UNITS if plain.endswith(f"_{unit}")), key=len, default="")
        unit = _UNIT_WORDS.get(unit, unit.replace("percent", "%"))
        absent = "" if field.is_required() else " Absent where it does not apply."
        meaning = f"{field.description or ''}{absent}"
        rows.append(f"| `{name}` | {_format_type(field.annotation)} | {unit} | {meaning} |")
    return "\n".join([*rows, ""])


def _format_type(annotation: Any) -> str:
    """The type of a key in words."""
    if isinstance(annotation, type) and issubclass(annotation, ResultPart):
        return f"[{annotation.__name__}](#{annotation.__name__.lower()})"
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin in (dict, Mapping):
        return f"table of {_format_type(parts[1])}"
    if origin is Sequence:
        return f"list of {_format_type(parts[0])}"
    if origin is tuple:
        return f"{len(parts)} of {_format_type(parts[0])}"
    if origin in (Union, types.UnionType):
        return " or ".join(_format_type(part) for part in parts)
    return _WORDS[annotation]


if __name__ == "__main__":
    sys.stdout.write(build_results_page())
