"""What inputs decide is said by ``limbfit check``, and by commands before anything is meshed or simulated."""

import re
from pathlib import Path

import numpy as np
import pytest

from editing import edit
from limbfit import (
    check_study,
    design_socket,
    design_study,
    export_study,
    fit_socket,
    load_study,
    plan_protocol,
    run_experiment,
    run_study,
)
from limbfit.anatomy.imaging import LabelMap, Volume, write_labels, write_volume
from limbfit.errors import InputError
from limbfit.pipeline.commands.check import list_refused_commands

UNFITTED = ("fitted = true", "")
BOTH_FITTED = ('trace = "2.csv"', 'trace = "2.csv"\nfitted = true')
FORCED = ('trace = "2.csv"', 'trace = "2.csv"\ncontrol = "force"')
FIBRED = ("[[sites]]", '[material]\nlaw = "ogden-fibres"\n[[sites]]')
STRETCHED = ("[[sites]]", "[material]\nprestretch = { skin = 1.1 }\n[[sites]]")
RUBBED = ("[[sites]]", "[indenter]\nfriction = 0.3\n[[sites]]")
FAST = ("[[sites]]", '[[records]]\nsite = "1"\nname = "f"\ntrace = "1.csv"\nspeed_mm_s = 9.0\n[[sites]]')
BARE = "[socket]\ntrim_mm = 40.0\nliner = { thickness_mm = 0.0 }\n"
WIDE = (
    "[[sites]]",
    f'{BARE}[socket.design]\npressure = "hydrostatic"\nadapter_diameter_mm = 120.0\n[[sites]]',
)
BONELESS = ('bones = { tibia = "tibia.stl" }', "")


def with_change(folder: Path, change: tuple[str, str]):
    edit(folder, *change, count=1)
    return load_study(folder)


def begun(study) -> list[str]:
    """The stages that were begun; a log is none."""
    return [path.name for path in study.results.glob("*") if path.name != "log" and path.is_dir()]


def experiment(name: str, **options):
    return lambda study: run_experiment(study, name, **options)


FIXED = [f'"{tissue}.{key}"' for tissue in ("skin", "muscle") for key in ("c_kPa", "m", "gamma", "tau_s")]
# By what the study file says: commands, their calls, and why they are refused.
BY_STUDY = {
    UNFITTED: {
        "run": (run_study, "no site is fitted"),
        "uncertainty": (experiment("uncertainty"), "no site is fitted"),
    },
    BOTH_FITTED: {"crossvalidate": (experiment("crossvalidate"), "leave none to be predicted")},
    FORCED: {
        "regions": (experiment("regions"), "no site has a region"),
        "design": (design_study, "one indentation per site"),
    },
    FIBRED: {
        "cube": (experiment("cube"), "has fibres"),
        "export --to febio-optimize": (
            lambda s: export_study(s, "febio-optimize"),
            'fit is written for "ogden", whatever its relaxation terms',
        ),
    },
    STRETCHED: {
        "socket": (fit_socket, "at rest, without contraction and pre-stretch"),
        "socket design": (design_socket, "at rest, without contraction and pre-stretch"),
    },
    RUBBED: {
        "export --to calculix": (
            lambda s: export_study(s, "calculix"),
            "friction is not written for Calculix",
        ),
        "export --to inp": (lambda s: export_study(s, "inp"), "friction is not written for Abaqus"),
    },
    ("[[sites]]", f"[calibration]\nfixed = [{', '.join(FIXED)}]\n[[sites]]"): {
        "run": (run_study, "calibration: no parameter is left to move")
    },
}


NAMES = ("unfitted", "all fitted", "under force", "with fibres", "stretched", "rubbed", "all fixed")


@pytest.mark.parametrize("change", BY_STUDY, ids=NAMES)
def test_what_the_study_file_decides_is_said_at_once(study, change):
    given = with_change(study, change)
    refused = list_refused_commands(given, None)
    for command, (call, words) in BY_STUDY[change].items():
        (why,) = [row["why"] for row in refused if command in row["commands"]]
        assert words in why
        with pytest.raises(InputError, match=re.escape(words)):
            call(given)
    assert not begun(given)


def test_options_are_judged_at_once(study):
    given = with_change(study, ("[[sites]]", '[calibration]\nfixed = ["skin.m"]\n[[sites]]'))
    for call, words in (
        (experiment("crossvalidate", fit=2), "2 of 2 recorded sites"),
        (experiment("sensitivity-mesh", factors=[1.0]), "one mesh cannot be compared"),
        (experiment("sensitivity-c", sites=["9"]), "no site is named '9'"),
        (experiment("cube", compression_percent=90.0), "is not possible here"),
        (
            experiment("crossvalidate", fit="two"),
            "cannot be 'two'; its default is 0",
        ),
        (experiment("sensitivity-c", sites=15), "option sites of sensitivity-c cannot be 15; its default is"),
        (experiment("sensitivity-mesh", factors="0.7"), "cannot be '0.7'; its default is"),
        (lambda s: design_study(s, sites=3), "3 sites are wanted of 2"),
        (lambda s: plan_protocol(s, determine=("bone.c_kPa",)), r"no parameter is named 'bone\.c_kPa'"),
        (lambda s: plan_protocol(s, minutes=1), "no record fits into 1 min"),
        (lambda s: plan_protocol(s, determine=("skin.m",)), r"the study fixes 'skin\.m'"),
    ):
        with pytest.raises(InputError, match=words):
            call(given)
    assert not begun(given)


