"""Make a study folder of the OpenLimb residuum with FEBio's forces.

    python prepare.py INPUTS DIR

INPUTS is the folder ``openlimb-study`` (skin.stl, tibia.stl, fibula.stl, sites.json, traces/). DIR must not
exist. The truth that FEBio was given goes to ``truth.json``, which no stage of limbfit reads.
"""

import json
import shutil
import sys
from pathlib import Path

STUDY = """\
# Residuum averaged from 33 limbs (OpenLimb, CC BY-SA 4.0, doi 10.1101/2024.11.27.24317622); forces by FEBio.

[study]
name = "openlimb"
description = "Mean of 33 transtibial residua; forces computed by FEBio 4.11 with quadratic tetrahedra"

[surfaces]                      # geometry enters as closed surfaces, LPS mm
skin = "surfaces/skin.stl"
bones = { tibia = "surfaces/tibia.stl", fibula = "surfaces/fibula.stl" }

[geometry]
skin_layer_mm = 3.0

[mesh]                          # about 15,000 nodes a site (FEBio's have 20,000)
element = "tet10"
edge_near_mm = 3.6
edge_far_mm = 16.0
near_radius_mm = 14.0
growth = 0.5

[mesh.coarse]                   # parameters are searched on these, whose forces the others correct
edge_near_mm = 5.0
edge_far_mm = 30.0
near_radius_mm = 12.0
growth = 0.9
flatness = 1.6

[indenter]                      # the punch that FEBio pushed: 20 mm square, edges rounded by 2 mm
shape = "square"
width_mm = 20.0
edge_radius_mm = 2.0

[calibration]
relative_tolerance = 0.01

[solver]                        # how far FEBio's punch sinks in: its penalty in the mean (docs/contact.md)
penalty_per_mm = 12.5
"""

SITE = """
[[sites]]
name = "{name}"
region = "{region}"
fitted = {fitted}
trace = "traces/site-{name}.csv"
position = {position}
axis = {axis}
"""


def main(inputs: Path, folder: Path) -> None:
    content = json.loads((inputs / "sites.json").read_text())
    (folder / "surfaces").mkdir(parents=True)
    for name in ("skin", "tibia", "fibula"):
        shutil.copyfile(inputs / f"{name}.stl", folder / "surfaces" / f"{name}.stl")
    (folder / "traces").mkdir()
    for trace in (inputs / "traces").glob("*.csv"):
        shutil.copyfile(trace, folder / "traces" / trace.name)
    sites = [
        SITE.format(
            name=name,
            region=site["region"],
            fitted=str(site["fitted"]).lower(),
            position=site["position"],
            axis=site["axis"],
        )
        for name, site in content["sites"].items()
    ]
    (folder / "study.toml").write_text(STUDY + "".join(sites))
    (folder / "truth.json").write_text(json.dumps({"parameters": content["truth"]}, indent=1))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python prepare.py INPUTS DIR")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
