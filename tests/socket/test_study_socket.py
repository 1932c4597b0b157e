"""The table [socket] of a study: its shape, regions and loads, and what is wrong told by key."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from socket_limbs import CUT_NORMAL, round_limb

from limbfit.anatomy.surfaces.files import write_surface
from limbfit.anatomy.surfaces.surfaces import Anatomy
from limbfit.anatomy.surfaces.triangles import Surface
from limbfit.errors import StudyError
from limbfit.mesh import Mesh
from limbfit.pipeline.commands.check import check_study
from limbfit.pipeline.commands.planning import choose_tissues
from limbfit.pipeline.commands.run import run_experiment
from limbfit.pipeline.socket.shape import (
    build_loadable_socket,
    build_regions,
    build_socket,
    find_covered_regions,
    load_of,
    trim_of,
)
from limbfit.pipeline.socket.simulation import SocketLimb, SocketRun
from limbfit.priors import of_tissues
from limbfit.socket import Socket
from limbfit.socket.landmarks import find_knee_centre
from limbfit.study import Study, load_study

AREA = '[[socket.areas]]\nname = "a"\nradius_mm = 20\ndepth_mm = 4\n'
SITE = '[[sites]]\nname = "1"\ndepth_mm = 5\nposition = [0.0, -46.0, 80.0]\n'


def study_of(folder: Path, text: str = "", bones: bool = True) -> Study:
    limb = round_limb()
    write_surface(folder / "skin.stl", limb.skin)
    named = ""
    if bones:
        for name, surface in limb.bones.items():
            write_surface(folder / f"{name}.stl", surface)
            named += f'{name} = "{name}.stl"\n'
    head = f'[study]\nname = "s"\n[surfaces]\nskin = "skin.stl"\n[surfaces.bones]\n{named}{SITE}'
    (folder / "study.toml").write_text(head + text)
    return load_study(folder)


def drawn(study: Study) -> Socket:
    return build_socket(study, round_limb(), round_limb().skin)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Socket]:
    """The study without a table, and its socket."""
    study = study_of(tmp_path_factory.mktemp("plain"))
    return study, drawn(study)


def test_a_study_without_the_table_has_a_socket(plain: tuple[Study, Socket]) -> None:
    study, socket = plain
    assert "socket" not in study.model_fields_set
    assert socket.points[socket.brim, 2].max() == pytest.approx(110.0, abs=1.5)  # 10 mm below the tibia
    assert (study.socket.donning_s, study.socket.hold_s) == (2.0, 10.0)
    assert [(load.name, load.duration_s, load.hold_s) for load in study.socket.loads] == [
        ("single stance", 1.0, 2.0)
    ]
    assert study.socket.liner.parameters == {"c_kPa": 100.0, "m": 2.0, "gamma": 0.1, "tau_s": 1.0}
    force, moment, point = load_of(study, study.socket.loads[0], round_limb(), socket)
    np.testing.assert_allclose(force, [0.0, 0.0, 800.0], atol=1e-9)
    np.testing.assert_allclose(moment, 0.0, atol=1e-9)
    np.testing.assert_allclose(point, find_knee_centre(round_limb()))


def test_the_table_says_the_shape(tmp_path: Path) -> None:
    text = "[socket]\nreduction_percent = 0\nflare_mm = 0\ntrim_mm = 25\ndistal = 'bearing'\n"
    area = '[[socket.areas]]\nname = "a"\nregion = "shin"\nradius_mm = 20\ndepth_mm = 4\n'
    region = '[[socket.regions]]\nname = "shin"\nposition = [0, -44, 60]\nradius_mm = 12\n'
    study = study_of(tmp_path, text + area + region)
    socket = drawn(study)
    assert socket.points[socket.brim, 2] == pytest.approx(95.0, abs=0.1)
    depth = socket.offset(round_limb().skin)
    deepest = socket.points[depth.argmax()]
    assert depth.max() == pytest.approx(4.0, rel=0.05)
    assert np.linalg.norm(deepest - [0.0, -42.0, 60.0]) < 6.0
    assert build_regions(study, round_limb())["shin"].faces.any()


def test_loads_of_ones_own(tmp_path: Path, plain: tuple[Study, Socket]) -> None:
    text = (
        '[[socket.loads]]\nname = "mine"\nforce_N = [0, 10, 500]\nmoment_Nmm = [1e4, 0, 0]\n'
        "point = [0, 0, 90]\n"
        '[[socket.loads]]\nname = "step"\npreset = "heel strike"\n[socket]\nbody_weight_N = 1000\n'
        "[socket.liner]\nmaterial = 'gel'\nm = 4\n"
    )
    study = study_of(tmp_path, text)
    force, moment, point = load_of(study, study.socket.loads[0], round_limb(), plain[1])
    assert force.tolist() == [0, 10, 500]
    assert moment.tolist() == [1e4, 0, 0]
    assert point.tolist() == [0, 0, 90]
    force, moment, _ = load_of(study, study.socket.loads[1], round_limb(), plain[1])
    np.testing.assert_allclose(force, [200.0, -200.0, 1100.0])  # medial is +x: the fibula lies at -x
    np.testing.assert_allclose(moment, np.cross([50.0, -50.0, 0.0], force))
    assert study.socket.liner.parameters == {"c_kPa": 40.0, "m": 4.0, "gamma": 0.3, "tau_s": 1.0}


def test_a_limb_without_a_tibia_is_loaded_through_its_middle_at_the_brim(tmp_path: Path) -> None:
    limb = round_limb()
    bare = replace(
        limb, bones={}, skin=Surface(limb.skin.points + np.array([7.0, -3.0, 0.0]), limb.skin.faces)
    )
    study = study_of(tmp_path, bones=False)
    own = study_of(tmp_path, '[[socket.loads]]\nname = "mine"\nforce_N = [0, 0, 800]\n', bones=False)
    socket = build_socket(study, bare, bare.skin)
    for load in (*study.socket.loads, *own.socket.loads):
        force, moment, point = load_of(study, load, bare, socket)
        np.testing.assert_allclose(force, [0.0, 0.0, 800.0], atol=1e-9)
        np.testing.assert_allclose(moment, 0.0, atol=1e-9)
        np.testing.assert_allclose(point, [7.0, -3.0, socket.points[socket.brim, 2].mean()], atol=0.1)
        assert point[2] == pytest.approx(120.0, abs=2.0)  # 30 mm below the cut, less what the flare takes
    assert not {name for name in build_regions(study, bare) if "tibia" in name or "knee" in name}


def test_check_draws_the_socket_of_a_limb_without_a_tibia_too(tmp_path: Path, commands_unasked: None) -> None:
    facts = check_study(study_of(tmp_path, "[socket]\nedge_mm = 12\n", bones=False))["facts"]
    told = "\n".join(fact for fact in facts if fact.startswith("socket: "))
    assert all(
        words in told for words in ("a liner of 6 mm", "meshed at 12 mm", "cm3", "mm outside the skin")
    )


LOAD = '[[socket.loads]]\nname = "x"\n'
DESIGN = "[[socket.design.regions]]\n"
AT = "position = [0, -44, 60]\n"
BAD = {  # what is said, the study, the remedy
    "unknown key": ("[socket]\nreduction = 3\n", "see docs/study.md"),
    "give either position (LPS, mm) or region": (AREA, ""),
    "no region is named 'knee cap'": (AREA + 'region = "knee cap"\n', "tibial crest"),
    "off the socket's face": (AREA + "position = [0, -90, 60]\n", "on the limb below the brim"),
    "steeper than 45 degrees": (AREA.replace("20", "4") + AT, "or less depth"),
    "beyond the limb's proximal cut": (
        "[socket]\ntrim_planes = [{ point = [0, 0, 160] }]\n",
        "move the trimline down",
    ),
    "trim_mm is a plane of its own": ("[socket]\ntrim_mm = 9\ntrim_planes = [{ point = [0, 0, 90] }]\n", ""),
    "trimline needs three points": ("[socket]\ntrimline = [[0, 0, 90]]\n", ""),
    "names must differ": ((AREA + AT) * 2, ""),
    "'donning' is a name of the results' own": (
        LOAD.replace("x", "donning") + "force_N = [0, 0, 9]\n",
        "give another",
    ),
    "'the limb' is a name of the results' own": (
        '[[socket.regions]]\nname = "the limb"\nposition = [0, -46, 80]\nradius_mm = 15\n',
        "give another",
    ),
    "give either preset": (LOAD, ""),
    "a preset has its own moment": (LOAD + 'preset = "toe-off"\nmoment_Nmm = [0, 0, 1]\n', ""),
    "give pressure_kPa, limit_kPa or both": (DESIGN + 'region = "tibial crest"\n', ""),
    "'tibial crest' is given twice": ((DESIGN + 'region = "tibial crest"\nlimit_kPa = 90\n') * 2, ""),
    "nowhere.stl does not exist": ('[socket]\nfile = "nowhere.stl"\n', ""),
}
BAD_WITHOUT_BONES = {
    "passes beside the knee centre, which is not known": (
        '[socket]\nside = "left"\n' + LOAD + 'preset = "toe-off"\n',
        "state point",
    ),
    "medial and lateral are not known": (
        LOAD + 'preset = "toe-off"\npoint = [0, 0, 120]\n',
        "socket.side",
    ),
}


@pytest.mark.parametrize("words", [*BAD, *BAD_WITHOUT_BONES])
def test_what_is_wrong_is_told_by_key(tmp_path: Path, words: str) -> None:
    text, remedy = {**BAD, **BAD_WITHOUT_BONES}[words]
    limb = round_limb() if words in BAD else replace(round_limb(), bones={})
    with pytest.raises(StudyError) as caught:
        build_loadable_socket(study_of(tmp_path, text, bones=words in BAD), limb, limb.skin)
    told = str(caught.value)
    assert words in told
    assert remedy in told
    assert "study.toml" in told
    assert "socket" in told
    assert "\n" not in told


def test_check_refuses_a_region_of_the_design_that_the_limb_has_not(tmp_path: Path) -> None:
    study = study_of(tmp_path, DESIGN + 'region = "heel"\nlimit_kPa = 90\n')
    with pytest.raises(StudyError, match=r"socket\.design\.regions: no region is named 'heel'.*tibial crest"):
        check_study(study)


def test_tissues_of_people_are_taken_though_they_know_nothing_of_another_tissue(tmp_path: Path) -> None:
    """Skin and muscle are people's; the band between them, and what nobody knows of any, starts as stated."""
    layers = '{ name = "skin", thickness_mm = 2 }, { name = "band", thickness_mm = 3 }'
    study = study_of(tmp_path, f"[geometry]\nlayers = [{layers}]\n")
    people, start = of_tissues(("skin", "muscle")), study.material.get("band", "start")
    found, origin = choose_tissues(study, literature=True)
    assert origin == "literature"
    assert found["band"] == start
    for tissue in ("skin", "muscle"):
        assert found[tissue]["c_kPa"] == people[f"{tissue}.c_kPa"][0] != start["c_kPa"]
        assert found[tissue]["tau_s"] == start["tau_s"]


