"""Every key of a study changes what is computed."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from keyed_studies import (
    ACTS,
    ACTS_ON_SURFACES,
    GIVEN,
    IMAGED,
    READ,
    before,
    changed,
    decided,
    loaded,
    prepare,
)

import limbfit
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.keys import Keys


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("study"))


@pytest.mark.parametrize("key", ACTS)
def test_a_key_of_an_imaged_study_acts(folder: Path, key: str) -> None:
    stage, value = ACTS[key]
    content = changed(IMAGED, key, value)
    assert decided(loaded(folder, content))[stage] != before(folder, True)[stage]


@pytest.mark.parametrize("key", ACTS_ON_SURFACES)
def test_a_key_of_given_surfaces_acts(folder: Path, key: str) -> None:
    stage, value = ACTS_ON_SURFACES[key]
    assert decided(loaded(folder, changed(GIVEN, key, value)))[stage] != before(folder, False)[stage]


@pytest.mark.parametrize("key", READ)
def test_a_key_of_no_stage_is_read(key: str) -> None:
    place = Path(limbfit.__file__).parent / READ[key]
    files = sorted(place.rglob("*.py")) if place.is_dir() else [place]
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    read = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    read |= {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert key.rpartition(".")[2] in read


def test_the_design_of_a_socket_is_no_reason_to_put_it_on_again(folder: Path) -> None:
    def of(content: Mapping[str, Any]) -> list[str]:
        study = loaded(folder, content)
        stages = compute_keys(study)
        chosen = [EXPERIMENTS[name] for name in ("socket", "socket_design")]
        return [Keys(study).of(one, stages, one.options).digest for one in chosen]

    put_on, designed = of(GIVEN)
    other = of(changed(GIVEN, "socket.design.pressure_kPa", 12.0))
    assert other[0] == put_on
    assert other[1] != designed
    assert put_on not in of(changed(GIVEN, "socket.hold_s", 5.0))
