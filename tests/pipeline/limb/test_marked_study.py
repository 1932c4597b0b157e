"""Studies with skin markers, in a second image of a limb that moved or in the only one."""

import json

import numpy as np
import pytest

import limbfit
from limbfit.errors import StudyError
from limbfit.phantom.geometry import build_rotation, make_limb
from limbfit.phantom.mri import make_grid, write_series
from limbfit.phantom.robot import build_markers, build_true_sites

SEED = 3
TOLERANCE_MM = 1.5  # voxels of 2.4 mm


def write_study(folder, image: str, sites) -> None:
    tables = [f'[study]\nname = "marked"\n[image]\n{image}\n[geometry]\nsurface_edge_mm = 4.0\n']
    for site in sites:
        near = ", ".join(f"{x:.1f}" for x in site.hint)
        tables.append(f'[[sites]]\nname = "{site.name}"\ndepth_mm = 4.0\nnear = [{near}]\n')
    (folder / "study.toml").write_text("".join(tables))


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    """A folder with both series; the sites of the first, and of the second, moved one."""
    folder = tmp_path_factory.mktemp("marked")
    limb = make_limb(SEED)
    moved = limb.move(build_rotation(np.array([0.2, 0.4, 1.0]), np.deg2rad(2.5)), np.array([3.0, -2.0, 2.0]))
    grid = make_grid(limb, "coarse", SEED)
    plain, marked = build_true_sites(limb, SEED), build_true_sites(moved, SEED)
    write_series(folder / "plain", limb, grid, seed=SEED, number=1)
    write_series(folder / "marked", moved, grid, build_markers(marked), seed=SEED, number=2)
    return folder, plain, marked


@pytest.mark.slow
@pytest.mark.parametrize("way", ["second image", "same image"])
def test_sites_are_where_the_markers_were(scans, way: str) -> None:
    folder, plain, marked = scans
    if way == "second image":
        write_study(folder, 'path = "plain"\nmarkers = "marked"', plain)
    else:
        write_study(folder, 'path = "marked"\nmarkers = "same"', marked)
    found = limbfit.show_stage(limbfit.load_study(folder), "sites")
    truth = {site.name: site.position for site in (plain if way == "second image" else marked)}
    errors = [np.linalg.norm(np.array(s["position_mm"]) - truth[s["site"]]) for s in found["sites"]]
    assert len(errors) == 18
    assert max(errors) < TOLERANCE_MM
    facts = json.loads((folder / "results/segment/segment.json").read_text())
    if way == "second image":
        assert facts["motion"]["turn_deg"] == pytest.approx(2.5, abs=0.2)
    else:
        assert facts["markers_removed"] == 18


def test_a_series_of_no_second_image_is_refused(tmp_path) -> None:
    (tmp_path / "mri").mkdir()
    write_study(
        tmp_path,
        'path = "mri"\nmarkers = "same"\nmarkers_series = "1.2.3"',
        build_true_sites(make_limb(0), 0)[:1],
    )
    with pytest.raises(StudyError, match="markers_series belongs to a second image"):
        limbfit.load_study(tmp_path)
