"""Every key of the study file stands in docs/study.md, with its default, and nothing else does."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from limbfit.study import Study

# Keys that hold tables.
TABLES = (
    *("geometry.proximal_cut", "geometry.amputation", "geometry.layers", "geometry.regions"),
    *("socket.areas", "socket.trim_planes"),
)
DOCS = Path(__file__).parents[2] / "docs" / "study.md"


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    """The tables that a field holds, however deep its type hides them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in tables_in(part)]


def keys_of(table: type[BaseModel], prefix: str, default: Any) -> Iterator[tuple[str, Any]]:
    for name, field in table.model_fields.items():
        value = getattr(default, name) if isinstance(default, BaseModel) else field.default
        inside = tables_in(field.annotation)
        if field.exclude and not prefix:
            continue
        if inside:
            yield from keys_of(inside[0], f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value


KEYS = dict(keys_of(Study, "", None))
ROWS = {
    cells[0].strip("` "): cells[1].strip("` ")
    for cells in re.findall(
        r"^\| (`[a-z]+\.[^|]*`) \| ([^|]*) \| .*\|$", DOCS.read_text(encoding="utf-8"), re.MULTILINE
    )
}


def test_the_walk_finds_deep_and_shallow_keys() -> None:
    assert {"study.name", "sites.near", "mesh.coarse.growth", "geometry.amputation.normal"} <= set(KEYS)
    assert len(KEYS) > 50


@pytest.mark.parametrize("key", KEYS)
def test_every_key_is_documented(key: str) -> None:
    assert key in ROWS or any(row.startswith(f"{key}.") for row in ROWS)


@pytest.mark.parametrize("key", [row for row in ROWS if row not in TABLES])
def test_every_documented_key_exists(key: str) -> None:
    assert key in KEYS


@pytest.mark.parametrize(
    "key", [k for k, v in KEYS.items() if isinstance(v, int | float | str) and k in ROWS]
)
def test_documented_defaults_are_the_real_ones(key: str) -> None:
    stated = tomllib.loads(f"value = {ROWS[key]}")["value"]
    assert stated == KEYS[key]


@pytest.mark.parametrize(
    "key", [k for k, v in KEYS.items() if v is PydanticUndefined and not k.endswith("bones")]
)
def test_keys_without_default_are_called_required(key: str) -> None:
    assert ROWS[key] == "required"


@pytest.mark.parametrize(
    "example", re.findall(r"```toml\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)
)
def test_examples_are_valid_studies(example: str) -> None:
    assert Study(**tomllib.loads(example)).fitted
