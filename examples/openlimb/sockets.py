"""Sockets for the OpenLimb mean limb: two designs, with a liner and without, each beside its control.

    python examples/openlimb/sockets.py prepare openlimb_mean.stl DIR
    for name in DIR/*/; do limbfit socket design "$name"; done
    python examples/openlimb/sockets.py table DIR

The STL is the mean limb as OpenLimb gives it, five bodies: skin, femur, patella, tibia, fibula.
``prepare`` writes four studies into DIR, which must not exist; ``table`` prints, as Markdown, the largest
pressures of control and design over the bony prominences, and the largest anywhere.
"""

import json
import sys
from pathlib import Path
from typing import Any

from limbfit.anatomy.surfaces.exchange import name_bodies
from limbfit.anatomy.surfaces.files import read_surface, write_surface
from limbfit.anatomy.surfaces.triangles import Surface, remove_unused_points

PROMINENCES = ("tibial crest", "fibular head", "distal tibia")
CASES = {
    "patellar-tendon-bearing-liner": ("patellar tendon bearing", 6.0),
    "patellar-tendon-bearing-bare": ("patellar tendon bearing", 0.0),
    "total-surface-bearing-liner": ("total surface bearing", 6.0),
    "total-surface-bearing-bare": ("total surface bearing", 0.0),
}
STUDY = """\
# The mean of 33 residual limbs (OpenLimb, CC BY-SA 4.0, doi 10.1101/2024.11.27.24317622); tissues of people.

[study]
name = "{name}"

[surfaces]
skin = "skin.stl"
bones = {{ tibia = "tibia.stl", fibula = "fibula.stl", patella = "patella.stl", femur = "femur.stl" }}

[[sites]]                       # a study has one or more; nothing is indented here
name = "1"
position = [{site}]
depth_mm = 5.0

[socket]
edge_mm = {edge:g}                   # of the limb's mesh
hold_s = 0.0                    # nothing is held, here and under the load: half of the steps

[[socket.loads]]
name = "single stance"
preset = "single stance"
hold_s = 0.0

[socket.liner]
thickness_mm = {liner:g}

[socket.design]
pressure = "{pressure}"
"""
EDGE_MM = 16.0


def prepare(file: Path, folder: Path) -> None:
    whole = read_surface(file)
    named = name_bodies(whole, file)
    parts = {name: remove_unused_points(Surface(whole.points, faces)) for name, faces in named.items()}
    skin = parts["skin"].points
    site = ", ".join(f"{x:.2f}" for x in skin[skin[:, 2].argmin()])
    for name, (pressure, liner) in CASES.items():
        (folder / name).mkdir(parents=True)
        for part, surface in parts.items():
            write_surface(folder / name / f"{part}.stl", surface)
        text = STUDY.format(name=name, site=site, edge=EDGE_MM, liner=liner, pressure=pressure)
        (folder / name / "study.toml").write_text(text)


def rows(folder: Path, name: str) -> list[str]:
    """Control and design of a study as rows of the table."""
    content = json.loads((folder / name / "results" / "socket_design" / "socket_design.json").read_text())
    pressure, liner = CASES[name]
    found = []
    for one in content["designs"]:
        cells = [pressure, f"{liner:g} mm" if liner else "none", one["name"], *_peaks(one)]
        found.append("| " + " | ".join(cells) + " |")
    return found


def _peaks(one: dict[str, Any]) -> list[str]:
    peaks, (load,) = one["peaks_kPa"], one["simulation"]["loads"]
    where = max(peaks, key=lambda name: peaks[name])
    cells = [f"{peaks[name]:.0f}" if name in peaks else "" for name in PROMINENCES]
    return [*cells, f"{peaks[where]:.0f}, {where}", f"{load['settling_mm']:.1f}"]


def table(folder: Path) -> None:
    heads = ["design", "liner", "", *PROMINENCES, "largest of all regions", "settles (mm)"]
    print("| " + " | ".join(heads) + " |")
    print("|" + "---|" * len(heads))
    for name in CASES:
        if (folder / name / "results" / "socket_design" / "socket_design.json").is_file():
            print("\n".join(rows(folder, name)))


if __name__ == "__main__":
    if len(sys.argv) == 4 and sys.argv[1] == "prepare":
        prepare(Path(sys.argv[2]), Path(sys.argv[3]))
    elif len(sys.argv) == 3 and sys.argv[1] == "table":
        table(Path(sys.argv[2]))
    else:
        sys.exit("usage: python sockets.py prepare FILE DIR | table DIR")
