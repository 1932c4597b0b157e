"""Make a study folder of the real calf MRI: an intact leg, amputated virtually, two planned indentations.

    python prepare.py INPUTS DIR

INPUTS is the folder ``calf-mri`` of DICOM slices, or a folder that holds ``data/calf-mri``. DIR must not
exist. Nobody pushed on this calf, so the sites plan an indentation (depth and speed) instead of naming a
record; ``limbfit simulate`` predicts its force.
"""

import shutil
import sys
from pathlib import Path

STUDY = """\
# A human calf: 3 T T1-weighted MRI, 56 oblique-axial slices of 0.486 x 0.486 x 3.0 mm
# (Apache-2.0, COMODO-research/Imago.jl).

[study]
name = "calf"
description = "Real calf MRI, virtual transtibial amputation, two simulated indentations"

[image]
path = "mri"

[geometry]
skin_layer_mm = 3.0
amputation = { point = [-36.7, 13.3, -94.4], normal = [-0.10164, -0.16645, 0.98080] }
amputation_pad_mm = 15.0

[mesh]
element = "tet10"
edge_near_mm = 4.0
edge_far_mm = 20.0
near_radius_mm = 14.0
growth = 0.6

[[sites]]                       # over the gastrocnemius: 45 mm and more of soft tissue
name = "posterior"
region = "posterior wall"
position = [-39.1, 52.7, -26.8]
depth_mm = 10.0
speed_mm_s = 0.96

[[sites]]                       # over tibialis anterior, beside the crest: tibia 17 mm away
name = "anterolateral"
region = "lateral to the tibia"
position = [-74.1, -41.8, -46.5]
depth_mm = 5.0
speed_mm_s = 0.96
"""


def main(inputs: Path, folder: Path) -> None:
    calf = inputs / "data" / "calf-mri"
    source = calf if calf.is_dir() else inputs
    slices = sorted(source.glob("*.dcm"))
    if not slices:
        sys.exit(f"{source}: no DICOM slices; give the folder calf-mri")
    (folder / "mri").mkdir(parents=True)
    for path in slices:
        shutil.copyfile(path, folder / "mri" / path.name)
    (folder / "study.toml").write_text(STUDY, encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python prepare.py INPUTS DIR")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
