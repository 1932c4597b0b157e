"""The command line: exit codes, one-line errors, JSON, nothing half-written."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import pyvista as pv

from limbfit import __version__
from limbfit.cli import main

STUDY = """
[study]
name = "cylinder"
[surfaces]
skin = "skin.stl"
bones = { tibia = "tibia.stl" }
[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [40.0, 0.0, 60.0]
[[sites]]
name = "2"
trace = "2.csv"
position = [0.0, 40.0, 50.0]
"""


def cylinder(radius: float, bottom: float, top: float) -> pv.PolyData:
    """A closed cylinder along z with evenly sized triangles, outward."""
    solid = pv.CylinderStructured(radius=np.linspace(0.05, radius, 8), height=top - bottom,
                                  direction=(0, 0, 1), center=(0, 0, (top + bottom) / 2),
                                  theta_resolution=40, z_resolution=20)  # fmt: skip
    surface = solid.extract_surface(algorithm=None).triangulate().clean().fill_holes(1.0)
    return surface.compute_normals(auto_orient_normals=True, consistent_normals=True)


def write_trace(path, *, depth=5.0, peak=6.0, touch=0.4, rate=100.0, header="time_s,displacement_mm,force_N"):
    random = np.random.default_rng(1)
    speed, span = 0.96, (depth + touch) / 0.96
    time = np.arange(0.0, 2 * span, 1 / rate)
    displacement = speed * (span - np.abs(time - span))
    force = peak * np.clip((displacement - touch) / depth, 0, None) ** 1.3
    force += random.normal(0, 0.03, time.size)
    np.savetxt(path, np.column_stack([time, displacement, force]), delimiter=",", header=header, comments="")
    return np.column_stack([time, displacement, force])


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pristine")
    cylinder(40.0, 0.0, 120.0).save(folder / "skin.stl")
    cylinder(12.0, 25.0, 126.0).save(folder / "tibia.stl")
    for name in ("1", "2"):
        write_trace(folder / f"{name}.csv")
    (folder / "study.toml").write_text(STUDY)
    return folder


@pytest.fixture
def study(pristine, tmp_path):
    return shutil.copytree(pristine, tmp_path / "study")


@pytest.fixture
def limbfit(monkeypatch, capsys):
    """Run a command; returns (exit code, standard output, standard error)."""

    def call(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["limbfit", *map(str, words)])
        try:
            main()
            code = 0
        except SystemExit as end:
            code = int(end.code or 0)
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return call


def edit(study, old: str, new: str) -> None:
    file = study / "study.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def refused(call, study, *fragments: str) -> None:
    """Exit code 2, one error line with all fragments, no traceback, no results."""
    for verb in ("check", "run"):
        code, out, err = call(verb, study)
        errors = [line for line in err.splitlines() if not line.startswith("[")]
        assert code == 2, err
        assert len(errors) == 1
        assert errors[0].startswith("error: ")
        for fragment in fragments:
            assert fragment in errors[0]
        assert "Traceback" not in err
        assert out == ""
    leftovers = [p for p in study.rglob("*") if p.is_file() and "results" in p.parts]
    assert [p.name for p in leftovers if p.suffix not in {".lock", ".seconds", ""}] == [] or all(
        (p.parent / "stage.json").is_file() for p in leftovers if p.suffix not in {".lock", ".seconds", ""}
    )


def test_version(limbfit):
    assert limbfit("--version") == (0, f"limbfit {__version__}\n", "")


def test_check_tells_the_facts(limbfit, study):
    code, out, _ = limbfit("check", study)
    assert code == 0
    assert "site 1: peak force 6.0" in out
    assert "tibia" in out
    assert "1 of 2 sites are fitted" in out
    assert not (study / "results").exists()


def test_check_as_json(limbfit, study):
    code, out, _ = limbfit("check", study, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["sites"]["1"]["touch_down_mm"] == pytest.approx(0.4, abs=0.15)


def test_status_of_a_fresh_study(limbfit, study):
    code, out, _ = limbfit("status", study, "--json")
    states = {row["stage"]: row["state"] for row in json.loads(out)["stages"]}
    assert code == 0
    assert set(states.values()) == {"missing"}
    assert "segment" not in states  # surfaces were given


def test_run_until_sites_is_not_repeated(limbfit, study):
    code, out, _ = limbfit("run", study, "--until", "sites", "--json")
    assert code == 0
    assert json.loads(out)["until"] == "sites"
    before = (study / "results/sites/stage.json").stat().st_mtime_ns
    code, _, err = limbfit("run", study, "--until", "sites")
    assert code == 0
    assert "up to date" in err
    assert (study / "results/sites/stage.json").stat().st_mtime_ns == before
    edit(study, "position = [0.0, 40.0, 50.0]", "position = [0.0, 40.0, 55.0]")
    states = {r["stage"]: r["state"] for r in json.loads(limbfit("status", study, "--json")[1])["stages"]}
    assert states["surfaces"] == "done"
    assert states["sites"] == "stale"


def test_sites_lie_on_the_skin_with_inward_axes(limbfit, study):
    assert limbfit("run", study, "--until", "sites")[0] == 0
    first, second = json.loads((study / "results/sites/sites.json").read_text())["sites"]
    np.testing.assert_allclose(first["axis"], [-1, 0, 0], atol=0.03)
    np.testing.assert_allclose(second["axis"], [0, -1, 0], atol=0.03)


@pytest.mark.parametrize("name", ["skin.stl", "tibia.stl", "1.csv"])
def test_missing_files(limbfit, study, name):
    (study / name).unlink()
    refused(limbfit, study, "study.toml", name, "does not exist")


def test_no_study(limbfit, tmp_path):
    code, _, err = limbfit("run", tmp_path / "nowhere")
    assert code == 2
    assert "no such study" in err


def test_unknown_key(limbfit, study):
    edit(study, '[study]\nname = "cylinder"', '[study]\nname = "cylinder"\nnmae = 1')
    refused(limbfit, study, "study.toml", "study.nmae", "unknown key")


def test_open_surface(limbfit, study):
    surface = pv.read(study / "skin.stl")
    surface.extract_cells(range(20, surface.n_cells)).extract_surface(algorithm=None).save(study / "skin.stl")
    refused(limbfit, study, "skin.stl", "open")


def test_inverted_surface(limbfit, study):
    pv.read(study / "tibia.stl").flip_faces().save(study / "tibia.stl")
    refused(limbfit, study, "tibia.stl", "inward")


def test_bone_outside_the_skin(limbfit, study):
    pv.read(study / "tibia.stl").translate((35.0, 0, 0)).save(study / "tibia.stl")
    refused(limbfit, study, "tibia", "outside")


def test_site_off_the_skin(limbfit, study):
    edit(study, "position = [40.0, 0.0, 60.0]", "position = [48.0, 0.0, 60.0]")
    refused(limbfit, study, "study.toml", "sites.1", "off the skin")


def rewrite(study, change) -> None:
    table = write_trace(study / "1.csv")
    header = change(table) or "time_s,displacement_mm,force_N"
    np.savetxt(study / "1.csv", table, delimiter=",", header=header, comments="")


def spoil_nan(table):
    table[100, 2] = np.nan


def spoil_time(table):
    table[100, 0] = table[90, 0]


def spoil_columns(table):
    return "t,x,F"


def spoil_contact(table):
    table[:, 2] = 0.0


def spoil_unit(table):
    table[:, 1] /= 1000.0


@pytest.mark.parametrize(
    ("change", "fragment"),
    [
        (spoil_nan, "force_N"),
        (spoil_time, "time"),
        (spoil_columns, "time_s"),
        (spoil_contact, "contact"),
        (spoil_unit, "mm"),
    ],
)
def test_bad_traces(limbfit, study, change, fragment):
    rewrite(study, change)
    refused(limbfit, study, "1.csv", fragment)


def test_bad_usage(limbfit, study):
    for words in (("run",), ("run", study, "--until", "nonsense"), ("nonsense",)):
        code, out, err = limbfit(*words)
        assert code == 2
        assert out == ""
        assert "Traceback" not in err
    code, _, err = limbfit("simulate", study, "--site", "1", "--parameters", "1,2")
    assert code == 2
    assert "eight numbers" in err
    code, _, err = limbfit("simulate", study, "--site", "99")
    assert code == 2
    assert "no site is named '99'" in err
