"""load_study: what it accepts, and that each refusal is one line with file, key and remedy."""

import re
from pathlib import Path

import pytest

from limbfit.errors import StudyError
from limbfit.studio.editing import edit_study
from limbfit.study import load_study

GOOD = """
[study]
name = "one limb"

[surfaces]
skin = "skin.stl"
bones = { tibia = "tibia.stl" }

[mesh]
edge_near_mm = 3.0

[[sites]]
name = "1"
fitted = true
trace = "1.csv"
position = [0.0, -50.0, 10.0]

[[sites]]
name = "2"
depth_mm = 6.0
position = [0.0, 50.0, 10.0]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("skin.stl", "tibia.stl", "1.csv"):
        (tmp_path / name).touch()
    (tmp_path / "mri").mkdir()
    return tmp_path


def write(folder: Path, text: str) -> Path:
    file = folder / "study.toml"
    file.write_text(text, encoding="utf-8")
    return file


def refusal(path: Path) -> str:
    with pytest.raises(StudyError) as caught:
        load_study(path)
    text = str(caught.value)
    return text


def test_a_good_study(folder: Path) -> None:
    file = write(folder, GOOD)
    study = load_study(file)
    assert study == load_study(folder)
    assert [site.name for site in study.sites] == ["1", "2"]
    assert [site.name for site in study.fitted] == ["1"]
    assert study.results == folder / "results"
    assert study.mesh.edge_near_mm == 3.0
    assert study.mesh.edge_far_mm == 30.0
    assert study.path(study.sites[0].trace or Path()) == folder / "1.csv"
    assert study.site("2").depth_mm == 6.0


def test_a_study_does_not_change(folder: Path) -> None:
    study = load_study(write(folder, GOOD))
    with pytest.raises(Exception, match="frozen"):
        study.mesh.edge_near_mm = 1.0


def test_an_unknown_site_is_answered_with_the_known_ones(folder: Path) -> None:
    study = load_study(write(folder, GOOD))
    with pytest.raises(StudyError, match=r"study\.toml: sites: no site is named '7'; the study has 1, 2"):
        study.site("7")


def test_no_study(folder: Path) -> None:
    text = refusal(folder)
    assert text.startswith(str(folder / "study.toml"))
    assert "no such study; give a study.toml or the folder that holds one" in text


@pytest.mark.parametrize("content", [b"[study\nname = 1", b"[study]\nname = \xff\xfe"])
def test_not_toml(folder: Path, content: bytes) -> None:
    (folder / "study.toml").write_bytes(content)
    assert re.search(r"study\.toml: not valid TOML: .+", refusal(folder))


def test_a_file_that_begins_with_a_mark_is_read(folder: Path) -> None:
    """Editors on Windows put a byte-order mark there, and end lines with two characters."""
    plain = load_study(write(folder, GOOD))
    (folder / "study.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load_study(folder) == plain
    with edit_study(folder / "study.toml") as document:
        document["study"]["name"] = "another"
    assert load_study(folder).study.name == "another"


@pytest.mark.parametrize("ending", ["raw", "layers", "surface", "waves", "model", "optimize"])
def test_no_site_has_the_name_of_another_ones_file(folder: Path, ending: str) -> None:
    write(folder, GOOD.replace('name = "2"', f'name = "1-{ending}"'))
    assert f"1-{ending} is a file of '1' in results; give another name" in refusal(folder)
    write(folder, GOOD.replace('name = "2"', f'name = "2-{ending}"'))
    load_study(folder)


SURFACES = GOOD[GOOD.index("[surfaces]") : GOOD.index("[mesh]")]
# what to replace in the good study, by what, and what the refusal says: place, fault
FAULTS = {
    "unknown key": (
        "edge_near_mm = 3.0",
        "edge_naer_mm = 3.0",
        r"mesh\.edge_naer_mm: unknown key; see docs/study",
    ),
    "unknown table": ("[mesh]", "[meshes]", r"meshes: unknown key; see docs/study"),
    "notes before the tables": ("[study]", 'notes = ["ask"]\n[study]', r"notes: unknown key; see docs/study"),
    "a file before the tables": ("[study]", 'file = "limb.toml"\n[study]', r"file: unknown key; see docs/"),
    "zero": ("edge_near_mm = 3.0", "edge_near_mm = 0", r"mesh\.edge_near_mm: .*greater than 0"),
    "infinite": ("edge_near_mm = 3.0", "edge_near_mm = inf", r"mesh\.edge_near_mm: .*finite"),
    "not a number": ("edge_near_mm = 3.0", "edge_near_mm = nan", r"mesh\.edge_near_mm: "),
    "number in quotes": ("edge_near_mm = 3.0", 'edge_near_mm = "3.0"', r"mesh\.edge_near_mm: .*number"),
    "truth for number": ("depth_mm = 6.0", "depth_mm = true", r"sites\.2\.depth_mm: .*number"),
    "number for truth": ("fitted = true", "fitted = 1", r"sites\.1\.fitted: .*boolean"),
    "wrong choice": ("edge_near_mm = 3.0", 'element = "hex20"', r"mesh\.element: .*'tet10' or 'tet10p0'"),
    "several faults": (
        "edge_near_mm = 3.0",
        "edge_near_mm = 0\ngrowth = 0",
        r"\(and 1 more\)",
    ),
    "short vector": ("[0.0, -50.0, 10.0]", "[0.0, -50.0]", r"sites\.1\.position\.3: Field required"),
    "infinite vector": ("[0.0, -50.0, 10.0]", "[0.0, -50.0, inf]", r"sites\.1\.position\.3: .*finite"),
    "no axis": ("fitted = true", "fitted = true\naxis = [0, 0, 0]", "sites.1.axis: a direction of no length"),
    "no edge": ("fitted = true", "fitted = true\nedge = [0, 0, 0]", "sites.1.edge: a direction of no length"),
    "edge along axis": (
        "fitted = true",
        "fitted = true\naxis = [0, 2, 0]\nedge = [0, -1, 0]",
        r"sites\.1: edge is along axis",
    ),
    "no name": ('name = "one limb"', "", r"study\.name: .*required"),
    "bad site name": (
        'name = "2"',
        'name = "../2"',
        r"sites\.2\.name: '\.\./2' is no name; begin with a letter",
    ),
    "no site name": ('name = "2"\n', "", r"sites\.2\.name: Field required"),
    "same site twice": ('name = "2"', 'name = "1"', r"sites: site names must differ; given twice: 1"),
    "no door": (SURFACES, "", r"either \[image\] or \[surfaces\]"),
    "no place": ("position = [0.0, 50.0, 10.0]", "", r"sites\.2: give either position .* or near"),
    "near without markers": (
        "position = [0.0, 50.0",
        "near = [0.0, 50.0",
        r"site 2: 'near' needs image\.markers",
    ),
    "record and plan": (
        'trace = "1.csv"',
        'trace = "1.csv"\ndepth_mm = 5',
        r"sites\.1: give either trace .* or depth",
    ),
    "fitted without record": (
        "depth_mm = 6.0",
        "depth_mm = 6.0\nfitted = true",
        r"sites\.2: a fitted site needs a trace",
    ),
    "missing record": ('trace = "1.csv"', 'trace = "9.csv"', r"sites\.1\.trace: 9\.csv does not exist"),
    "missing bone": (
        'tibia = "tibia.stl"',
        'tibia = "t.stl"',
        r"surfaces\.bones\.tibia: t\.stl does not exist",
    ),
    "missing markers": (
        SURFACES,
        '[image]\npath = "mri"\nmarkers = "m"\n',
        r"markers: m does not exist",
    ),
    "missing labels": (
        SURFACES,
        '[image]\npath = "mri"\n[segmentation]\nlabels = "l.seg.nrrd"\n',
        r"segmentation\.labels: l\.seg\.nrrd does not exist",
    ),
    "an image that holds the results": (
        SURFACES,
        '[image]\npath = "."\n',
        r"image\.path: \. holds the results of the study, and so changes with every run; give",
    ),
}
LAYERS = (
    '[geometry]\nlayers = [{ name = "skin", thickness_mm = 1.5 }, { name = "fat", thickness_mm = 4.0 }]\n'
)
# what to add to the good study, and what the refusal says; a table of a list is named, not numbered
ADDED_FAULTS = {
    "one record in one bracket": (
        '[records]\nsite = "1"\nname = "b"\ntrace = "1.csv"',
        r"records: one table, .* two brackets: \[\[records\]\]",
    ),
    "a wrong key of a record": (
        '[[records]]\nsite = "1"\nname = "slow"\ntrace = "1.csv"\nspeed_mm_s = 0',
        r"records\.1-slow\.speed_mm_s: ",
    ),
    "no friction": ('[indenter]\nfriction = "rough"', r"indenter\.friction: 'rough' is not .*0 on$"),
    "negative friction": ("[indenter]\nfriction = -0.3", r"indenter\.friction: -0\.3 is not"),
    "wide rounding": ("[indenter]\nedge_radius_mm = 10", r"indenter: edge_radius_mm must be smaller"),
    "two doors": ('[image]\npath = "mri"', r"either \[image\] or \[surfaces\]"),
    "start out of bounds": (
        "[material]\nstart = { c_kPa = 50, m = 3, gamma = 1, tau_s = 1 }",
        r"material: start\.c_kPa lies outside its bounds",
    ),
    "no thickness": (LAYERS.replace("1.5", "0"), r"geometry\.layers\.skin\.thickness_mm: "),
    "layers and a layer": (LAYERS + "skin_layer_mm = 3.0", "either skin_layer_mm or layers"),
    "a core as a layer": (LAYERS + 'core = "fat"', "different names"),
    "no name of a core": (LAYERS + 'core = "two words"', r"geometry\.core"),
    "a map without an image": (
        LAYERS.replace("thickness_mm = 4.0", 'thickness = "map"'),
        r"needs the fat of an \[image\]",
    ),
    "a map and a thickness": (
        LAYERS.replace("thickness_mm = 4.0", 'thickness_mm = 4.0, thickness = "map"'),
        "either thickness_mm or thickness",
    ),
}


@pytest.mark.parametrize("fault", [*FAULTS, *ADDED_FAULTS])
def test_refusals_name_file_key_and_fault(folder: Path, fault: str) -> None:
    if fault in FAULTS:
        old, new, expected = FAULTS[fault]
        assert GOOD.count(old) == 1
        wrong = GOOD.replace(old, new)
    else:
        added, expected = ADDED_FAULTS[fault]
        wrong = f"{GOOD}{added}\n"
    text = refusal(write(folder, wrong))
    assert text.startswith(f"{folder / 'study.toml'}: ")
    assert re.search(expected, text), text


@pytest.mark.parametrize("begin", ["", "sites = []\n"])
def test_a_study_without_sites_is_read_and_goes_as_far_as_its_surfaces(folder: Path, begin: str) -> None:
    study = load_study(write(folder, begin + GOOD[: GOOD.index("[[sites]]")]))
    for refused in (study.refuse_no_site, lambda: study.site("1"), lambda: study.indentation("1")):
        with pytest.raises(StudyError, match=r"sites: the study has no site yet; add \[\[sites\]\]"):
            refused()


def test_tissues_are_the_layers_and_the_core(folder: Path) -> None:
    assert load_study(write(folder, GOOD)).tissues == ("skin", "muscle")
    assert load_study(write(folder, GOOD + LAYERS)).tissues == ("skin", "fat", "muscle")
    assert load_study(write(folder, GOOD + LAYERS + 'core = "soft"\n')).tissues == ("skin", "fat", "soft")
