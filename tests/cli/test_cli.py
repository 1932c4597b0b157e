"""The command line: exit codes, one-line errors, JSON, nothing half-written."""

import io
import json
import sys

import matplotlib.image
import numpy as np
import pytest
import pyvista as pv
import typer

from editing import append, edit, rewrite
from limbfit import __version__
from limbfit.cli import GROUPS, app
from limbfit.cli.commands import show_findings, show_summary
from limbfit.cli.console import print_line, print_table


@pytest.fixture
def alone(study):
    """The study on this process alone: a worker that draws would import everything anew."""
    edit(study, "[study]", "[execution]\nworkers = 1\n[study]")
    return study


def check_refused(call, study, verb: str, *fragments: str) -> None:
    """Exit code 2, one error line with all fragments, no traceback, no results but the log of the try."""
    code, out, err = call(verb, study)
    errors = [line for line in err.splitlines() if not line.startswith("[")]
    assert (code, out) == (2, ""), err
    assert len(errors) == 1
    assert errors[0].startswith("error: ")
    for fragment in fragments:
        assert fragment in errors[0]
    files = [p for p in study.glob("results/*/**/*") if p.suffix not in {".lock", ".seconds", ""}]
    unfinished = [p for p in files if not (p.parent / "stage.json").is_file()]
    assert [p for p in unfinished if p.parent != study / "results" / "log"] == []


def test_version(limbfit):
    assert limbfit("--version") == (0, f"limbfit {__version__}\n", "")


def skin_length(told: str) -> float:
    return float(told.split("extent of the skin: ")[1].split(" mm")[0].split(" x ")[2])


def test_check_tells_the_facts(limbfit, study):
    code, out, _ = limbfit("check", study)
    assert code == 0
    assert skin_length(out) == pytest.approx(150.0, abs=1.0)
    assert "site 1: peak force 6.0" in out
    assert "tibia" in out
    assert "1 of 2 sites are fitted" in out
    assert out.endswith("the study can be run\n")
    assert not (study / "results").exists()


def test_check_does_not_say_that_a_study_without_a_fitted_site_can_be_run(capsys):
    refused = [{"commands": ["run"], "why": "no site is fitted"}]
    show_findings({"facts": ["one"], "flags": [], "outside_text": [], "refused": refused})
    assert capsys.readouterr().out == "one\nthe study cannot be run to its end\n"


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
def test_the_shell_completes_verbs_and_options(limbfit, monkeypatch, typed, word, offered):
    monkeypatch.setattr(sys.modules["__main__"], "__package__", None, raising=False)  # started as a script
    asked = {"_LIMBFIT_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(word)}
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert limbfit()[1].split() == offered


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


def test_check_says_what_goes_beyond_the_fitted_records(limbfit, commands_unasked, study, capsys):
    """A site a quarter around the limb, one that is planned deep and fast, and a load of an hour."""
    append(study, PLANNED)
    code, out, _ = limbfit("check", study, "--json")
    found = json.loads(out)
    assert code == 0
    assert found["sites"]["1"]["touch_down_mm"] == pytest.approx(0.4, abs=0.15)
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
    show_findings(found)
    assert f"warning: {times}\nwarning: {others}" in capsys.readouterr().err


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


def picture_size(file: str) -> tuple[int, int]:
    pixels = matplotlib.image.imread(file)
    assert pixels[..., :3].std() > 0.05  # something is drawn
    return pixels.shape[1], pixels.shape[0]


def test_surfaces_are_shown(limbfit, alone):
    """Volumes of the spheroids, and the thinnest tissue between them, with a picture."""
    code, out, _ = limbfit("surfaces", alone, "--json")
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


def test_sites_are_shown_on_the_skin_with_inward_axes_whatever_letters_the_output_lacks(
    limbfit, alone, monkeypatch
):
    """As on Windows, where what is redirected has the letters of one country."""
    edit(alone, "fitted = true", 'fitted = true\nregion = "łydka"')
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding="cp1252", write_through=True))
    code, _, err = limbfit("sites", alone)
    assert code == 0, err
    assert rb"\u0142ydka" in shown.getvalue()
    assert b"sites.png" in shown.getvalue()
    assert min(picture_size(alone / "results" / "sites" / "sites.png")) > 400
    assert not (alone / "results/traces").exists()
    first, second = json.loads((alone / "results/sites/sites.json").read_text())["sites"]
    for site, (x, y, z) in ((first, (1, 0, 60)), (second, (0, 1, 50))):
        radius = 42.0 * np.sqrt(1 - ((z - 120) / 150) ** 2)
        outward = np.array([x * radius / 42.0**2, y * radius / 42.0**2, (z - 120) / 150**2])
        np.testing.assert_allclose(site["axis"], -outward / np.linalg.norm(outward), atol=0.03)
        assert np.hypot(*site["position_mm"][:2]) == pytest.approx(radius, abs=0.5)


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


