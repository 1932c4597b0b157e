"""Stored results: their models against real files, older files, the page and schemas, and a notebook."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

import limbfit
from limbfit.errors import InputError
from limbfit.results.base import ResultPart
from limbfit.results.identification import PredictResult
from limbfit.results.limb import SitesResult
from limbfit.results.study_results import MODELS

ROOT = Path(__file__).parents[2]
STORED = Path(__file__).parent / "stored"  # of real runs, with the first entries of long lists
KEPT = [(name, model, file) for name, model in MODELS.items() for file in sorted(STORED.glob(model.FILE))]


def list_parts(model: type[ResultPart]) -> list[type[ResultPart]]:
    return [model, *(part for below in model.__subclasses__() for part in list_parts(below))]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    shutil.copytree(STORED, tmp_path / "patient" / "results")
    return tmp_path / "patient" / "results"


def edit(file: Path, change) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_every_result_is_among_the_kept_files():
    """But those that tests/pipeline writes: in commands/test_models.py, and in socket."""
    others = {"sensors", "socket_design", "models", "models_socket"}
    assert {name for name, _, _ in KEPT} == set(MODELS) - others


@pytest.mark.parametrize(("name", "model", "file"), KEPT, ids=[name for name, _, _ in KEPT])
def test_a_stored_file_comes_back_as_it_was(name, model, file):
    content = json.loads(file.read_text())
    found = model.read_file(file, "")
    assert found.to_plain() == content
    assert model.model_validate(found.to_plain()) == found


@pytest.mark.parametrize("part", list_parts(ResultPart)[1:], ids=lambda part: part.__name__)
def test_every_key_says_what_it_means(part):
    missing = [name for name, field in part.model_fields.items() if not field.description]
    assert not missing
    assert part.__doc__ != ResultPart.__doc__


def test_a_file_without_a_key_is_refused_in_one_line(results):
    file = results / "predict" / "predict.json"
    edit(file, lambda content: content["sites"][0].pop("error_percent"))
    with pytest.raises(InputError) as refused:
        PredictResult.read(results)
    assert str(refused.value) == (
        f"{file}: has no key 'sites.0.error_percent': another version of limbfit "
        "wrote it; run limbfit run again"
    )


def test_a_file_with_an_unknown_key_is_refused(results):
    edit(results / "sites" / "sites.json", lambda content: content.update(places=[]))
    with pytest.raises(InputError, match=r"unknown key 'places'.*run limbfit run again"):
        SitesResult.read(results)


def test_a_file_that_is_no_json_is_refused(results):
    (results / "sites" / "sites.json").write_text("{")
    with pytest.raises(InputError, match="not readable"):
        SitesResult.read(results)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "", None])
def test_what_is_no_number_is_not_stored(value):
    content = json.loads((STORED / "sites" / "sites.json").read_text())
    content["sites"][0]["off_skin_mm"] = value
    with pytest.raises(ValueError, match="off_skin_mm"):
        SitesResult.model_validate(content)


def test_arrays_are_stored_as_numbers():
    content = json.loads((STORED / "sites" / "sites.json").read_text())
    place = content["sites"][0]["position_mm"]
    content["sites"][0]["position_mm"] = np.array(place)
    assert SitesResult.model_validate(content).to_plain()["sites"][0]["position_mm"] == place


def test_the_page_of_results_is_what_the_models_say():
    """Made anew by  python docs/build_results.py > docs/results.md"""
    build_results_page = run_path(str(ROOT / "docs" / "build_results.py"))["build_results_page"]
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == build_results_page()


@pytest.mark.parametrize("name", MODELS)
def test_the_schema_has_every_key(name):
    schema = limbfit.build_schema(name)
    assert set(schema["properties"]) == set(MODELS[name].model_fields)
    assert schema["additionalProperties"] is (name == "stages")  # an extension's stamp has keys of its own


def test_the_schema_of_no_result():
    with pytest.raises(InputError, match="no result is named 'nothing'; use run, "):
        limbfit.build_schema("nothing")


def test_a_notebook_reads_results_by_name(results):
    found = limbfit.load_results(results.parent)
    assert "predict" in dir(found)
    assert found.predict is found.predict
    assert found.predict.sites[0].record == "01"
    assert found.stages["mesh"].stage == "mesh"
    assert "calibration" in repr(found)
    (results / "predict" / "01.csv").write_text("time_s,force_N\n0,1\n1,2\n")
    assert found.curves("predict", "01")["force_N"].tolist() == [1.0, 2.0]
    with pytest.raises(InputError, match="no such curves; there are: 01"):
        found.curves("predict", "99")


def test_a_result_that_is_not_there_names_its_command(results):
    (results / "cube" / "cube.json").unlink()
    with pytest.raises(InputError, match=r"cube\.json: not there yet; run limbfit cube first"):
        _ = limbfit.load_results(results.parent).cube


def test_results_are_those_beside_the_file_of_the_study(results):
    (results.parent / "study.toml").touch()
    assert limbfit.load_results(results.parent / "study.toml").folder == results


def test_results_of_a_study_that_was_not_run(tmp_path):
    with pytest.raises(InputError, match="nothing is stored there; run limbfit run first"):
        limbfit.load_results(tmp_path)


def test_results_load_without_images_and_pictures():
    code = (
        "import sys, limbfit; limbfit.load_results; "
        "print([m for m in ('pyvista', 'SimpleITK', 'scipy') if m in sys.modules])"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"