def test_a_tissue_that_is_called_as_the_liner_is_refused(tmp_path: Path) -> None:
    """A limb that was scanned in its liner: it would become the silicone of the liner over it."""
    study = study_of(tmp_path, '[geometry]\nlayers = [{ name = "liner", thickness_mm = 3 }]\n')
    for experiment in ("socket", "socket_design"):
        with pytest.raises(
            StudyError, match=r"geometry: a tissue is named 'liner', .*; give it another name"
        ):
            run_experiment(study, experiment)


def cut_limb(height: float, above: float = 6.0) -> Anatomy:
    """The round limb cut at a height; its bones stick out of the cut by ``above`` mm, or end below it."""
    limb = round_limb()

    def cut(surface: Surface, top: float) -> Surface:
        return Surface(np.minimum(surface.points, [np.inf, np.inf, top]), surface.faces)

    bones = {name: cut(bone, height + above) for name, bone in limb.bones.items()}
    return Anatomy(cut(limb.skin, height), bones, np.array([0.0, 0.0, height]), CUT_NORMAL)


def test_a_shank_that_is_cut_below_the_knee_has_no_knee_centre_and_no_fibular_head(tmp_path: Path) -> None:
    limb, whole = cut_limb(100.0), cut_limb(100.0, above=-2.0)
    study = study_of(tmp_path, '[[socket.loads]]\nname = "x"\npreset = "toe-off"\n')
    stance = study_of(tmp_path, '[[socket.loads]]\nname = "x"\npreset = "single stance"\n')
    ((point, _),) = trim_of(stance, limb).planes
    assert point[2] == pytest.approx(70.0)  # 30 mm below the cut; it was 4 mm below it
    ((point, _),) = trim_of(stance, whole).planes
    assert point[2] == pytest.approx(88.0)  # 10 mm below the tibia's top
    socket = build_socket(stance, limb, limb.skin)
    assert load_of(stance, stance.socket.loads[0], limb, socket)[2][2] < 72.0  # at the brim
    with pytest.raises(StudyError, match="is not known: the proximal cut goes through the tibia"):
        load_of(study, study.socket.loads[0], limb, socket)
    assert load_of(study, study.socket.loads[0], whole, socket)[2] == pytest.approx(find_knee_centre(whole))
    assert "fibular head" in build_regions(study, whole)
    regions = build_regions(study, limb)
    assert "fibular head" not in regions
    assert {"tibial crest", "distal fibula", "medial middle"} <= regions.keys()


