"""Every key of a study changes what is computed."""

import ast
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from keyed_studies import (
    ACTS,
    ACTS_ON_SURFACES,
    GIVEN,
    IMAGED,
    READ,
    START,
    before,
    changed,
    decide,
    decide_before,
    decided,
    loaded,
    prepare,
)

import limbfit
from editing import list_stale
from limbfit.pipeline.commands.experiments import EXPERIMENTS
from limbfit.pipeline.commands.run import compute_keys
from limbfit.pipeline.engine.provenance import Keys

SURFACE_FILE = {"shape": "stl", "file": "1.stl"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare(tmp_path_factory.mktemp("study"))


@pytest.mark.parametrize(
    ("imaged", "key"), [(True, key) for key in ACTS] + [(False, key) for key in ACTS_ON_SURFACES]
)
def test_a_key_of_an_imaged_study_or_of_given_surfaces_acts(folder: Path, imaged: bool, key: str) -> None:
    stage, value = (ACTS if imaged else ACTS_ON_SURFACES)[key]
    was = decide_before(folder, imaged, stage)
    assert decide(loaded(folder, changed(IMAGED if imaged else GIVEN, key, value)), stage) != was


@cache
def list_read(place: Path) -> set[str]:
    """Attributes and words of a file, or of all files of a folder."""
    files = sorted(place.rglob("*.py")) if place.is_dir() else [place]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))]
    read = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    return read | {n.value for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str)}


@pytest.mark.parametrize("key", READ)
def test_a_key_of_no_stage_is_read(key: str) -> None:
    assert key.rpartition(".")[2] in list_read(Path(limbfit.__file__).parent / READ[key])


def stale_in(folder: Path, content: Mapping[str, Any], other: Mapping[str, Any]) -> set[str]:
    return list_stale(loaded(folder, content), loaded(folder, other))


@pytest.mark.parametrize(("key", "value"), [("sites.1.region", "calf"), ("sites.1.fitted", True)])
def test_what_a_site_is_called_or_used_for_is_no_reason_to_mesh_again(
    folder: Path, key: str, value: Any
) -> None:
    stale = stale_in(folder, IMAGED, changed(IMAGED, key, value))
    assert {"sites", "predict", "report"} <= stale
    assert "mesh" not in stale
    assert "mesh" in stale_in(folder, IMAGED, changed(IMAGED, "sites.1.edge", [0.0, 1.0, 1.0]))


def test_meshes_that_are_made_are_kept_when_the_mesher_is_given_more_time(folder: Path) -> None:
    """The remedy that is named where one mesh of many takes too long."""
    assert stale_in(folder, GIVEN, changed(GIVEN, "mesh.time_limit_s", 1200.0)) == {
        *("calibrate", "predict", "report")  # which does without a coarser mesh that takes too long
    }


def test_the_order_of_keys_makes_nothing_stale_and_that_of_sites_what_lists_them(folder: Path) -> None:
    tables: dict[str, Any] = {
        "indenters": {"ball": {}, "big": {"width_mm": 30.0}},
        "material": {"tissues": {"skin": {"start": START}, "muscle": {"start": START}}},
        "calibration": {
            "prior": {f"{one}.c_kPa": {"median": 5.0, "factor": 2.0} for one in ("skin", "muscle")}
        },
    }
    turned = {
        key: {name: dict(reversed(part.items())) for name, part in table.items()}
        for key, table in tables.items()
    }
    turned["indenters"] = dict(reversed(tables["indenters"].items()))
    stated, other = ({**IMAGED, **each} for each in (tables, turned))
    assert stale_in(folder, stated, other) == set()
    assert "sites" in stale_in(folder, stated, {**stated, "sites": stated["sites"][::-1]})


def test_an_indenter_that_no_fitted_record_names_is_no_reason_to_identify_again(folder: Path) -> None:
    def differ(content: Mapping[str, Any], key: str, value: Any) -> set[str]:
        found = decided(loaded(folder, content)), decided(loaded(folder, changed(content, key, value)))
        return {name for name, digest in found[0].items() if digest != found[1][name]}

    (folder / "1.stl").write_text("one")
    planned = changed(GIVEN, "indenters.big", {"width_mm": 30.0})
    assert differ(GIVEN, "indenters.big", {"width_mm": 30.0}) == set()
    assert "calibrate" not in differ(planned, "sites.1.indenter", "big")
    assert "predict" in differ(planned, "sites.1.indenter", "big")
    pressed = changed(changed(planned, "sites.1.indenter", "big"), "indenters.big", SURFACE_FILE)
    study = loaded(folder, pressed)
    was = decided(study)
    (folder / "1.stl").write_text("another")
    assert {"predict", "design", "uncertainty"} <= {name for name in was if was[name] != decided(study)[name]}
    assert was["calibrate"] == decided(study)["calibrate"]
    studies = [loaded(folder, content) for content in (GIVEN, planned)]
    protocol = EXPERIMENTS["protocol"]
    keys = [Keys(one).compute_key(protocol, compute_keys(one), protocol.options).digest for one in studies]
    assert keys[0] != keys[1]


def test_a_design_is_stale_where_the_study_fixes_something_else(folder: Path) -> None:
    other = decided(loaded(folder, changed(GIVEN, "calibration.fixed", ["muscle.gamma"])))
    assert other["design"] != before(folder, False)["design"]


def test_what_a_system_leaves_in_a_folder_of_images_makes_nothing_stale(folder: Path) -> None:
    was = before(folder, True)
    left = [folder / "mri" / name for name in (".DS_Store", "._image", "Thumbs.db")]
    for file in left:
        file.write_text("seen")
    study = loaded(folder, IMAGED)
    now = decided(study)
    for file in left:
        file.unlink()
    assert now == was


def test_the_design_of_a_socket_is_no_reason_to_put_it_on_again(folder: Path) -> None:
    def of(content: Mapping[str, Any]) -> list[str]:
        study = loaded(folder, content)
        stages = compute_keys(study)
        chosen = [EXPERIMENTS[name] for name in ("socket", "socket_design")]
        return [Keys(study).compute_key(one, stages, one.options).digest for one in chosen]

    put_on, designed = of(GIVEN)
    other = of(changed(GIVEN, "socket.design.pressure_kPa", 12.0))
    assert other[0] == put_on
    assert other[1] != designed
    assert put_on not in of(changed(GIVEN, "socket.hold_s", 5.0))
