"""Inputs that are damaged or meant to harm: exit code 0 or 2 and one line, never a traceback."""

import gzip
import os
import resource
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conftest import write_trace
from editing import append, edit
from limbfit import run_study
from limbfit.anatomy.imaging import read_labels
from limbfit.errors import InputError, LabelError, RunError
from limbfit.study import load_study

SETTINGS = {"deadline": None, "suppress_health_check": list(HealthCheck), "derandomize": True}


def check(folder, limbfit, *verb: str) -> str:
    """``limbfit check``, or another verb: the exit code must be 0 or 2; what stands on standard error."""
    code, _, err = limbfit(*(verb or ["check"]), folder)
    assert code in (0, 2), err
    assert "Traceback" not in err
    if code == 2:
        assert err.strip().splitlines()[-1].startswith("error: ")
    return err


def damage():
    """A few changes of bytes: (where, how much goes, what comes), where as a share of the file."""
    one = st.tuples(st.floats(0, 1), st.integers(0, 40), st.binary(max_size=20) | st.sampled_from(WORDS))
    return st.lists(one, min_size=1, max_size=4)


WORDS = [
    *(b"nan", b"1e999", b"-inf", b"[[", b'"""', b"\x00", b"\x1b[2J", b"../../etc/passwd", b"\xff\xfe", b"{}"),
    *(b"-1", b"[sites]", b"name = 1\n", b"9" * 400, "é‮".encode()),
]


def damaged(content: bytes, changes) -> bytes:
    for share, gone, come in changes:
        at = int(share * len(content))
        content = content[:at] + come + content[at + gone :]
    return content


@pytest.mark.slow
def test_five_hundred_damaged_files(study, limbfit):
    """Each example damages one of the study's files and checks it; what passes is run up to its meshes."""
    names = ["study.toml", "study.toml", "1.csv", "1.csv", "tibia.stl"]
    whole = {name: (study / name).read_bytes() for name in set(names)}

    @settings(max_examples=500, **SETTINGS)
    @given(st.sampled_from(names), damage())
    def run(name, changes):
        (study / name).write_bytes(damaged(whole[name], changes))
        try:
            if "error: " not in check(study, limbfit):
                check(study, limbfit, "run", "--until", "traces")
        finally:
            (study / name).write_bytes(whole[name])

    run()


@settings(max_examples=50, **SETTINGS)
@given(damage())
def test_damaged_study_files_are_read_or_refused(tmp_path_factory, changes):
    folder = tmp_path_factory.mktemp("fuzz")
    for name in ("skin.stl", "tibia.stl", "1.csv", "2.csv"):
        (folder / name).touch()
    text = (
        '[study]\nname = "s"\n[surfaces]\nskin = "skin.stl"\n[[sites]]\nname = "1"\nfitted = true\n'
        'trace = "1.csv"\nposition = [40.0, 0.0, 60.0]\n[solver]\nload_steps = 4\n'
    )
    (folder / "study.toml").write_bytes(damaged(text.encode(), changes))
    with suppress(InputError):
        load_study(folder)


@pytest.mark.parametrize("name", ["study.toml", "1.csv", "skin.stl"])
def test_fifty_megabytes_of_zeros(study, limbfit, name):
    (study / name).write_bytes(bytes(50_000_000))
    assert "error: " in check(study, limbfit)


LAUGHS = (
    b'<?xml version="1.0"?>\n<!DOCTYPE l [<!ENTITY a "ha">'
    + b"".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">'.encode() for i in range(12))
    + b']>\n<VTKFile type="PolyData"><PolyData>&m;</PolyData></VTKFile>'
)


def test_a_billion_laughs_in_a_surface(study, limbfit):
    (study / "skin.vtp").write_bytes(LAUGHS)
    edit(study, "skin.stl", "skin.vtp")
    assert "error: " in check(study, limbfit)


