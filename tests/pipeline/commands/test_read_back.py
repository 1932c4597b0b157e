"""What limbfit writes into its results is the input of another study, and gives the same limb and records.

Meshes, exports and sockets come back in tests/mesh, tests/febio and tests/socket.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import write_trace
from limbfit import check_study, load_study, run_study
from limbfit.anatomy.imaging import LabelMap, read_labels, write_labels, write_volume
from limbfit.anatomy.surfaces.surfaces import Surface, load_anatomy, write_surface
from limbfit.errors import SurfaceError
from limbfit.pipeline.records.traces import read_record
from limbfit.traces import read_trace
from limbs import leg_image, rotation

IMAGE = """
[image]
path = "image.nii.gz"
[segmentation]
labels = "given.seg.nrrd"
"""
GEOMETRY = """
[geometry]
{edge}regions = [{{ name = "scar", {region} }}]
"""
SCAR = 'surface = "{}/surfaces/region-scar.stl"'
SITE = """
[[sites]]
name = "1"
fitted = true
trace = "{trace}"
position = {position}
"""


def with_scar(labels: LabelMap) -> LabelMap:
    """A ball beside the tibia."""
    middle = np.argwhere(labels.mask("tibia"))[:, ::-1].mean(axis=0)
    points = np.argwhere(labels.array == labels.soft_value)
    away = np.linalg.norm((points[:, ::-1] - middle) * labels.spacing - [22.0, 0.0, 0.0], axis=1)
    array = labels.array.copy()
    array[tuple(points[away < 7.0].T)] = 9
    return replace(labels, array=array, names={**labels.names, 9: "scar"})


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A study of an oblique image, run until its sites."""
    folder = tmp_path_factory.mktemp("first")
    image, labels = leg_image([4.0, 4.0, 5.0], (32, 32, 32), rotation(1))
    write_volume(folder / "image.nii.gz", image)
    write_labels(folder / "given.seg.nrrd", with_scar(labels))
    write_trace(folder / "1.csv", rate=20.0)
    row = np.flatnonzero(labels.array[16, 16])
    position = labels.index_to_point(np.array([row[0], 16, 16]) - [0.5, 0, 0]).tolist()
    text = (
        '[study]\nname = "first"\n'
        + IMAGE
        + GEOMETRY.format(region='label = "scar"', edge="surface_edge_mm = 8.0\n")
    )
    (folder / "study.toml").write_text(text + SITE.format(trace="1.csv", position=position))
    study = load_study(folder)
    run_study(study, until="traces")
    return study, position


def second(
    folder: Path, first, inputs: str, region: str = 'label = "scar"', trace: str = "1.csv", cut: str = ""
):
    study, position = first
    shutil.copy(study.path("1.csv"), folder / "1.csv")
    text = '[study]\nname = "second"\n' + inputs + GEOMETRY.format(region=region, edge="")
    text += f"proximal_cut = {cut}\n" if cut else ""
    (folder / "study.toml").write_text(text + SITE.format(trace=trace, position=position))
    return load_study(folder)


def surfaces_of(results: Path) -> str:
    bones = ", ".join(f'{name} = "{results}/surfaces/bone-{name}.stl"' for name in ("tibia", "fibula"))
    return f'[surfaces]\nskin = "{results}/surfaces/skin.stl"\nbones = {{ {bones} }}\n'


def sites_of(results: Path) -> dict:
    return json.loads((results / "sites" / "sites.json").read_text())["sites"][0]


def test_its_surfaces_are_the_surfaces_of_another_study(tmp_path, first, commands_unasked):
    """Bones stick out of the skin's flat end, which is no coordinate plane: it is the cut."""
    results = first[0].results
    study = second(tmp_path, first, surfaces_of(results), SCAR.format(results))
    told = check_study(study)["facts"]
    assert sum("the proximal cut is its flat end at" in fact for fact in told) == 1
    run_study(study, until="sites")
    before, after = load_anatomy(results / "surfaces"), load_anatomy(study.results / "surfaces")
    assert after.cut_normal == pytest.approx(before.cut_normal, abs=1e-6)
    assert abs(before.height(after.cut_point)) < 1e-3
    named = [{"skin": one.skin, **one.bones, **one.regions} for one in (before, after)]
    assert set(named[0]) == set(named[1]) == {"skin", "tibia", "fibula", "scar"}
    for old, new in ((named[0][name], named[1][name]) for name in named[0]):
        assert np.array_equal(old.points, new.points)
        assert np.array_equal(old.faces, new.faces)
    assert sites_of(study.results)["position_mm"] == pytest.approx(sites_of(results)["position_mm"], abs=1e-6)


def test_a_bone_that_reaches_out_where_no_end_is_flat_names_the_key(tmp_path, first, commands_unasked):
    results = first[0].results
    limb = load_anatomy(results / "surfaces")
    cap = np.abs(limb.height(limb.skin.points)) < 1e-3
    bulge = np.where(cap, 0.2 * np.random.default_rng(0).random(len(cap)), 0.0)
    rough = Surface(limb.skin.points + bulge[:, None] * limb.cut_normal, limb.skin.faces)
    write_surface(tmp_path / "skin.stl", rough)
    text = surfaces_of(results).replace(f"{results}/surfaces/skin.stl", "skin.stl")
    with pytest.raises(
        SurfaceError, match=r"all at one end of the limb; .* say where: geometry\.proximal_cut"
    ):
        check_study(second(tmp_path, first, text, SCAR.format(results)))
    cut = f"{{ point = {limb.cut_point.tolist()}, normal = {limb.cut_normal.tolist()} }}"
    study = second(tmp_path, first, text, SCAR.format(results), cut=cut)
    check_study(study)


@pytest.mark.parametrize(("key", "file"), [("labels", "labels.seg.nrrd"), ("contours", "contours.csv")])
def test_its_labels_and_contours_are_those_of_another_study(tmp_path, first, key, file):
    results = first[0].results
    shutil.copy(first[0].path("image.nii.gz"), tmp_path)
    text = IMAGE.replace('labels = "given.seg.nrrd"', f'{key} = "{results}/segment/{file}"')
    study = second(tmp_path, first, text)
    run_study(study, until="segment")
    before, after = (read_labels(of / "segment" / "labels.seg.nrrd") for of in (results, study.results))
    assert (
        {"soft tissue", "tibia", "fibula", "scar"} <= set(after.names.values()) <= set(before.names.values())
    )
    for name in after.names.values():
        assert np.array_equal(after.mask(name), before.mask(name)), name


def test_its_records_are_those_of_another_study(tmp_path, first):
    results = first[0].results
    raw = results / "traces" / "1-raw.csv"
    study = second(tmp_path, first, surfaces_of(results), SCAR.format(results), trace=str(raw))
    before = json.loads((results / "traces" / "traces.json").read_text())["sites"]["1"]
    after = read_record(study, study.recorded[0])[2].to_plain()
    assert len(read_trace(raw).time_s) == len(read_trace(first[0].path("1.csv")).time_s)
    for key in ("touch_down_s", "touch_down_mm", "peak_s", "peak_force_N", "depth_mm", "noise_N"):
        assert after[key] == pytest.approx(before[key], rel=1e-5), key
    assert after["remarks"] == []
