"""Mesh convergence on the averaged residual limb: peak force against unknowns and processor time.

The posterior and a tibial site of the study that FEBio has solved, each meshed by limbfit's own path at
several sizes and solved with its default steps.  A size stands for a whole family: edges near and far and the
growth between them scale with it.  With ``--splits 1`` every tetrahedron is cut into eight on its curved
quadratic nodes, so that the skin has two layers of elements; the mesher itself makes one.

    python benchmarks/convergence.py --output folder --site posterior --element tet10 --sizes 6 4.5 3.5 2.7
    python benchmarks/convergence.py --output folder --json

Runs are kept in ``runs.json`` in the folder and never done twice; without ``--element`` nothing is solved.
Each solves in a process of its own.  Then tables are printed (with ``--json`` the whole analysis) and
``convergence.png`` is drawn.
"""

import argparse
import json
import multiprocessing
import sys
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from convergence_analysis import analyse, draw, tables
from numpy.typing import NDArray

from limbfit.anatomy.meshing.meshing import MeshSettings, mesh_site
from limbfit.anatomy.surfaces.surfaces import Anatomy, read_surface
from limbfit.bench.parity import find_reference
from limbfit.bench.timing import measure_max_rss_MB, warm_up
from limbfit.fe import ELEMENTS, Problem, StepControl, solve
from limbfit.indentation import SiteModel, build_problem
from limbfit.mesh import Mesh, check, read_vtu, to_tet10, write_vtu
from limbfit.study import IndenterTable

SITES = {"posterior": "4", "tibia": "2"}
BONES = ("tibia", "fibula")
# Edges (mm) of the family of size h: those of the example study at h = 4 mm.
FAR, GROWTH_PER_MM, RADIUS = 4.0, 0.125, 14.0
PUNCH = IndenterTable(shape="square", width_mm=20.0, edge_radius_mm=2.0)
# A split tetrahedron: four corners, and four around one of three diagonals of the octahedron between them.
AT_CORNERS = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3]])
DIAGONALS = np.array([[4, 9], [5, 7], [6, 8]])
RINGS = np.array([[5, 6, 7, 8], [4, 6, 9, 8], [4, 5, 9, 7]])
SPLIT_FACE = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
REFERENCE = np.array(
    [
        [0, 0, 0],
        [2, 0, 0],
        [0, 2, 0],
        [0, 0, 2],
        [1, 0, 0],
        [1, 1, 0],
        [0, 1, 0],
        [0, 0, 1],
        [1, 0, 1],
        [0, 1, 1],
    ]
)


@dataclass(frozen=True)
class Run:
    """A simulation: size of its family in mm, how often each tetrahedron is split, steps of loading, threads.

    Without unloading it gives the peak force, but no cost.
    """

    site: str
    element: str
    size_mm: float
    splits: int = 0
    load_steps: int = StepControl().load_steps
    unloading: bool = True
    threads: int = 1

    @property
    def mesh_name(self) -> str:
        return f"{self.site}-{self.size_mm:g}-{self.splits}.vtu"


def read_anatomy(folder: Path) -> Anatomy:
    """The residuum, cut at the top of its skin."""
    skin = read_surface(folder / "skin.stl", "LPS")
    bones = {name: read_surface(folder / f"{name}.stl", "LPS") for name in BONES}
    top = np.array([0.0, 0.0, skin.points[:, 2].max()])
    return Anatomy(skin=skin, bones=bones, cut_point=top, cut_normal=np.array([0.0, 0.0, 1.0]))


def settings(size: float) -> MeshSettings:
    """Those of a family; ``size`` in mm."""
    return MeshSettings(
        edge_near_mm=size,
        edge_far_mm=FAR * size,
        near_radius_mm=RADIUS,
        growth=GROWTH_PER_MM * size,
    )


def make_mesh(run: Run, study: Path, file: Path) -> None:
    """The tet10 mesh of a run, stored."""
    site = json.loads((study / "sites.json").read_text())["sites"][SITES[run.site]]
    place = np.array(site["position"]), np.array(site["axis"])
    mesh, _ = mesh_site(read_anatomy(study), *place, settings(run.size_mm))
    for _ in range(run.splits):
        mesh = to_tet10(split(mesh))
    write_vtu(mesh, file)


def split(mesh: Mesh) -> Mesh:
    """Each tet10 as eight tet4 on its nodes, the inner four about its shortest diagonal."""
    ends = mesh.points[mesh.cells[:, DIAGONALS]]
    shortest = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2).argmin(axis=1)
    patterns = np.array([_upright(np.vstack([AT_CORNERS, _about(i)])) for i in range(3)])
    cells = np.take_along_axis(mesh.cells[:, None, :], patterns[shortest].reshape(-1, 1, 32), axis=2)
    fine = replace(
        mesh,
        cells=cells.reshape(-1, 4),
        cell_type="tet4",
        regions=np.repeat(mesh.regions, 8),
        face_sets={name: faces[:, SPLIT_FACE].reshape(-1, 3) for name, faces in mesh.face_sets.items()},
    )
    check(fine)
    return fine


def _about(diagonal: int) -> NDArray[np.int64]:
    ring = RINGS[diagonal]
    return np.array([[*DIAGONALS[diagonal], a, b] for a, b in zip(ring, np.roll(ring, -1))])


