"""The phantom's folder: a study that loads, records that read, a truth that agrees, nothing half made.

The quick tests put a closed-form force in the place of the simulation; the slow one simulates.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_phantoms import VOXELS, cubic_law, few_voxels

from limbfit import run_study
from limbfit.anatomy.imaging import read_labels
from limbfit.anatomy.surfaces.surfaces import load_anatomy
from limbfit.errors import InputError, SiteError
from limbfit.laws import LAWS
from limbfit.phantom import draw_true_parameters, make_limb, make_phantom
from limbfit.phantom.geometry import build_true_anatomy
from limbfit.phantom.mri import DETAIL_GRIDS, build_true_labels, make_grid
from limbfit.phantom.robot import DETAIL_SITES, FITTED, simulate_true_force
from limbfit.study import load_study
from limbfit.traces import read_surface_motion


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("phantom") / "study"
    steps = []
    with few_voxels():
        truth = make_phantom(folder, seed=2, mapping=cubic_law, progress=lambda *step: steps.append(step))
    assert {text for text, _, _ in steps} == {"image", "meshes", "forces"}
    assert all(0 <= done <= total for _, done, total in steps)
    return folder, truth


def test_the_study_loads_and_names_what_is_there(made) -> None:
    folder, truth = made
    study = load_study(folder)
    assert [site.name for site in study.sites] == sorted(DETAIL_SITES["coarse"])
    assert [site.name for site in study.fitted] == list(FITTED)
    for site, true in zip(study.sites, truth["sites"], strict=True):
        assert site.region == true["region"]
        assert 2.9 < np.linalg.norm(np.array(site.near) - true["position_mm"]) < 5.1
        assert site.position is None
        assert site.axis is None


def test_truth_is_stored_and_complete(made) -> None:
    folder, truth = made
    assert json.loads((folder / "truth.json").read_text()) == truth
    assert tuple(truth["parameters"]) == load_study(folder).tissues
    assert all(list(values) == list(LAWS["ogden"].keys) for values in truth["parameters"].values())
    assert len(truth["markers"]) == 18
    anatomy = load_anatomy(folder / "truth")
    limb = make_limb(2)
    np.testing.assert_allclose(anatomy.cut_point, limb.to_patient(np.array([0, 0, 250.0])), atol=1e-6)


def test_records_hold_the_force_that_was_simulated(made) -> None:
    folder, truth = made
    for site in truth["sites"]:
        table = np.loadtxt(folder / "traces" / f"site-{site['name']}.csv", delimiter=",", skiprows=1)
        depth = np.interp(
            table[:, 0],
            site["touch_down_s"] + np.array([0, site["depth_mm"], 2 * site["depth_mm"]]) / site["speed_mm_s"],
            [0, site["depth_mm"], 0],
        )
        loading = table[:, 0] < site["touch_down_s"] + site["depth_mm"] / site["speed_mm_s"]
        residual = table[loading, 2] - 0.02 * depth[loading] ** 3
        assert residual.std() < 0.06
        assert abs(residual.mean()) < 0.01
        assert site["peak_force_N"] == pytest.approx(0.02 * site["depth_mm"] ** 3, rel=1e-3)


def test_one_patient_two_series(made) -> None:
    folder, _ = made
    plain, marked = (sorted((folder / "mri" / name).glob("*.dcm")) for name in ("plain", "markers"))
    assert len(plain) == len(marked) == VOXELS[0][0]


def test_another_seed_is_another_patient() -> None:
    assert draw_true_parameters(1) == draw_true_parameters(1)
    assert draw_true_parameters(1) != draw_true_parameters(2)
    for seed in range(5):
        parameters = draw_true_parameters(seed)
        assert 6.3 < parameters["skin"]["c_kPa"] < 8.7
        assert 3.8 < parameters["muscle"]["c_kPa"] < 5.2


def test_a_limb_with_fat_has_three_tissues_and_is_the_same_otherwise(tmp_path, made) -> None:
    jobs = {}

    def kept(function, given):
        jobs[function] = list(given)
        return cubic_law(function, jobs[function])

    with few_voxels():
        truth = make_phantom(tmp_path / "study", seed=2, sites=["05"], fat=True, mapping=kept)
    study = load_study(tmp_path / "study")
    assert study.tissues == tuple(truth["parameters"]) == ("skin", "fat", "muscle")
    _, plain = made
    assert truth["limb"] == plain["limb"]
    assert truth["parameters"]["muscle"] == plain["parameters"]["muscle"]
    assert truth["parameters"]["fat"]["c_kPa"] < truth["parameters"]["muscle"]["c_kPa"]
    assert jobs[simulate_true_force][0].parameters == truth["parameters"]
    (mesh,) = jobs.keys() - {simulate_true_force}
    meshed = mesh.keywords["settings"].layers
    assert [layer.name for layer in meshed] == ["skin", "fat"]
    assert [layer.thickness_mm for layer in meshed] == [layer.thickness_mm for layer in study.geometry.layers]


def test_a_failure_leaves_nothing_behind(tmp_path) -> None:
    def breaks(function, jobs):
        yield from cubic_law(function, list(jobs)[:1])
        raise OSError("disk full")

    with few_voxels(), pytest.raises(OSError, match="disk full"):
        make_phantom(tmp_path / "study", mapping=breaks, sites=["01", "15"])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"detail": "fine"}, InputError, "unknown detail 'fine'"),
        ({"sites": ["99"]}, SiteError, "no site '99'"),
        ({"limb": "forearm"}, InputError, "unknown limb 'forearm'"),
        ({"limb": "transfemoral", "tendon": True}, InputError, "no patellar tendon"),
    ],
)
def test_impossible_wishes_are_refused(tmp_path, keywords, error, message) -> None:
    with pytest.raises(error, match=message):
        make_phantom(tmp_path / "study", mapping=cubic_law, **keywords)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_simulated_forces_are_those_of_soft_tissue(tmp_path) -> None:
    truth = make_phantom(tmp_path / "study", sites=["05", "15"])
    tibia, posterior = truth["sites"]
    assert tibia["peak_force_N"] > 1.0
    assert posterior["peak_force_N"] > 1.0
    stiffness = [site["peak_force_N"] / site["depth_mm"] for site in (tibia, posterior)]
    assert stiffness[0] > 1.5 * stiffness[1]  # thin tissue over bone is stiffer
    assert all(site["simulation"]["element"] == "tet10g8p0" for site in truth["sites"])


@pytest.fixture(scope="module")
def with_tendon(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("phantom") / "tendon"
    with few_voxels():
        make_phantom(folder, sites=["01"], tendon=True, surface=True, mapping=cubic_law)
    return folder


def test_a_tendon_is_a_tissue_of_the_study_and_a_label_of_its_map(with_tendon: Path) -> None:
    study = load_study(with_tendon)
    assert study.tissues == ("skin", "tendon", "muscle")
    truth = json.loads((with_tendon / "truth.json").read_text())["parameters"]
    assert truth["tendon"]["c_kPa"] > 4.0 * truth["muscle"]["c_kPa"]
    assert truth["tendon"] | {"c_kPa": 0} == truth["muscle"] | {"c_kPa": 0}
    for name, _ in study.parameters:
        lower, upper = (study.material.get(name, end)["c_kPa"] for end in ("lower", "upper"))
        assert lower < truth[name]["c_kPa"] < upper
    labels = read_labels(study.path(study.segmentation.labels))
    assert labels.mask("patellar tendon").any()
    assert labels.array.shape == VOXELS[0]


def test_a_drawn_tendon_has_the_volume_of_its_surface() -> None:
    limb = make_limb(0, tendon=True)
    whole = make_grid(limb, "coarse", 0)
    spacing = np.array(DETAIL_GRIDS["coarse"][1])
    low = np.floor((limb.shape.datum - 45.0) / spacing[2]).astype(int)
    part = replace(whole, shape=(40, 76, 76), origin=whole.origin + low * spacing[2] * whole.direction[:, 2])
    labels = build_true_labels(limb, part)
    drawn = float(labels.mask("patellar tendon").sum()) * labels.voxel_mm3
    assert drawn == pytest.approx(build_true_anatomy(limb, 4.0).regions["tendon"].volume, rel=0.05)


@pytest.mark.slow
def test_the_mesh_of_a_limb_with_a_tendon_has_it(tmp_path: Path) -> None:
    make_phantom(tmp_path / "study", sites=["01"], tendon=True, mapping=cubic_law)
    study = load_study(tmp_path / "study")
    run_study(study, until="mesh")
    facts = json.loads((study.results / "mesh" / "mesh.json").read_text())["sites"]["01"]
    true = load_anatomy(tmp_path / "study" / "truth").regions["tendon"].volume
    assert facts["region_volumes_mm3"]["tendon"] == pytest.approx(true, rel=0.05)
    assert facts["regions"]["tendon"]["mean_mm"] < 0.5
    assert facts["min_dihedral_deg"] > 5.0


def test_a_surface_is_named_by_the_study_and_holds_the_true_moves(with_tendon: Path) -> None:
    study = load_study(with_tendon)
    (site,) = json.loads((with_tendon / "truth.json").read_text())["sites"]
    (record,) = study.recorded
    assert record.ultrasound is None
    seen = read_surface_motion(study.path(record.surface), "time_s")
    assert len(seen.points) == 2
    assert np.diff(seen.time_s) == pytest.approx(0.2, abs=1e-3)
    peak = site["depth_mm"] / site["speed_mm_s"]
    depth = np.interp(seen.time_s - site["touch_down_s"], [0.0, peak, 2 * peak], [0.0, site["depth_mm"], 0.0])
    far = np.linalg.norm(seen.points - site["position_mm"], axis=1) > 18.0
    share = np.where(far, 0.1, 0.5)
    off = seen.moved_mm - np.einsum("f,k,i->fki", depth, share, site["axis"])
    assert off.std() == pytest.approx(0.05, rel=0.15)
    assert abs(off.mean()) < 0.02
