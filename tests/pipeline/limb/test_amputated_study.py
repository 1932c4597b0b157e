"""A study of an intact leg with a virtual amputation: its surfaces, from an image and its labels."""

from pathlib import Path

import numpy as np

from limbfit import run_study
from limbfit.anatomy.grid import LabelMap, Volume
from limbfit.anatomy.imaging import write_labels, write_volume
from limbfit.anatomy.surfaces.surfaces import Anatomy, load_anatomy
from limbfit.study import load_study

EDGE_MM = 4.0  # of the voxels
TEXT = """
[study]
name = "amputated"
[image]
path = "image.nrrd"
[segmentation]
labels = "labels.seg.nrrd"
[geometry]
surface_edge_mm = 6.0
{geometry}
[[sites]]
name = "a"
position = [0.0, 0.0, 0.0]
depth_mm = 5.0
"""


def build_leg(above: int = 0, below: int = 0) -> LabelMap:
    """A leg of 44 to 49 mm radius along z and its bone, 160 mm of it in the image; beyond it empty slices."""
    z, y, x = EDGE_MM * (np.indices((40, 30, 30)) - np.array([0.0, 14.5, 14.5])[:, None, None, None])
    array = np.where(np.hypot(x, y) < 44.0 + 0.03 * z, 1, 0) + np.where(np.hypot(x, y) < 14.0, 1, 0)
    array = np.pad(array, [(below, above), (0, 0), (0, 0)])
    origin = EDGE_MM * np.array([-14.5, -14.5, -below])
    return LabelMap(array, [EDGE_MM] * 3, origin, np.eye(3), {1: "soft tissue", 2: "tibia"})


def build_surfaces(folder: Path, labels: LabelMap, geometry: str) -> Anatomy:
    """What the stage makes of a leg under some keys of ``[geometry]``."""
    write_labels(folder / "labels.seg.nrrd", labels)
    image = Volume(labels.array, *labels.geometry)
    write_volume(folder / "image.nrrd", image)
    (folder / "study.toml").write_text(TEXT.format(geometry=geometry))
    study = load_study(folder)
    run_study(study, until="surfaces")
    return load_anatomy(study.results / "surfaces")


def test_a_stump_that_is_wider_than_long_ends_where_the_leg_did(tmp_path: Path) -> None:
    """Of the stump alone the longest axis lies across it, and empty slices hide where the image cut it."""
    short = "amputation = { point = [0.0, 0.0, 104.0] }"
    anatomy = build_surfaces(tmp_path, build_leg(above=2, below=1), short)
    assert anatomy.cut_normal.tolist() == [0.0, 0.0, 1.0]
    assert np.ptp(anatomy.skin.points[:, 2]) < 80.0


def test_a_leg_that_is_held_up_is_amputated_as_its_proximal_cut_says(tmp_path: Path) -> None:
    """The plane's normal points down, to what is kept; of a leg in all of the image the top is proximal."""
    up = """
proximal_cut = { point = [0.0, 0.0, 10.0], normal = [0.0, 0.0, -1.0] }
amputation = { point = [0.0, 0.0, 120.0], normal = [0.0, 0.0, -1.0] }
"""
    anatomy = build_surfaces(tmp_path, build_leg(), up)
    assert anatomy.cut_normal.tolist() == [0.0, 0.0, -1.0]
    assert abs(anatomy.skin.points[:, 2].max() - 135.0) < 3.0
    assert abs(anatomy.bones["tibia"].points[:, 2].max() - 120.0) < 3.0
