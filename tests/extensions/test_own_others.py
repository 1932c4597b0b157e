"""An image format and an experiment registered from outside the package, as the guide shows them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from conftest import write_trace
from editing import append, edit
from guide import from_the_guide
from limbfit import load_study, run_experiment
from limbfit.anatomy.images.formats import register_image_format
from limbfit.anatomy.imaging import Volume, read_labels, read_volume, write_volume
from limbfit.errors import ImageError, InputError
from limbfit.extensions import load_extensions
from limbfit.pipeline.commands.experiments import EXPERIMENTS, Experiment, register_experiment
from limbfit.pipeline.commands.run import compute_keys, study_status

GEOMETRY = {"spacing_mm": np.array([1.0, 1.5, 2.0]), "origin_mm": np.array([3.0, -4.0, 50.0])}


@pytest.fixture(scope="module", autouse=True)
def extensions(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("extensions")
    load_extensions([from_the_guide("read_npz", folder / "npz.py")])
    load_extensions([from_the_guide("stiffness.json", folder / "stiffness.py")])
    load_extensions([from_the_guide("Tapered(", folder / "tapered.py")])
    return folder


def test_an_image_of_its_format_is_read_with_its_geometry(tmp_path):
    voxels = np.random.default_rng(0).uniform(0.0, 100.0, (40, 8, 9)).astype(np.float32)
    np.savez(tmp_path / "limb.npz", voxels=voxels, **GEOMETRY)
    found = read_volume(tmp_path / "limb.npz")
    np.testing.assert_array_equal(found.array, voxels)
    np.testing.assert_array_equal(found.spacing, GEOMETRY["spacing_mm"])
    np.testing.assert_allclose(found.index_to_point([1, 1, 1]), [4.0, -2.5, 52.0])
    np.savez(tmp_path / "labels.npz", voxels=(voxels > 50).astype(np.uint8), **GEOMETRY)
    assert (read_labels(tmp_path / "labels.npz", found).array == (voxels > 50)).all()


def test_what_its_reader_raises_names_the_file(tmp_path):
    (tmp_path / "limb.npz").write_bytes(b"no archive")
    with pytest.raises(ImageError, match=r"limb\.npz: not readable as numpy: \w+: .*; check that the file"):
        read_volume(tmp_path / "limb.npz")
    (tmp_path / "limb.txt").touch()
    with pytest.raises(ImageError, match=r"unknown kind of image '\.txt'; use one of \.nii .*\.npz"):
        read_volume(tmp_path / "limb.txt")
    with pytest.raises(ImageError, match=r"unknown kind of image '\.npz'"):  # it can be read only
        write_volume(tmp_path / "made.npz", Volume(np.zeros((2, 2, 2)), np.ones(3), np.zeros(3), np.eye(3)))


def test_a_suffix_belongs_to_one_format():
    with pytest.raises(InputError, match=r"images \.nii are NIfTI already"):
        register_image_format("mine", (".nii",), lambda path: None)
    with pytest.raises(InputError, match="image format 'NRRD' exists already"):
        register_image_format("NRRD", (".mine",), lambda path: None)


@pytest.mark.parametrize("suffixes", [".mine", ("mine",), (".MINE",)])
def test_what_no_file_can_end_with_is_no_suffix(suffixes):
    with pytest.raises(InputError, match=r'are no suffixes; give such as \("\.npz",\)'):
        register_image_format("mine", suffixes, lambda path: None)


def test_an_experiment_that_is_in_no_file_is_refused():
    """As that of a cell of a notebook: its results could not be told from those of another cell."""
    cell: dict = {}
    exec(compile("def run(context, folder): pass", "<cell 1>", "exec"), cell)
    with pytest.raises(InputError, match="in_a_cell: its run is defined in no file"):
        register_experiment(Experiment("in_a_cell", cell["run"]))


@pytest.mark.parametrize("few", [np.array([1.0, 2.0]), range(1, 3), (1, 2)])
def test_options_may_be_numbers_and_arrays_of_numpy(few, study, monkeypatch):
    monkeypatch.setattr(EXPERIMENTS, "_added", {})

    def run(context, folder, *, depth_mm=0.0, few=()):
        (folder / "own.json").write_text(json.dumps({"given": [depth_mm, few]}))

    register_experiment(Experiment("own", run))
    found = run_experiment(load_study(study), "own", depth_mm=np.float32(3.0), few=few)
    assert found["given"] == [3.0, [1, 2]]
    states = {row["stage"]: row["state"] for row in study_status(load_study(study))}
    assert states["own"] == "done"


def named(study: Path, extensions: Path) -> Path:
    """The study with the experiment, and an indenter of its own."""
    for name in ("1.csv", "2.csv"):
        write_trace(study / name, rate=20.0)
    for name in ("stiffness.py", "tapered.py"):
        shutil.copy(extensions / name, study / name)
    edit(study, "[study]\n", '[study]\nextensions = ["stiffness.py", "tapered.py"]\n')
    append(study, '[indenter]\nshape = "tapered"\n')
    return study


def test_an_experiment_is_run_by_its_verb_kept_and_reported(study, extensions, limbfit):
    study = named(study, extensions)
    code, out, err = limbfit("experiment", study, "stiffness", "--json")
    assert code == 0, err
    records = json.loads((study / "results" / "traces" / "traces.json").read_text())["sites"]
    wanted = {name: one["peak_force_N"] / one["depth_mm"] for name, one in records.items()}
    assert json.loads(out)["N_per_mm"] == pytest.approx(wanted)
    states = {row["stage"]: row["state"] for row in study_status(load_study(study))}
    assert states["stiffness"] == "done"
    deep = max(one["depth_mm"] for one in records.values())
    code, out, err = limbfit("experiment", study, "stiffness", "--option", f"depth_mm={deep}", "--json")
    assert code == 0, err
    assert json.loads(out)["N_per_mm"] == {}
    before = compute_keys(load_study(study))
    assert limbfit("experiment", study, "stiffness", "--option", "colour=red")[0] == 2
    assert limbfit("experiment", study, "stiffness", "--option", "depth_mm")[0] == 2
    assert compute_keys(load_study(study)) == before
    shutil.rmtree(study / "results" / "surfaces")  # and with it what the report would draw
    code, _, err = limbfit("report", study)
    assert code == 0, err
    page = (study / "results" / "report" / "report.html").read_text()
    assert "Stiffness of the records" in page
    assert "tapered indenter of 20.0 mm (edge radius 0.0 mm, taper in degrees 15.0)" in page


def test_names_that_would_hide_results_are_refused(study, monkeypatch):
    monkeypatch.setattr(EXPERIMENTS, "_added", {})  # the last one must not stay

    def run(context, folder):
        raise AssertionError("it must not run")

    for name in ("sensitivity", "a-b", "regions", ""):
        with pytest.raises(InputError, match=r"can be named|exists already"):
            register_experiment(Experiment(name, run))
    for name in ("mesh", "log"):
        register_experiment(Experiment(name, run))
        with pytest.raises(InputError, match=f"results/{name} is not for an experiment"):
            run_experiment(load_study(study), name, listener=print)
