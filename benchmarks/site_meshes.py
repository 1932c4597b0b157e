"""Site meshes at random sites of five limbs: failures, angles, thickness, volume, time.

    python benchmarks/site_meshes.py [--sites 20] [--engine netgen] [--shared FOLDER]

The limbs are phantoms of several seeds, a mean residuum, and a real calf that is amputated virtually.
"""

import argparse
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limbfit.anatomy.imaging import read_volume
from limbfit.anatomy.meshing.engines import ENGINES
from limbfit.anatomy.meshing.meshing import MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.segmentation.amputation import amputate_limb
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.anatomy.sites.sites import compute_indenter_axis
from limbfit.anatomy.surfaces.surfaces import Anatomy, build_anatomy, check_anatomy, read_surface
from limbfit.arrays import Array
from limbfit.bench.parity import Tell, find_reference
from limbfit.errors import InputError, LimbfitError
from limbfit.phantom.geometry import make_limb
from limbfit.phantom.mri import build_true_labels, make_grid
from limbfit.results.limb import MeshMeasures

SITES = 20
SEEDS = (0, 1, 2)
INDENTER_MM = 20.0
BELOW_CUT_MM = 25.0  # sites keep this far from the proximal cut
CALF_PLANE = (-36.7, 13.3, -94.4), (-0.10164, -0.16645, 0.98080)
CALF_PAD_MM = 15.0
OPENLIMB_CUT = (0.0, 0.0, 5.0), (0.0, 0.0, 1.0)


def bench_meshing(
    shared: Path | None = None,
    sites: int = SITES,
    engine: str = "mmg",
    *,
    settings: MeshSettings | None = None,
    tell: Tell,
    makers: Mapping[str, Callable[[], Anatomy]] | None = None,
) -> dict[str, Any]:
    """Mesh random sites of each limb and sum up.

    Returns ``sites``, ``failures``, ``min_dihedral_deg``, ``seconds_median`` (CPU seconds of a site's mesh,
    its mesher included) and more over all limbs; ``limbs`` has a summary of each, ``failed`` the messages.
    Raises `InputError` where the real limbs are missing, or for an engine that is not in the table.

    Parameters
    ----------
    shared : the folder with ``data`` and ``reference``; by default that here or above.
    sites : of each limb.
    engine : name of the mesher.
    settings : of the meshes; the defaults where not given.
    makers : other limbs than the five, by name.
    """
    if engine not in ENGINES:
        raise InputError(f"no mesher is named {engine!r}", remedy=f"use one of {', '.join(ENGINES)}")
    settings = replace(settings or MeshSettings(), engine=engine)
    if makers is None:
        makers = list_limbs(shared or find_reference(Path.cwd()).parent)
    rows: list[tuple[str, float, MeshMeasures]] = []  # limb, CPU seconds, mesh
    failed: list[str] = []
    seconds_base = {}
    for done, (name, make) in enumerate(makers.items()):
        tell(done * sites, len(makers) * sites, name)
        anatomy = make()
        check_anatomy(anatomy)
        start = measure_cpu_seconds()
        base = build_base_mesh(anatomy, settings)
        seconds_base[name] = measure_cpu_seconds() - start
        for i, (position, axis) in enumerate(draw_random_sites(anatomy, sites)):
            start = measure_cpu_seconds()
            try:
                _, mesh = mesh_site(anatomy, position, axis, settings, base)
                rows.append((name, measure_cpu_seconds() - start, mesh))
            except LimbfitError as error:
                failed.append(f"{name}, site {i}: {error}")
            tell(done * sites + i + 1, len(makers) * sites, name)
    return {
        "engine": settings.engine,
        **_summarise(rows, failed),
        "base_seconds_median": float(np.median(list(seconds_base.values()))),
        "failed": failed,
        "limbs": {
            name: _summarise(
                [row for row in rows if row[0] == name],
                [text for text in failed if text.startswith(f"{name},")],
            )
            for name in makers
        },
    }