def _upright(tets: NDArray[np.int64]) -> NDArray[np.int64]:
    corners = REFERENCE[tets].astype(float)
    flipped = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    return np.where(flipped[:, None], tets[:, [0, 2, 1, 3]], tets)


def corners_only(mesh: Mesh) -> Mesh:
    """The tet4 mesh of a tet10 mesh's corners (which come first)."""
    count = int(mesh.corners.max()) + 1
    return replace(
        mesh,
        points=mesh.points[:count],
        cells=mesh.corners,
        cell_type="tet4",
        node_sets={name: nodes[nodes < count] for name, nodes in mesh.node_sets.items()},
        face_sets={name: faces[:, :3] for name, faces in mesh.face_sets.items()},
    )


def problem_of(run: Run, study: Path, mesh: Mesh) -> Problem:
    """The site's problem with FEBio's punch, path and tissues; touching at the start."""
    content = json.loads((study / "sites.json").read_text())
    site = content["sites"][SITES[run.site]]
    depth, ramp = site["depth_mm"], site["depth_mm"] / site["speed_mm_s"]
    model = SiteModel(
        name=run.site,
        mesh=Path(run.mesh_name),
        mesh_digest="",
        position=tuple(site["position"]),
        axis=tuple(site["axis"]),
        knots_s=(0.0, ramp, 2.0 * ramp)[: 2 + run.unloading],
        knots_mm=(0.0, depth, 0.0)[: 2 + run.unloading],
        indenter=PUNCH,
    )
    return replace(build_problem(model, mesh, content["truth"]), element=run.element)


def simulate(run: Run, study: Path, file: Path) -> dict[str, Any]:
    """Solve a run in this process; unknowns, N, processor seconds and seconds by the clock, MiB."""
    mesh = read_vtu(file)
    if ELEMENTS[run.element].cell_type == "tet4":
        mesh = corners_only(mesh)
    problem = problem_of(run, study, mesh)
    warm_up(run.element, sensitivities=False)
    control = StepControl(
        load_steps=run.load_steps, unload_steps=round(0.8 * run.load_steps), threads=run.threads
    )
    started, clock = time.process_time(), time.perf_counter()
    result = solve(problem, control, store="none")
    seconds, clock = time.process_time() - started, time.perf_counter() - clock
    statistics = result.statistics
    return {
        **asdict(run),
        "nodes": len(mesh.points),
        "cells": len(mesh.cells),
        **{key: statistics[key] for key in ("unknowns", "steps", "newton_iterations", "factorisations")},
        "peak_force_N": float(result.peak_force),
        "penetration_mm": float(result.penetration.max()),
        "cpu_seconds": seconds,
        "seconds": clock,
        "max_rss_MB": measure_max_rss_MB(),
        "completed": result.completed,
    }


def in_own_process(function: Any, *arguments: Any) -> Any:
    """``function(*arguments)`` in a fresh process: its largest memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def complete(rows: list[dict], runs: list[Run], study: Path, folder: Path) -> None:
    """Do the runs that are not among the rows, and store each as soon as it is done."""
    known = [Run(**{f.name: row[f.name] for f in fields(Run) if f.name in row}) for row in rows]
    for run in runs:
        if run in known:
            continue
        file = folder / run.mesh_name
        if not file.is_file():
            in_own_process(make_mesh, run, study, file)
        rows.append(in_own_process(simulate, run, study, file))
        (folder / "runs.json").write_text(json.dumps(rows, indent=1))
        print(
            "{site} {element} {size_mm} {unknowns} {peak_force_N:.4f} N "
            "{cpu_seconds:.1f} CPU s {seconds:.1f} s".format(**rows[-1]),
            file=sys.stderr,
        )


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=Path, required=True, help="folder of meshes, runs and figure")
    parser.add_argument("--site", nargs="+", choices=SITES, default=list(SITES))
    parser.add_argument("--element", nargs="*", choices=ELEMENTS, default=[])
    parser.add_argument("--sizes", type=float, nargs="+", default=[6.0, 4.5, 3.5, 2.7])
    parser.add_argument("--splits", type=int, default=0)
    parser.add_argument("--load-steps", type=int, default=StepControl().load_steps)
    parser.add_argument(
        "--threads", type=int, default=1, help="of a simulation; another number needs another folder"
    )
    parser.add_argument(
        "--reference", type=Path, help="folder of FEBio's results (default: shared/reference)"
    )
    parser.add_argument("--loading-only", action="store_true", help="up to the peak: its force, not its cost")
    parser.add_argument("--json", action="store_true", help="print the analysis as JSON")
    return parser.parse_args()


def main() -> None:
    chosen = options()
    chosen.output.mkdir(parents=True, exist_ok=True)
    kept = chosen.output / "runs.json"
    rows = json.loads(kept.read_text()) if kept.is_file() else []
    study = (chosen.reference or find_reference(Path.cwd())) / "openlimb-study"
    runs = [
        Run(site, element, size, chosen.splits, chosen.load_steps, not chosen.loading_only, chosen.threads)
        for size in chosen.sizes
        for site in chosen.site
        for element in chosen.element
    ]
    complete(rows, runs, study, chosen.output)
    found = analyse(rows)
    (chosen.output / "convergence.json").write_text(json.dumps(found, indent=1))
    draw(found, chosen.output / "convergence.png")
    print(json.dumps(found, indent=1) if chosen.json else tables(found))


if __name__ == "__main__":
    main()
