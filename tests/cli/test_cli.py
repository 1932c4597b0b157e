"""The command line: exit codes, one-line errors, JSON, nothing half-written."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest
import pyvista as pv
import typer

from limbfit import __version__
from limbfit.cli.app import GROUPS, app
from limbfit.cli.commands import show_summary
from limbfit.cli.console import print_line, print_table

HEADER = "time_s,displacement_mm,force_N"


def edit(study, old: str, new: str) -> None:
    file = study / "study.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def check_refused(call, study, *fragments: str) -> None:
    """Exit code 2, one error line with all fragments, no traceback, no results but the log of the try."""
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
    results = study / "results"
    leftovers = [p for p in results.rglob("*") if p.is_file() and p.parent != results / "log"]
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
    assert out.endswith("the study can be run\n")
    assert not (study / "results").exists()


def test_check_does_not_say_that_a_study_without_a_fitted_site_can_be_run(limbfit, study):
    edit(study, "fitted = true\n", "")
    code, out, _ = limbfit("check", study)
    assert code == 0
    assert "cannot run: limbfit run" in out
    assert out.endswith("the study cannot be run to its end\n")


def test_help_lists_every_verb_once_with_its_whole_sentence(limbfit):
    code, told, _ = limbfit("--help")
    assert code == 0
    listed = [name for names in GROUPS.values() for name in names]
    assert sorted(listed) == sorted(typer.main.get_command(app).commands)
    assert "..." not in told.replace("[ARGS]...", "")
    assert all(f"{group}:" in told for group in GROUPS)


@pytest.mark.parametrize(
    ("typed", "word", "offered"), [("limbfit unc", 1, ["uncertainty"]), ("limbfit run --un", 2, ["--until"])]
)
def test_the_shell_completes_verbs_and_options(typed, word, offered):
    script = "import sys; sys.argv[0] = 'limbfit'; from limbfit.cli import main; main()"
    asked = {"_LIMBFIT_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(word)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | asked, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == offered


def test_check_as_json(limbfit, commands_unasked, study):
    code, out, _ = limbfit("check", study, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["sites"]["1"]["touch_down_mm"] == pytest.approx(0.4, abs=0.15)


PLANNED = """
[[sites]]
name = "3"
position = [40.0, 0.0, 55.0]
depth_mm = 12.0
speed_mm_s = 24.0
[socket]
[[socket.loads]]
name = "an hour"
force_N = [0.0, 0.0, 100.0]
hold_s = 3600.0
"""


def test_check_says_what_goes_beyond_the_fitted_records(limbfit, commands_unasked, study):
    """A site a quarter around the limb, one that is planned deep and fast, and a load of an hour."""
    file = study / "study.toml"
    file.write_text(file.read_text() + PLANNED)
    code, out, _ = limbfit("check", study, "--json")
    found = json.loads(out)
    assert code == 0
    rows = {name: {row["quantity"]: row for row in own} for name, own in found["outside_records"].items()}
    assert set(rows["site 2"]) == {"angle to the nearest fitted site"}
    assert rows["site 2"]["angle to the nearest fitted site"]["prediction"][1] == pytest.approx(90.0, abs=3.0)
    assert set(rows["site 3"]) == {"time", "depth over thickness"}
    fast, deep = rows["site 3"]["time"], rows["site 3"]["depth over thickness"]
    assert fast["prediction"] == [0.5, 1.0]
    assert fast["records"] == pytest.approx([5.0 / 0.96, 10.0 / 0.96], rel=0.03)
    assert deep["prediction"][1] / deep["records"][1] == pytest.approx(12.0 / 5.0, rel=0.1)
    assert rows["the load 'an hour'"]["time"]["prediction"] == [1.0, 2.0 + 10.0 + 1.0 + 3600.0]
    times, others = found["outside_text"]
    assert "the load 'an hour' comes on in 1 s (the records' shortest ramp takes 5.2" in times
    assert "lasts 3610 s" in times
    assert others.startswith("site 3 goes beyond the records: depth over thickness")
    _, _, told = limbfit("check", study)
    assert f"warning: {times}\nwarning: {others}" in told


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
    for site, (x, y, z) in ((first, (1, 0, 60)), (second, (0, 1, 50))):
        radius = 42.0 * np.sqrt(1 - ((z - 120) / 150) ** 2)
        outward = np.array([x * radius / 42.0**2, y * radius / 42.0**2, (z - 120) / 150**2])
        np.testing.assert_allclose(site["axis"], -outward / np.linalg.norm(outward), atol=0.03)
        assert np.hypot(*site["position_mm"][:2]) == pytest.approx(radius, abs=0.5)


def picture_size(file: str) -> tuple[int, int]:
    pixels = matplotlib.image.imread(file)
    assert pixels[..., :3].std() > 0.05  # something is drawn
    return pixels.shape[1], pixels.shape[0]


def test_surfaces_are_shown(limbfit, study):
    """Volumes of the spheroids, and the thinnest tissue between them, with a picture."""
    code, out, _ = limbfit("surfaces", study, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["closed_bodies"] == 2
    volume = 2 / 3 * np.pi * np.array([42.0**2 * 150.0, 13.0**2 * 125.0]) / 1000
    assert list(found["volumes_cm3"].values()) == pytest.approx(volume.tolist(), rel=0.02)
    angle = np.linspace(0, np.pi / 2, 400)
    skin = np.column_stack([42.0 * np.cos(angle), 120 - 150 * np.sin(angle)])
    bone = np.column_stack([13.0 * np.cos(angle), 126 - 125 * np.sin(angle)])
    least = np.linalg.norm(skin[:, None] - bone, axis=-1).min()
    assert found["thinnest_mm"]["tibia"]["tissue_mm"] == pytest.approx(least, abs=0.3)
    assert min(picture_size(found["picture"])) > 400


def test_sites_are_shown(limbfit, study):
    code, out, _ = limbfit("sites", study)
    assert code == 0
    assert min(picture_size(study / "results" / "sites" / "sites.png")) > 400
    assert "sites.png" in out
    assert not (study / "results/traces").exists()


@pytest.mark.slow
def test_meshes_are_shown(limbfit, study):
    edit(study, "[study]", "[mesh]\nedge_near_mm = 6.0\nedge_far_mm = 30.0\n[study]")
    code, out, _ = limbfit("mesh", study, "--json")
    found = json.loads(out)
    assert code == 0
    assert set(found["sites"]) == {"1", "2"}
    assert all(row["min_dihedral_deg"] > 5 for row in found["sites"].values())
    assert min(picture_size(found["picture"])) > 400
    assert limbfit("run", study, "--until", "mesh")[0] == 0
    assert not (study / "results/calibrate").exists()


def test_nothing_to_segment(limbfit, study):
    code, out, err = limbfit("segment", study)
    assert code == 2
    assert out == ""
    assert "nothing to segment" in err


@pytest.mark.parametrize("name", ["skin.stl", "tibia.stl", "1.csv"])
def test_missing_files(limbfit, study, name):
    (study / name).unlink()
    check_refused(limbfit, study, "study.toml", name, "does not exist")


def test_no_study(limbfit, tmp_path):
    code, _, err = limbfit("run", tmp_path / "nowhere")
    assert code == 2
    assert "no such study" in err


def test_unknown_key(limbfit, study):
    edit(study, '[study]\nname = "stump"', '[study]\nname = "stump"\nnmae = 1')
    check_refused(limbfit, study, "study.toml", "study.nmae", "unknown key")


def test_open_surface(limbfit, study):
    surface = pv.read(study / "skin.stl")
    surface.extract_cells(range(20, surface.n_cells)).extract_surface(algorithm=None).save(study / "skin.stl")
    check_refused(limbfit, study, "skin.stl", "open")


def test_inverted_surface(limbfit, study):
    pv.read(study / "tibia.stl").flip_faces().save(study / "tibia.stl")
    check_refused(limbfit, study, "tibia.stl", "inward")


def test_bone_outside_the_skin(limbfit, study):
    pv.read(study / "tibia.stl").translate((35.0, 0, 0)).save(study / "tibia.stl")
    check_refused(limbfit, study, "tibia", "outside")


def test_site_off_the_skin(limbfit, study):
    edit(study, "position = [40.0, 0.0, 60.0]", "position = [46.5, 0.0, 60.0]")
    check_refused(limbfit, study, "study.toml", "sites.1", "off the skin")


def rewrite(study, change) -> None:
    table = np.loadtxt(study / "1.csv", delimiter=",", skiprows=1)
    header = change(table) or HEADER
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
    check_refused(limbfit, study, "1.csv", fragment)


def test_bad_usage(limbfit, study):
    seeded = [(verb, study.parent / "new", "--seed", -1) for verb in ("phantom", "demo", "crossvalidate")]
    for words in (("run",), ("run", study, "--until", "nonsense"), ("nonsense",), *seeded):
        code, out, err = limbfit(*words)
        assert code == 2
        assert out == ""
        assert "Traceback" not in err
    code, _, err = limbfit("simulate", study, "--site", "1", "--parameters", "1,2")
    assert code == 2
    assert "is not 8 numbers; give c_kPa,m,gamma,tau_s of skin, then of muscle, separated" in err
    code, _, err = limbfit("simulate", study, "--site", "99")
    assert code == 2
    assert "no site is named '99'" in err


def test_a_file_where_a_folder_is_wanted_is_one_line(limbfit, study):
    code, out, err = limbfit("phantom", study / "1.csv" / "new")
    assert (code, out) == (2, "")
    lines = [line for line in err.splitlines() if not line.startswith("[")]
    assert len(lines) == 1
    assert "1.csv" in lines[0]
    assert "a file stands where a folder is wanted; give another place" in lines[0]


def test_check_tells_what_was_closed(limbfit, commands_unasked, study):
    skin = pv.read(study / "skin.stl")
    skin.extract_cells(skin.cell_centers().points[:, 2] < 119.0).extract_surface(
        algorithm="dataset_surface"
    ).save(study / "skin.stl")
    code, out, _ = limbfit("check", str(study))
    assert code == 0
    assert "skin: open at one end, cut flat" in " ".join(out.split())


def test_an_amputation_shortens_given_surfaces(limbfit, commands_unasked, study):
    _, whole, _ = limbfit("check", study)
    bones = 'bones = { tibia = "tibia.stl" }'
    edit(study, bones, bones + "\n[geometry]\namputation = { point = [0, 0, 30] }")
    code, out, _ = limbfit("check", study)
    assert code == 0
    extent = [text.split("extent of the skin: ")[1].split(" mm")[0] for text in (whole, out)]
    # From the plane at 30 mm the pad of 15 mm reaches to 15 mm: the limb is 120 - 15 mm long.
    assert float(extent[1].split(" x ")[2]) == pytest.approx(105, abs=2)
    assert float(extent[0].split(" x ")[2]) > 145


def test_a_run_that_ends_with_the_calibration_shows_the_parameters(capsys):
    """There are no predictions yet; it ended in an internal error."""
    values = {"c_kPa": 6.5, "m": 7.0, "gamma": 2.5, "tau_s": 0.5}
    show_summary({"parameters": {"skin": values}, "until": "calibrate", "results": "results"})
    assert "skin, identified" in capsys.readouterr().out


def test_a_table_in_a_file_cuts_no_name(capsys):
    """It was cut at 80 characters, and two parameters of a tissue looked alike."""
    names = [f"the_deep_compartment_of_the_calf.{name}" for name in ("gamma1", "gamma2")]
    rows = [{"name": name, "interval": "0.000123 to 12.3", "verdict": "not determined"} for name in names]
    columns = {"parameter": "name", "95 % by the records": "interval", "with all sources": "interval"}
    print_table(rows, {**columns, "verdict": "verdict"})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["parameter", *names]


def test_text_that_looks_like_a_symbol_stays_text(capsys):
    print_line("results in studies:x:2/results")
    assert capsys.readouterr().out == "results in studies:x:2/results\n"


def test_letters_that_the_output_cannot_show_end_no_command(study):
    """As on Windows, where what is redirected has the letters of one country."""
    edit(study, "fitted = true", 'fitted = true\nregion = "łydka"')
    words = [sys.executable, "-m", "limbfit", "sites", str(study)]
    done = subprocess.run(
        words, capture_output=True, env={**os.environ, "PYTHONIOENCODING": "cp1252"}, check=False
    )
    assert done.returncode == 0, done.stderr
    assert rb"\u0142ydka" in done.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("design", "--minutes", 5), "--minutes: has no effect without --protocol"),
        (("design", "--shear-waves", 0.1), "--shear-waves: has no effect without --protocol"),
        (("design", "--protocol", "--sites", 3), "--sites: has no effect with --protocol"),
        (("socket", "design", "--simulations", 3), "--simulations: has no effect without --optimise"),
    ],
)
def test_an_option_that_has_no_effect_is_refused(limbfit, study, words, told):
    code, _, err = limbfit(*words, study)
    assert code == 2
    assert told in err