def test_deeply_nested_toml_is_refused(study, limbfit):
    append(study, "\nx = " + "[" * 5000 + "]" * 5000)
    assert "error: " in check(study, limbfit)


def of_an_image(study, name: str) -> None:
    """The study has this image instead of surfaces."""
    edit(study, '[surfaces]\nskin = "skin.stl"', f'[image]\npath = "{name}"')
    edit(study, 'bones = { tibia = "tibia.stl" }\n', "")


def test_a_bomb_of_zeros_in_a_compressed_image(study, limbfit):
    with gzip.open(study / "image.nii.gz", "wb", compresslevel=1) as stream:
        for _ in range(100):
            stream.write(bytes(1_000_000))
    of_an_image(study, "image.nii.gz")
    assert "error: " in check(study, limbfit)


HUGE = b"NRRD0004\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: %s\n" + (
    b"space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\nkinds: domain domain domain\n"
    b"endian: little\nencoding: gzip\n\n"
)


def test_an_image_that_states_more_voxels_than_memory_is_refused_unread(study, limbfit):
    (study / "image.nrrd").write_bytes(HUGE % b"9000 9000 9000" + gzip.compress(bytes(1_000_000)))
    of_an_image(study, "image.nrrd")
    assert "9000 x 9000 x 9000 voxels" in check(study, limbfit)


@pytest.mark.parametrize("size", [b"64 64 64", b"9000 9000 9000"])
def test_a_bomb_in_a_label_map_is_refused_unread(tmp_path, size):
    file = tmp_path / "labels.seg.nrrd"
    file.write_bytes(HUGE % size + gzip.compress(bytes(100_000_000), 1))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LabelError, match=r"names no segment|more than 1e"):
        read_labels(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


def test_a_surface_that_states_any_number_of_points_is_refused_unread(study, limbfit):
    text = (
        '<?xml version="1.0"?><VTKFile type="PolyData" compressor="vtkZLibDataCompressor"><PolyData>'
        '<Piece NumberOfPoints="90000000000" NumberOfPolys="1"></Piece></PolyData></VTKFile>'
    )
    (study / "skin.vtp").write_text(text)
    edit(study, "skin.stl", "skin.vtp")
    assert "points or faces" in check(study, limbfit)


@pytest.mark.parametrize("way", ["link", "path"])
def test_a_trace_out_of_the_study_gives_away_nothing(study, limbfit, way):
    secret = study.parent / "secret.txt"
    secret.write_text("root:x:0:0:secret\n" * 20)
    if way == "link":
        (study / "2.csv").unlink()
        (study / "2.csv").symlink_to(secret)
    else:
        edit(study, '"2.csv"', '"../secret.txt"')
    err = check(study, limbfit)
    assert "error: " in err
    assert "root:x" not in err


@pytest.mark.parametrize("name", ["../../x", "a/b", "a\\u0000b", "\\u001b[2J", "", "x" * 300])
def test_names_that_would_leave_the_folder_or_the_line_are_refused(study, limbfit, name):
    edit(study, 'name = "1"', f'name = "{name}"')
    err = check(study, limbfit)
    assert "sites.1.name" in err
    assert "\x1b" not in err


def test_results_that_are_a_link_out_of_the_study_are_not_written(study, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (study / "results").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(RunError, match="is a link"):
        run_study(load_study(study), until="surfaces")
    assert not os.listdir(elsewhere)


def test_a_stage_that_is_a_link_is_replaced_and_its_target_left_alone(study, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "precious").write_text("kept")
    (study / "results").mkdir()
    (study / "results/traces").symlink_to(elsewhere, target_is_directory=True)
    for name in ("1.csv", "2.csv"):
        write_trace(study / name, rate=20.0)
    run_study(load_study(study), until="traces")
    assert (elsewhere / "precious").read_text() == "kept"
    assert os.listdir(elsewhere) == ["precious"]
    assert (study / "results/traces/traces.json").is_file()
