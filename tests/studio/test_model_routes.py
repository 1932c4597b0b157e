"""The view Model's server side: places that clicks give end in the study file, its comments stay."""

import json
import tomllib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import pyvista as pv
from serving_here import open_page

from completing import write_result
from editing import append, edit
from limbfit import load_study
from limbfit.mesh import Mesh, boundary_faces, measure_quality, write_vtu
from limbfit.results.limb import MeshResult
from limbfit.studio.editing import set_site
from limbfit.studio.folder import StudyFolder
from limbfit.studio.model_routes import read_anatomy
from unpacking import unpack


@pytest.fixture
def page(study):
    """The stump with comments in its file, as its page talks to it."""
    edit(study, 'name = "1"', 'name = "1"  # the first one\nregion = "lateral"')
    return open_page(study)


def skin_points(study, count):
    """Places on the wall of the stump, between its end and its cut."""
    skin = pv.read(study / "skin.stl")
    inside = skin.points[(skin.points[:, 2] > 0) & (skin.points[:, 2] < 100)]
    return inside[np.random.default_rng(3).choice(len(inside), count, replace=False)]


def test_the_scene_has_surfaces_and_every_site(page):
    scene = page.get("/api/model/scene").json()
    assert list(scene["surfaces"]) == ["skin", "tibia"]
    assert [site["name"] for site in scene["sites"]] == ["1", "2"]
    first = scene["sites"][0]
    assert first["fitted"]
    assert np.linalg.norm(np.subtract(first["position_mm"], [40.0, 0.0, 60.0])) < 5
    assert first["axis"][0] < -0.9  # into the limb
    assert scene["meshes"] == {}
    np.testing.assert_allclose(scene["frame"], np.eye(3), atol=1e-12)


def test_a_surface_is_sent_as_it_is(page, study):
    arrays, _ = unpack(page.get("/api/model/surface/skin").content)
    assert len(arrays["faces"]) == pv.read(study / "skin.stl").n_cells
    assert np.abs(arrays["points"][:, 2]).max() <= 120.01
    assert page.get("/api/model/surface/none").status_code == 422


def test_surfaces_are_read_again_only_where_they_or_what_is_said_of_them_changed(study):
    folder = StudyFolder(study / "study.toml")
    first = read_anatomy(folder, folder.load())
    assert read_anatomy(folder, folder.load()) is first
    text = folder.file.read_text()
    for name in ("skin.stl", "tibia.stl"):
        pv.read(study / name).save(study / name)  # without its unit
    folder.file.write_text(text.replace('"tibia.stl" }', '"tibia.stl" }\nunit = "cm"'))
    assert np.ptp(read_anatomy(folder, folder.load()).skin.points) == pytest.approx(
        10 * np.ptp(first.skin.points)
    )
    folder.file.write_text(text)
    skin = pv.read(study / "skin.stl")
    skin.points *= 1.1
    skin.save(study / "skin.stl")
    assert np.ptp(read_anatomy(folder, folder.load()).skin.points) > 1.05 * np.ptp(first.skin.points)


def test_a_click_becomes_a_site_of_the_study_within_a_millimetre(page, study):
    for i, point in enumerate(skin_points(study, 5)[:2]):
        name = f"new-{i}"
        body = {"name": name, "position": point.tolist(), "region": 'medial "<b>"', "depth_mm": 6.5}
        scene = page.post("/api/model/sites", json=body).json()
        assert scene["sites"][-1]["name"] == name
        site = load_study(study).site(name)
        assert np.linalg.norm(np.array(site.position) - point) < 1.0
        assert np.linalg.norm(np.array(scene["sites"][-1]["position_mm"]) - point) < 1.0
        assert site.region == 'medial "<b>"'
        assert site.depth_mm == 6.5
    assert "# the first one" in (study / "study.toml").read_text()


def test_the_records_of_a_site_follow_its_new_name(page, study):
    more = '[[records]]\nsite = "{}"\nname = "slow"  # by hand\ntrace = "2.csv"\n'
    append(study, more.format("2") + more.format("1"))
    assert page.post("/api/model/sites/2", json={"name": "heel"}).status_code == 200
    assert [record.name for record in load_study(study).recorded] == ["1", "1-slow", "heel", "heel-slow"]
    assert (study / "study.toml").read_text().count('name = "slow"  # by hand') == 2


def test_a_site_is_moved_named_and_switched(page, study):
    (point,) = skin_points(study, 1)
    assert page.post("/api/model/sites/2", json={"position": point.tolist()}).status_code == 200
    assert page.post("/api/model/sites/2", json={"name": "heel", "region": "distal"}).status_code == 200
    assert page.post("/api/model/sites/heel", json={"fitted": True}).status_code == 200
    site = load_study(study).site("heel")
    assert np.linalg.norm(np.array(site.position) - point) < 1.0
    assert (site.region, site.fitted, str(site.trace)) == ("distal", True, "2.csv")
    assert page.post("/api/model/sites/heel/remove").status_code == 200
    assert [site.name for site in load_study(study).sites] == ["1"]
    assert "# the first one" in (study / "study.toml").read_text()


