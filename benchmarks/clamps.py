"""What do the pins that hold the limb change in the force of an indentation?

    python benchmarks/clamps.py --sites 05 10 15 --force 15 --json clamps.json

Sites of the synthetic patient (`limbfit phantom`), at its true tissues, indented as they are and in a limb
that eleven pins clamp (`limbfit.indentation.sites`).  What came of it: docs/loads.md.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_site
from limbfit.fe import History, Indenter, Problem, StepControl, solve
from limbfit.indentation import build_materials
from limbfit.indentation.sites import clamp_problem
from limbfit.mesh import Mesh
from limbfit.phantom import TrueSite, build_true_sites, draw_true_parameters, make_limb
from limbfit.phantom.geometry import build_true_anatomy
from limbfit.study import ClampsTable

SEED, INDENTER_MM, EDGE_MM, KAPPA_RATIO = 0, 20.0, 2.0, 100.0
# Coarse at the site, and finer away from it than for an indentation alone: the pins press all around.
MESH = MeshSettings(edge_near_mm=5.5, edge_far_mm=18.0, near_radius_mm=14.0)
ELEMENT = "tet10p0"  # the default of studies


def site_problem(site: TrueSite, mesh: Mesh) -> Problem:
    """The site indented to its depth."""
    tool = Indenter("square", INDENTER_MM, EDGE_MM, centre=site.position, axis=site.axis)
    faces = mesh.face_sets["skin"]
    near = np.linalg.norm(mesh.points[faces[:, :3]].mean(axis=1) - site.position, axis=1)
    ramp = site.depth / site.speed
    return Problem(
        mesh=mesh,
        materials=build_materials(draw_true_parameters(SEED), KAPPA_RATIO),
        fixed=mesh.held,
        contact_faces=faces[near < 0.71 * INDENTER_MM + site.depth + 8.0],
        indenter=tool,
        history=History(np.array([0.0, ramp]), np.array([0.0, site.depth])),
        element=ELEMENT,
    )


def compare(site: TrueSite, mesh: Mesh, along: Any, force: float) -> dict[str, Any]:
    """Forces with and without clamps over the loading, and what the clamps did before."""
    started = time.process_time()
    problem, control = site_problem(site, mesh), StepControl()
    bare = solve(problem, control)
    table = ClampsTable(force_N=force)
    begun = table.lead_s
    later = replace(problem, history=problem.history.delay(begun), touch_down_s=begun)
    found = solve(clamp_problem(later, along, table), control)
    for result in (bare, found):
        if not result.completed:
            raise SystemExit(f"site {site.name}: {result.reason}")
    peak = float(problem.history.times[1])
    shares = np.linspace(0.1, 1.0, 10)
    free, tight = bare.force_at(shares * peak), found.force_at(begun + shares * peak)
    met = int(np.argmax(found.times > begun * (1.0 + 1e-9)))
    moved = found.coordinates[met, 0, 2] - found.displacement[met]
    sunk = found.coordinates[met, 1:, 2]
    return {
        "site": site.name,
        "region": site.region,
        "depth_mm": site.depth,
        "pins": len(sunk),
        "pins_in_mm": [float(sunk.min()), float(sunk.max())],
        "skin_moved_mm": float(moved),
        "peak_free_N": float(free[-1]),
        "peak_clamped_N": float(tight[-1]),
        "peak_change_percent": float(100.0 * (tight[-1] / free[-1] - 1.0)),
        "mean_change_percent_of_peak": float(100.0 * np.mean(tight - free) / free[-1]),
        "unknowns": bare.statistics["unknowns"],
        "seconds_cpu": time.process_time() - started,
        "doubts": [doubt.text for doubt in found.doubts],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", nargs="+", default=["05", "10", "15"], help="of the phantom")
    parser.add_argument("--force", type=float, default=15.0, help="of each pin, N")
    parser.add_argument("--json", type=Path, help="write the rows here")
    options = parser.parse_args()
    limb = make_limb(SEED)
    anatomy = build_true_anatomy(limb)
    settings = replace(MESH, layers=limb.layers)
    base = build_base_mesh(anatomy, settings)
    rows = []
    for site in build_true_sites(limb, SEED):
        if site.name in options.sites:
            mesh, _ = mesh_site(anatomy, site.position, site.axis, settings, base)
            rows.append(compare(site, mesh, np.asarray(anatomy.cut_normal), options.force))
            print(json.dumps(rows[-1]), flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