def test_what_the_limb_decides_is_said_before_meshing(study):
    unfitted = with_change(study, UNFITTED)
    with pytest.raises(InputError, match="40 mm is no deeper than half"):
        design_study(unfitted, depths_mm=(40.0,))
    for change in (BONELESS, FAST, WIDE, BOTH_FITTED):
        given = with_change(study, change)
    found = check_study(given)
    refused = found["refused"]
    said = {f"cannot run: limbfit {', '.join(row['commands'])}: {row['why']}" for row in refused}
    assert said <= set(found["facts"])
    for command, call, words in (
        ("sensitivity --only c", experiment("sensitivity-c"), "the limb has no bone"),
        ("socket design", design_socket, "120 mm is as wide as the socket"),
        ("acquire --site 1-f", None, "ramp_speed_mm_s is over speed_limit_mm_s"),
    ):
        assert any(command in row["commands"] and words in row["why"] for row in refused)
        if call is not None:
            with pytest.raises(InputError, match=words):
                call(given)
    assert not list(given.results.rglob("*.vtu"))


def test_pins_that_miss_the_limb_are_said_before_meshing(study):
    given = with_change(study, ("[[sites]]", "[clamps]\nangles_degrees = [10.0]\n[[sites]]"))
    with pytest.raises(InputError, match="clamps: site 1: "):
        run_study(given)
    assert not (given.results / "mesh").exists()


def test_a_surface_that_is_elsewhere_is_said_before_meshing(study):
    time, far = np.arange(0.0, 11.0, 0.2), 500.0
    rows = [[t, far + off, far, far, 0.0, 0.0, 0.1 * t] for t in time for off in (0.0, 10.0)]
    header = "time_s,x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm"
    np.savetxt(study / "skin.csv", rows, delimiter=",", header=header, comments="")
    given = with_change(study, ('trace = "2.csv"', 'trace = "2.csv"\nsurface = "skin.csv"'))
    for call in (check_study, run_study):
        with pytest.raises(InputError, match=r"no point lies within 40 mm of site 2"):
            call(given)
    assert not (given.results / "mesh").exists()


def test_records_are_read_before_the_limb_is_made(study):
    (study / "2.csv").write_text("time_s,displacement_mm,force_N\n0,0,0\n")
    with pytest.raises(InputError, match=r"2\.csv"):
        run_study(load_study(study))
    assert not (study / "results" / "surfaces").exists()


def test_all_records_are_judged_before_the_first_is_made(study, limbfit):
    """The first needs a device that is not there: who asks for it ends with exit code 1."""
    (study / "1.csv").unlink()
    edit(study, FAST[0], FAST[1].replace("1.csv", "f.csv"), count=1)
    words = ("acquire", study, "--unattended", "--depth", "5", "--device", "tcp://127.0.0.1:9")
    code, _, errors = limbfit(*words)
    assert code == 2
    assert "ramp_speed_mm_s is over speed_limit_mm_s" in errors


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        ('layers = [{ name = "fat", thickness = "map" }]', "no voxel is labelled 'fat'"),
        (
            'regions = [{ name = "tendon", label = "patellar tendon" }]',
            "no voxel is labelled 'patellar tendon'",
        ),
    ],
)
def test_a_label_that_the_geometry_needs_is_missed_by_the_check(tmp_path, geometry, words):
    z, y, x = np.meshgrid(*(np.arange(n) - n / 2 for n in (40, 30, 30)), indexing="ij")
    away = np.hypot(x, y)
    array = ((away < 12) & (z > -18)).astype(np.uint8) + ((away < 4) & (z > -12)).astype(np.uint8)
    grid = np.full(3, 4.0), np.zeros(3), np.eye(3)
    write_volume(tmp_path / "mri.nii.gz", Volume(100.0 * array.astype(np.float32), *grid))
    write_labels(tmp_path / "labels.nii.gz", LabelMap(array, *grid, {1: "soft tissue", 2: "tibia"}))
    head = (
        '[study]\nname = "labelled"\n[image]\npath = "mri.nii.gz"\n[segmentation]\nlabels = "labels.nii.gz"\n'
    )
    site = '[[sites]]\nname = "1"\ndepth_mm = 3.0\nposition = [48.0, 0.0, 0.0]\n'
    (tmp_path / "study.toml").write_text(f"{head}[geometry]\n{geometry}\n{site}")
    with pytest.raises(InputError, match=words):
        check_study(load_study(tmp_path))
