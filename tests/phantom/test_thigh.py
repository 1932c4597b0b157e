"""The transfemoral phantom: a thigh by its sizes, segmented as it is, from the folder to the report."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_phantoms import cubic_law, few_voxels

from limbfit import run_study
from limbfit.anatomy.imaging import write_labels
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface
from limbfit.errors import StudyError
from limbfit.phantom import Limb, build_true_sites, make_limb, make_phantom
from limbfit.phantom.build import LINER_MM, Area, make_socket
from limbfit.phantom.geometry import build_outer_surface, build_true_anatomy
from limbfit.phantom.mri import LABELS_FILE, build_true_labels, make_grid
from limbfit.phantom.robot import DETAIL_SITES, SAFE_SHARE, choose_discretisation
from limbfit.pipeline.commands.check import check_study
from limbfit.pipeline.socket.shape import build_regions, load_of
from limbfit.socket import Socket
from limbfit.study import load_study
from scanned import build_image

THIGH = "transfemoral"


def thigh(seed: int) -> Limb:
    return make_limb(seed, kind=THIGH)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_its_sizes_are_those_of_a_thigh_and_its_sites_lie_deep_over_the_femur(seed: int) -> None:
    limb = thigh(seed)
    anatomy = build_true_anatomy(limb, 6.0)
    assert list(anatomy.bones) == ["femur"]
    assert 1.9 < anatomy.skin.volume / 1e6 < 3.5  # litres
    femur = anatomy.bones["femur"].points
    assert anatomy.height(femur).max() == pytest.approx(6.0, abs=1e-6)  # out of the cut
    assert 30.0 < limb.to_limb(femur)[:, 2].min() < 50.0  # padded by muscle
    assert limb.skin(femur[anatomy.height(femur) < 0.0]).max() < -25.0
    sites = build_true_sites(limb, seed)
    assert all(site.thickness > 20.0 and site.depth <= SAFE_SHARE * site.thickness for site in sites)
    positions = np.array([site.position for site in sites])
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    assert apart[~np.eye(len(sites), dtype=bool)].min() > 25.0
    outward = {name: -np.mean([s.axis for s in sites if s.region == name], axis=0) for name in regions(sites)}
    sides = outward["anterior"], -outward["posterior"], outward["medial"], -outward["lateral"]
    for side, direction in zip(sides, np.repeat([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]], 2, axis=0), strict=True):
        assert side @ (limb.rotation @ direction) > 0.8


def regions(sites) -> set[str]:
    return {site.region for site in sites}


def test_the_default_segmentation_finds_its_femur_and_calls_it_no_tibia() -> None:
    """In slices of 6 mm of the distal 144 mm, where the femur ends."""
    limb = thigh(0)
    grid = make_grid(limb, "coarse", 0)
    grid = replace(grid, shape=(24, 76, 76), spacing=(*grid.spacing[:2], 6.0))
    labels = segment(build_image(limb, grid, seed=0), bias_correction=False)
    assert labels.bone_names == ("bone-1",)
    points = grid.points(*(slice(0, size) for size in grid.shape))
    bone, whole = limb.bone("femur", points) < 0, limb.skin(points) < 0
    for mask, true in ((labels.mask("bone-1"), bone), (labels.array > 0, whole)):
        assert 2.0 * (mask & true).sum() / (mask.sum() + true.sum()) > 0.98  # Dice


@pytest.fixture(scope="module")
def rectified() -> tuple[Anatomy, Surface, Socket, list[Area]]:
    """The limb, its liner, and its socket with the areas of that."""
    anatomy, liner = build_true_anatomy(thigh(0), 8.0), build_outer_surface(thigh(0), LINER_MM, 8.0)
    return anatomy, liner, *make_socket(anatomy, liner, THIGH)


def test_its_socket_presses_in_where_it_says(rectified) -> None:
    anatomy, liner, socket, areas = rectified
    assert -40.0 < anatomy.height(socket.points[socket.brim]).mean() < -25.0
    depth = socket.offset(liner)
    for area in areas:
        near = np.linalg.norm(socket.points - area.position, axis=1).argmin()
        assert depth[near] == pytest.approx(area.depth_mm + 1.8, abs=1.2)  # and 3 % of some 60 mm


def test_its_study_needs_no_tibia(tmp_path: Path, rectified) -> None:
    with few_voxels():
        truth = make_phantom(tmp_path / "study", limb=THIGH, socket=True, sites=["05"], mapping=cubic_law)
        labels = build_true_labels(thigh(0), make_grid(thigh(0), "coarse", 0))
    assert truth["limb"]["kind"] == THIGH
    assert "tibia" not in json.dumps(truth)
    assert "transfemoral residuum" in (tmp_path / "study" / "study.toml").read_text()
    study = load_study(tmp_path / "study")
    assert study.socket.side == "right"
    anatomy, _, socket, _ = rectified
    names = set(build_regions(study, anatomy))
    assert {"anterior proximal", "medial distal", "lateral middle"} <= names
    assert not {name for name in names if "tibia" in name or "patella" in name}
    force, moment, point = load_of(study, study.socket.loads[0], anatomy, socket)
    assert force == pytest.approx(800.0 * anatomy.cut_normal)
    assert not moment.any()
    assert point == pytest.approx(socket.points[socket.brim].mean(axis=0), abs=5.0)
    (tmp_path / "study" / LABELS_FILE.parent).mkdir()
    write_labels(tmp_path / "study" / LABELS_FILE, labels)
    with (tmp_path / "study" / "study.toml").open("a") as file:
        file.write(
            f'[[socket.loads]]\nname = "x"\npreset = "toe-off"\n[segmentation]\nlabels = "{LABELS_FILE}"\n'
        )
    with pytest.raises(StudyError, match="beside the knee centre, which is not known"):
        check_study(load_study(tmp_path / "study"))


@pytest.mark.slow
def test_a_thigh_is_identified_from_its_folder_to_its_report(tmp_path: Path) -> None:
    truth = make_phantom(tmp_path / "study", limb=THIGH)
    assert [site["name"] for site in truth["sites"]] == sorted(DETAIL_SITES["coarse"])
    study = load_study(tmp_path / "study")
    run_study(study)
    predicted = json.loads((study.results / "predict" / "predict.json").read_text())
    assert [row["site"] for row in predicted["sites"]] == [site["name"] for site in truth["sites"]]
    assert predicted["mean_error_heldout_percent"] < 2.0
    report = (study.results / "report" / "report.html").read_text()
    assert not re.search(
        r"\b(tibia|fibula|patella|knee)\b", report, re.IGNORECASE
    )  # people's may be transtibial


def test_true_forces_are_those_of_the_whole_thigh() -> None:
    """What is cut free 100 mm from a site is held by the bones of a shank; of a thigh nothing is cut off."""
    assert choose_discretisation("coarse", "transtibial").within_mm == 100.0
    assert choose_discretisation("coarse", "transfemoral").within_mm is None