def _summarise(rows: Sequence[tuple[str, float, MeshMeasures]], failed: Sequence[str]) -> dict[str, Any]:
    summary: dict[str, Any] = {"sites": len(rows) + len(failed), "failures": len(failed)}
    if not rows:
        return summary
    _, seconds, meshes = zip(*rows, strict=True)
    errors = [mesh.interface_error_mm for mesh in meshes]
    angles = [mesh.min_dihedral_deg for mesh in meshes]
    return summary | {
        "min_dihedral_deg": min(angles),
        "median_of_min_dihedral_deg": float(np.median(angles)),
        "nodes_median": float(np.median([mesh.nodes for mesh in meshes])),
        "cells_median": float(np.median([mesh.cells for mesh in meshes])),
        "cells_max": max(mesh.cells for mesh in meshes),
        "interface_error_mean_mm": float(np.mean([error.mean for error in errors])),
        "interface_error_max_mm": max(error.max for error in errors),
        "thickness_mean_mm": float(np.mean([mesh.layer_mean_mm for mesh in meshes])),
        "thickness_std_mm": float(np.mean([mesh.layer_std_mm for mesh in meshes])),
        "volume_error_max_percent": 100 * max(abs(mesh.volume_error) for mesh in meshes),
        "seconds_median": float(np.median(seconds)),
        "seconds_max": max(seconds),
    }


def measure_cpu_seconds() -> float:
    """CPU seconds of this process and of the mesher's processes that ended."""
    return sum(os.times()[:4])


def list_limbs(shared: Path) -> dict[str, Callable[[], Anatomy]]:
    """Name and maker of five limbs; `InputError` where the folder ``shared`` lacks the real ones."""
    openlimb, calf = shared / "reference" / "openlimb-study", shared / "data" / "calf-mri"
    for folder in (openlimb, calf):
        if not folder.is_dir():
            raise InputError("the real limbs are not there", file=folder, remedy="give --shared")
    phantoms = {f"phantom {seed}": lambda seed=seed: make_phantom_limb(seed) for seed in SEEDS}
    return {
        **phantoms,
        "openlimb": lambda: make_openlimb_mean(openlimb),
        "calf": lambda: make_amputated_calf(calf),
    }


def make_phantom_limb(seed: int) -> Anatomy:
    """The surfaces of a phantom as a label map on its scanner's grid shows them."""
    limb = make_limb(seed)
    return build_anatomy(build_true_labels(limb, make_grid(limb, "paper", seed)))


def make_openlimb_mean(folder: Path) -> Anatomy:
    """The mean residuum of 33 limbs (OpenLimb), as the example uses it."""
    bones = {name: read_surface(folder / f"{name}.stl") for name in ("tibia", "fibula")}
    point, normal = (np.array(part) for part in OPENLIMB_CUT)
    return Anatomy(read_surface(folder / "skin.stl"), bones, point, normal)


def make_amputated_calf(folder: Path) -> Anatomy:
    """The calf MRI, segmented automatically and amputated as in the example."""
    return build_anatomy(amputate_limb(segment(read_volume(folder)), *CALF_PLANE, pad_mm=CALF_PAD_MM))


def draw_random_sites(anatomy: Anatomy, count: int, seed: int = 0) -> list[tuple[Array, Array]]:
    """Positions (3,) spread evenly over the skin below the cut, and the indenter's axis (3,) at each."""
    random = np.random.default_rng(seed)
    corners, area = anatomy.skin.triangles, anatomy.skin.face_areas
    area = np.where(anatomy.height(corners).max(axis=1) < -BELOW_CUT_MM, area, 0.0)
    faces = random.choice(len(area), count, p=area / area.sum())
    points = np.einsum("ni,nij->nj", random.dirichlet(np.ones(3), count), corners[faces])
    return [(point, compute_indenter_axis(anatomy.skin, point, INDENTER_MM)) for point in points]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sites", type=int, default=SITES, help="of each limb")
    parser.add_argument("--engine", default="mmg", choices=sorted(ENGINES), help="the mesher")
    parser.add_argument("--shared", type=Path, help="folder with data and reference; default: here or above")
    asked = parser.parse_args()
    tell = lambda done, total, text: print(f"{done} of {total}: {text}", flush=True)  # noqa: E731
    print(json.dumps(bench_meshing(asked.shared, asked.sites, asked.engine, tell=tell), indent=1))


if __name__ == "__main__":
    main()