def test_no_study(limbfit, tmp_path):
    code, _, err = limbfit("run", tmp_path / "nowhere")
    assert code == 2
    assert "no such study" in err


def open_skin(study):
    surface = pv.read(study / "skin.stl")
    surface.extract_cells(range(20, surface.n_cells)).extract_surface(algorithm=None).save(study / "skin.stl")


def scale(study, at, factor) -> None:
    """Multiply a part of the first record's table."""

    def change(table):
        table[at] *= factor
        return table

    rewrite(study / "1.csv", change)


SPOILT = {
    "no skin": (lambda s: (s / "skin.stl").unlink(), ("study.toml", "skin.stl", "does not exist")),
    "no bone": (lambda s: (s / "tibia.stl").unlink(), ("study.toml", "tibia.stl", "does not exist")),
    "no record": (lambda s: (s / "1.csv").unlink(), ("study.toml", "1.csv", "does not exist")),
    "an unknown key": (
        lambda s: edit(s, "[study]\n", "[study]\nnmae = 1\n"),
        ("study.toml", "study.nmae", "unknown key"),
    ),
    "an open surface": (open_skin, ("skin.stl", "open")),
    "an inverted surface": (
        lambda s: pv.read(s / "tibia.stl").flip_faces().save(s / "tibia.stl"),
        ("tibia.stl", "inward"),
    ),
    "a bone outside the skin": (
        lambda s: pv.read(s / "tibia.stl").translate((35.0, 0, 0)).save(s / "tibia.stl"),
        ("tibia", "outside"),
    ),
    "a site off the skin": (
        lambda s: edit(s, "position = [40.0, 0.0, 60.0]", "position = [46.5, 0.0, 60.0]"),
        ("study.toml", "sites.1", "off the skin"),
    ),
    "no number": (lambda s: scale(s, np.s_[100, 2], np.nan), ("1.csv", "force_N")),
    "time that goes back": (lambda s: scale(s, np.s_[100, 0], 0.9), ("1.csv", "time")),
    "no contact": (lambda s: scale(s, np.s_[:, 2], 0.0), ("1.csv", "contact")),
    "metres": (lambda s: scale(s, np.s_[:, 1], 1e-3), ("1.csv", "mm")),
}


@pytest.mark.parametrize("what", SPOILT)
def test_a_spoilt_input_is_one_line_that_names_it(limbfit, study, what):
    spoil, fragments = SPOILT[what]
    spoil(study)
    check_refused(limbfit, study, "check", *fragments)


@pytest.mark.parametrize("what", ["an unknown key", "a bone outside the skin", "no contact"])
def test_a_run_on_a_spoilt_input_says_the_same_and_leaves_nothing_half_written(limbfit, study, what):
    spoil, fragments = SPOILT[what]
    spoil(study)
    check_refused(limbfit, study, "run", *fragments)


def test_bad_usage(limbfit, study):
    seeded = [(verb, study.parent / "new", "--seed", -1) for verb in ("phantom", "demo", "crossvalidate")]
    for words in (("run",), ("run", study, "--until", "nonsense"), ("nonsense",), *seeded):
        code, out, err = limbfit(*words)
        assert code == 2
        assert out == ""
        assert "Traceback" not in err


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
    """From 150 mm."""
    bones = 'bones = { tibia = "tibia.stl" }'
    edit(study, bones, bones + "\n[geometry]\nsurface_edge_mm = 10.0\namputation = { point = [0, 0, 30] }")
    code, out, _ = limbfit("check", study)
    assert code == 0
    # From the plane at 30 mm the pad of 15 mm reaches to 15 mm: the limb is 120 - 15 mm long.
    assert skin_length(out) == pytest.approx(105, abs=2)


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


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("segment",), "nothing to segment"),
        (("simulate", "--site", "99"), "no site is named '99'"),
        (
            ("simulate", "--site", "1", "--parameters", "1,2"),
            "is not 8 numbers; give c_kPa,m,gamma,tau_s of skin, then of muscle, separated",
        ),
        (("design", "--minutes", 5), "--minutes: has no effect without --protocol"),
        (("design", "--shear-waves", 0.1), "--shear-waves: has no effect without --protocol"),
        (("design", "--protocol", "--sites", 3), "--sites: has no effect with --protocol"),
        (("socket", "design", "--simulations", 3), "--simulations: has no effect without --optimise"),
    ],
)
def test_what_a_study_or_an_option_rules_out_is_refused(limbfit, study, words, told):
    code, out, err = limbfit(*words, study)
    assert (code, out) == (2, "")
    assert told in err