def test_changes_that_come_at_once_are_all_stored(study):
    file, regions = study / "study.toml", [f"region {i}" for i in range(12)]
    for i in range(12):
        append(study, f'[[sites]]\nname = "s{i}"\nposition = [40, {i}, 60]\ndepth_mm = 4\n')
    with ThreadPoolExecutor(12) as threads:
        list(threads.map(lambda i: set_site(file, f"s{i}", {"region": regions[i]}), range(12)))
    assert [load_study(study).site(f"s{i}").region for i in range(12)] == regions


def test_a_site_is_added_to_a_list_of_one_line_tables(page, study):
    file = study / "study.toml"
    head, first, second = file.read_text().split("[[sites]]\n")
    rows = [", ".join(row.strip().replace("  # the first one", "").split("\n")) for row in (first, second)]
    file.write_text("sites = [\n  " + ",\n  ".join(f"{{ {row} }}" for row in rows) + ",\n]  # all\n" + head)
    (point,) = skin_points(study, 1)
    site = {"name": "a", "position": point.tolist(), "depth_mm": 5}
    assert page.post("/api/model/sites", json=site).status_code == 200
    assert [site.name for site in load_study(study, recorded=False).sites] == ["1", "2", "a"]
    assert "]  # all" in file.read_text()


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        ("sites", {"name": "a", "position": [500, 0, 0], "depth_mm": 5}, "off the skin"),
        ("sites", {"name": "../a", "position": [42, 0, 60], "depth_mm": 5}, "name"),
        ("sites", {"name": "<script>", "position": [42, 0, 60], "depth_mm": 5}, "name"),
        ("sites", {"name": "1", "position": [42, 0, 60], "depth_mm": 5}, "name"),
        ("sites", {"name": "a", "position": [42, 0], "depth_mm": 5}, "position"),
        ("sites", {"name": "a", "position": [42, 0, None], "depth_mm": 5}, "position"),
        ("sites", {"name": "a", "position": [42, 0, 60], "depth_mm": -5}, "depth_mm"),
        ("sites", {"name": "a", "position": [42, 0, 60], "depth_mm": 5, "trace": "/etc/passwd"}, "trace"),
        ("sites/9", {"fitted": True}, "9"),
        ("sites/1", {"name": "2"}, "2"),
        ("sites/..%2f..%2fetc", {"fitted": True}, ""),
    ],
)
def test_what_the_study_refuses_leaves_its_file_alone(page, study, path, body, words):
    before = (study / "study.toml").read_bytes()
    answer = page.post(f"/api/model/{path}", json=body)
    assert 400 <= answer.status_code < 500
    assert words in answer.text
    assert "Traceback" not in answer.text
    assert (study / "study.toml").read_bytes() == before


def test_a_site_with_a_place_from_markups_stays_where_it_is(page, study):
    point = skin_points(study, 1)[0].tolist()
    markups = {"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [
        {"label": "2", "position": point}]}]}  # fmt: skip
    (study / "places.mrk.json").write_text(json.dumps(markups))
    edit(study, "position = [0.0, 40.0, 50.0]\n", "")
    append(study, '\n[markups]\nfile = "places.mrk.json"\n')
    answer = page.post("/api/model/sites/2", json={"position": [0.0, 40.0, 50.0]})
    assert answer.status_code == 422
    assert "markups file" in answer.json()["error"]
    assert "position" not in tomllib.loads((study / "study.toml").read_text())["sites"][1]


def _meshed(study) -> Mesh:
    """A block of tetrahedra as the mesh of site 1."""
    grid = pv.ImageData(dimensions=(4, 4, 4), spacing=(3, 3, 3)).to_tetrahedra(5)
    layer = grid.cell_centers().points[:, 2] < 6
    mesh = Mesh.from_arrays(grid.points, grid.cells_dict[10], layer.astype(int), {0: "skin", 1: "muscle"})
    write_result(study / "results", MeshResult, {"sites": {"1": {"min_dihedral_deg": 54.7}}})
    write_vtu(mesh, study / "results" / "mesh" / "1.vtu")
    return mesh


def test_a_mesh_is_sent_with_the_quality_of_its_cells(page, study):
    mesh = _meshed(study)
    scene = page.get("/api/model/scene").json()
    assert list(scene["meshes"]) == ["1"]
    write_vtu(mesh, study / "results" / "mesh" / "1.vtu")
    assert page.get("/api/model/scene").json()["meshes"] != scene["meshes"]  # made anew: to be read again
    assert scene["quality"]["1"]["min_dihedral_deg"] == 54.7
    arrays, facts = unpack(page.get("/api/model/mesh/1").content)
    assert facts["regions"] == ["skin", "muscle"]
    assert arrays["min_dihedral_deg"].min() == pytest.approx(measure_quality(mesh).min_dihedral_deg, rel=1e-5)
    assert (arrays["neighbours"] < 0).sum() == len(boundary_faces(mesh))
    layer, _ = unpack(page.get("/api/model/layer/1/skin").content)
    np.testing.assert_allclose(layer["points"][:, 2], 6.0)
    assert page.get("/api/model/mesh/2").status_code == 404
    assert page.get("/api/model/layer/1/muscle").status_code == 422
