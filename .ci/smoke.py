"""Is this installation of limbfit whole? Run with its Python, in a folder without the repository."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import files, version
from pathlib import Path

import numpy as np
import pyvista as pv

import limbfit

home = Path(limbfit.__file__).parent
assert home.is_relative_to(sys.prefix), f"limbfit comes from {home}, not from this environment"
assert limbfit.__version__ == version("limbfit")
for name in limbfit.__all__:
    getattr(limbfit, name)
assert (home / "py.typed").is_file()
for page in ("web/static/vendor/three.min.js", "studio/static/vendor/niivue.js", "studio/static/studio.js"):
    assert (home / page).is_file(), f"{page} is missing"
licences = {file.name for file in files("limbfit") or () if "licenses" in file.parts}
assert {"LICENSE", "THIRD-PARTY.md"} <= licences, licences


def command(*words: str) -> str:
    return subprocess.run(["limbfit", *words], check=True, capture_output=True, text=True).stdout


assert limbfit.__version__ in command("--version")
assert "phantom" in command("--help")
doctor = json.loads(command("doctor", "--json"))

side = np.linspace(-10, 10, 5)
mesh = limbfit.Mesh.from_pyvista(pv.RectilinearGrid(side, side, [-8, -4, 0]).to_tetrahedra())
problem = limbfit.Problem(
    mesh,
    {"tissue": limbfit.OgdenQLV(c=0.005, m=4, gamma=1, tau=0.6)},
    mesh.nodes_where(lambda p: p[:, 2] < -7.9),
    mesh.faces_where(lambda p: p[:, 2] > -0.1),
    limbfit.Indenter("sphere", width=10, centre=(0, 0, 0), axis=(0, 0, -1)),
    limbfit.History([0, 1, 2], [0, 1, 0]),
)
result = limbfit.solve(problem)
assert result.completed, result.reason
print(f"limbfit {limbfit.__version__} in {sys.prefix}: {len(limbfit.__all__)} names, {result}")