def test_what_is_kept_of_a_socket_follows_the_names_of_the_bones(plain: tuple[Study, Socket]) -> None:
    (study, socket), limb = plain, round_limb()
    mesh = build_mesh_under(limb.skin)
    keys = set()
    for names in (("tibia", "fibula"), ("shin", "fibula"), ("shin", "splint")):
        named = replace(limb, bones=dict(zip(names, limb.bones.values(), strict=True)))
        on = SocketLimb(study, named, named, None, build_regions(study, named), ())
        keys.add(SocketRun("", on.build_model(socket, mesh), {}).key)
    assert len(keys) == 3


def build_mesh_under(skin: Surface) -> Mesh:
    """A mesh of which only its outer faces are looked at."""
    cell = np.array([[0, 1, 2, 3]])
    return Mesh(skin.points, cell, "tet4", np.zeros(1, np.int64), ("skin",), {}, {"skin": skin.faces})


def test_a_region_smaller_than_the_faces_of_the_mesh_has_the_nearest_of_them(
    tmp_path: Path, plain: tuple[Study, Socket]
) -> None:
    text = '[[socket.regions]]\nname = "{}"\nposition = [0, -44, {}]\nradius_mm = 1\n'
    study = study_of(tmp_path, text.format("sore", 60) + text.format("above the brim", 135))
    regions, socket, skin = build_regions(study, round_limb()), plain[1], round_limb().skin
    angle, height = np.meshgrid(np.radians(np.arange(0.0, 360.0, 16.0)), np.arange(20.0, 150.0, 11.0))
    middles = np.stack([44.0 * np.cos(angle), 44.0 * np.sin(angle), height], axis=-1).reshape(-1, 3)
    found = find_covered_regions(middles, skin, regions, socket)
    far = np.linalg.norm(middles - regions["sore"].position, axis=1)
    assert np.flatnonzero(found["sore"]).tolist() == [far.argmin()]
    assert "above the brim" not in found


def test_a_trimline_may_end_with_its_first_point(tmp_path: Path) -> None:
    angle = np.radians(np.arange(0.0, 360.0, 45.0))
    line = np.column_stack([50.0 * np.cos(angle), 50.0 * np.sin(angle), 100.0 + 5.0 * np.cos(angle)])
    open_line, closed = (
        drawn(study_of(tmp_path, f"[socket]\nface_edge_mm = 8\ntrimline = {np.vstack(one).tolist()}\n"))
        for one in ([line], [line, line[:1]])
    )
    np.testing.assert_array_equal(open_line.points, closed.points)
