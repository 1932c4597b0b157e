"""A study with a small image of a synthetic limb, segmented."""

from pathlib import Path

from limbfit import run_study
from limbfit.anatomy.imaging import Volume, write_volume
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import make_grid
from limbfit.study import load_study
from scanned import build_image

STUDY = """
[study]
name = "limb"

[image]
path = "image.nrrd"  # made for this test

[[sites]]
name = "a"
position = [0.0, 0.0, 0.0]
depth_mm = 5.0
"""


def make_segmented(folder: Path) -> Path:
    """The study's folder, stage ``segment`` done."""
    limb = make_limb(3)
    fine = build_image(limb, make_grid(limb, "coarse", 3), seed=3)
    part = Volume(fine.array[45:85], fine.spacing, fine.index_to_point([0, 0, 45]), fine.direction)
    write_volume(folder / "image.nrrd", part)
    (folder / "study.toml").write_text(STUDY)
    run_study(load_study(folder), until="segment")
    return folder
