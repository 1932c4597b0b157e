"""Are limbs of another origin meshed, at any site, as their bodies come?

    python benchmarks/foreign_meshes.py --sites 10 --json foreign.json
    python benchmarks/foreign_meshes.py --sites 2 --only limb-4 limb-9/1 --roughen 0.3 --decimate
    python benchmarks/foreign_meshes.py --own --simulate --json simulated.json
    python benchmarks/foreign_meshes.py --own --simulate --fat --json fat.json

Ten transtibial limbs (the nine of ``data/limbs`` and the mean of 33, ``data/residuum``) of five bodies
each; skin and femur are open at the proximal end. With ``--fat`` it is the calf MRI instead, segmented and
amputated automatically, under 1.5 mm of skin and fat as thick as in its label map. Sites are drawn on the
skin; depths are up to half of the tissue between skin and bone, which counts up to 40 mm.

Every site is meshed as a study without a ``[mesh]`` is: its own mesh and, but for ``--own``, the coarse
one. A mesh is sound where no cell is inverted, every face has one cell or two and the boundary closes, and
the smallest dihedral angle is 3 degrees or more. Far from the site edges are long, so volume and layer are
judged loosely: within 3 % and 0.3 mm.

With ``--simulate`` the tissue of its own mesh within 65 mm of the site is indented, in and out, with the
default tissue and indenter, as in a search of parameters; with ``--whole`` all of it. Rows of the file of
``--json`` are not done again.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from site_meshes import CALF_PAD_MM, CALF_PLANE, INDENTER_MM, draw_random_sites, measure_cpu_seconds

from limbfit.anatomy.imaging import read_volume
from limbfit.anatomy.meshing.layers import LayerSpec
from limbfit.anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from limbfit.anatomy.segmentation.amputation import amputate_limb
from limbfit.anatomy.segmentation.segmentation import segment
from limbfit.anatomy.sites.sites import measure_tissue_under
from limbfit.anatomy.surfaces.mending import build_closed_anatomy, open_loops
from limbfit.anatomy.surfaces.surfaces import Anatomy, Surface, build_anatomy, find_bodies, read_surface
from limbfit.anatomy.surfaces.thickness import measure_fat_depth
from limbfit.anatomy.surfaces.triangles import from_pyvista
from limbfit.errors import LimbfitError
from limbfit.fe import solve
from limbfit.indentation import SiteModel, build_problem, build_steps
from limbfit.mesh import Mesh, boundary_faces, measure_quality
from limbfit.pipeline.limb.mesh import build_coarse_settings, mesh_settings
from limbfit.study import Study

Array = NDArray[np.float64]

SMALLEST_DEG, VOLUME, THICKNESS_MM = 3.0, 0.03, 0.3
SKIN_MM, WITHIN_MM = 1.5, 65.0
SPEED_MM_S = 0.96
NAMES = ("skin", "tibia", "femur", "fibula", "patella")  # by volume
SHARED = Path(__file__).parents[1] / ".." / "shared"


@dataclass(frozen=True)
class Limb:
    """A limb to be meshed: its anatomy, what was mended of it, the depth of its fat where it is known."""

    name: str
    anatomy: Anatomy
    notes: tuple[str, ...]
    fat_depth_mm: Array | None = None


def limb_files(shared: Path) -> dict[str, Path]:
    """The ten limbs' files by name."""
    found = {file.stem: file for file in sorted((shared / "data" / "limbs").glob("limb-*.stl"))}
    return {**found, "mean": shared / "data" / "residuum" / "openlimb_mean.stl"}


def named_bodies(file: Path) -> dict[str, Surface]:
    """The five bodies of a file as they are, loose triangles with the skin."""
    parts = find_bodies(read_surface(file))
    solid, loose = parts[:5], parts[5:]
    size = [float(np.prod(np.ptp(part.points, axis=0))) for part in solid]
    skin, *bones = [solid[i] for i in np.argsort(size)[::-1]]
    femur = next(bone for bone in bones if open_loops(bone))
    closed = [bone for bone in bones if bone is not femur]
    patella = max(closed, key=lambda bone: bone.points[:, 2].mean())
    tibia, fibula = [bone for bone in closed if bone is not patella]
    starts = np.cumsum([0, len(skin.points), *(len(part.points) for part in loose)])
    faces = np.vstack([part.faces + start for part, start in zip([skin, *loose], starts)])
    whole = Surface(np.vstack([skin.points, *(part.points for part in loose)]), faces)
    return {"skin": whole, "tibia": tibia, "femur": femur, "fibula": fibula, "patella": patella}


def damaged(surface: Surface, roughen_mm: float, decimate: bool, seed: int) -> Surface:
    """Points moved by normal noise of that deviation, and half of the triangles taken away."""
    if decimate:
        surface = from_pyvista(surface.to_pyvista().decimate_pro(0.5, preserve_topology=True))
    noise = np.random.default_rng(seed).normal(0.0, roughen_mm, surface.points.shape)
    return Surface(surface.points + noise, surface.faces)


def read_limb(name: str, file: Path, roughen_mm: float, decimate: bool) -> Limb:
    parts = named_bodies(file)
    if roughen_mm > 0 or decimate:
        parts = {part: damaged(one, roughen_mm, decimate, 7) for part, one in parts.items()}
    skin = parts.pop("skin")
    return Limb(name, *build_closed_anatomy(skin, parts))


def read_calf(folder: Path) -> Limb:
    labels = amputate_limb(segment(read_volume(folder)), *CALF_PLANE, pad_mm=CALF_PAD_MM)
    anatomy = build_anatomy(labels)
    return Limb("calf", anatomy, (), measure_fat_depth(labels, anatomy))


def default_settings() -> dict[str, MeshSettings]:
    """Settings of a study that says nothing about meshes: those of its own and of the coarse ones."""
    site = {"name": "1", "depth_mm": 5.0, "position": (0.0, 0.0, 0.0)}
    study = Study(study={"name": "foreign"}, surfaces={"skin": "skin.stl"}, sites=(site,))  # type: ignore[arg-type]
    coarse = build_coarse_settings(study)
    return {"own": mesh_settings(study)} | ({} if coarse is None else {"coarse": coarse})


def settings_of(limb: Limb) -> dict[str, MeshSettings]:
    """The same, with skin and fat where the depth of the fat is known."""
    if limb.fat_depth_mm is None:
        return default_settings()
    layers = (LayerSpec("skin", SKIN_MM), LayerSpec("fat", None))
    return {kind: replace(settings, layers=layers) for kind, settings in default_settings().items()}


def faults(mesh: Mesh, report: Any) -> list[str]:
    """What keeps a mesh from being sound."""
    found = []
    if measure_quality(mesh).inverted:
        found.append("inverted cells")
    faces = boundary_faces(mesh)[:, :3]
    edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    if (np.unique(edges, axis=0, return_counts=True)[1] % 2).any():
        found.append("the boundary does not close")
    if report.min_dihedral_deg < SMALLEST_DEG:
        found.append(f"angle of {report.min_dihedral_deg:.1f} degrees")
    if abs(report.volume_error) > VOLUME:
        found.append(f"volume off by {100 * report.volume_error:.2f} %")
    wanted = SKIN_MM if "fat" in mesh.region_names else 3.0
    skin = report.layer_thickness_mm["skin"].mean
    if abs(skin - wanted) > THICKNESS_MM:
        found.append(f"skin of {skin:.2f} mm")
    return found


def site_row(limb: Limb, base: BaseMesh, settings: MeshSettings, site: tuple[Array, Array]) -> dict[str, Any]:
    """What became of one mesh; a failure says why."""
    start = measure_cpu_seconds()
    try:
        mesh, report = mesh_site(limb.anatomy, *site, settings, base)
    except LimbfitError as error:
        return {"sound": False, "failure": str(error), "position": site[0].tolist()}
    found = faults(mesh, report)
    return {
        "sound": not found,
        "failure": "; ".join(found),
        "position": site[0].tolist(),
        "nodes": report.nodes,
        "angle": report.min_dihedral_deg,
        "volume_error": report.volume_error,
        "layer_mm": report.layer_mean_mm,
        "repairs": list(report.repairs),
        "seconds": measure_cpu_seconds() - start,
        "mesh": mesh,
    }


def simulated(
    mesh: Mesh, site: tuple[Array, Array], depth_mm: float, within_mm: float | None
) -> dict[str, Any]:
    """The indentation of a site by the default indenter and tissue, in and out."""
    start, ramp = measure_cpu_seconds(), depth_mm / SPEED_MM_S
    position, axis = (tuple(float(x) for x in part) for part in site)
    with tempfile.TemporaryDirectory() as folder:
        knots = (0.0, ramp, 2 * ramp), (0.0, depth_mm, 0.0)
        model = SiteModel(
            "1",
            Path(folder),
            "",
            position,
            axis,
            *knots,
            element="tet10p0",
            within_mm=within_mm,  # type: ignore[arg-type]
        )
        tissue = {"c_kPa": 4.7, "m": 3.0, "gamma": 1.2, "tau_s": 2.0}
        problem = build_problem(model, mesh, dict.fromkeys(mesh.region_names, tissue))
        result = solve(problem, build_steps(model), store="none")
    return {
        "completed": result.completed,
        "reason": result.reason,
        "peak_N": result.peak_force,
        "simulated_nodes": len(problem.mesh.points),
        "solving_s": measure_cpu_seconds() - start,
        "doubts": [doubt.text for doubt in result.doubts],
    }


def rows(limb: Limb, asked: argparse.Namespace, wanted: set[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The wanted meshes of a limb, one after the other, by name."""
    sites = draw_random_sites(limb.anatomy, asked.sites, asked.seed)
    share = np.random.default_rng([asked.seed, 1]).uniform(0.1, 0.5, asked.sites)
    for kind, settings in settings_of(limb).items():
        names = [f"{limb.name}/{i}/{kind}" for i in range(asked.sites)]
        if not wanted & set(names):
            continue
        base = build_base_mesh(limb.anatomy, settings, limb.fat_depth_mm)
        for name, site, part in zip(names, sites, share, strict=True):
            if name not in wanted:
                continue
            row = site_row(limb, base, settings, site)
            row["depth_mm"] = float(part * measure_tissue_under(limb.anatomy, *site, INDENTER_MM))
            mesh = row.pop("mesh", None)
            if asked.simulate and mesh is not None and kind == "own":
                row |= simulated(mesh, site, row["depth_mm"], None if asked.whole else WITHIN_MM)
            yield name, row


def _line(name: str, row: dict[str, Any]) -> str:
    if "nodes" not in row:
        return f"{name}: FAILED, {row['failure']}"
    words = f"{name}: {row['nodes']} nodes, {row['angle']:.1f} deg, {row['seconds']:.0f} s"
    told = [row["failure"], *row["repairs"], "" if row.get("completed", True) else row["reason"]]
    if "peak_N" in row:
        words += f", {row['depth_mm']:.1f} mm: {row['peak_N']:.2f} N, {row['solving_s']:.0f} s"
    return "; ".join([words, *filter(None, told), *row.get("doubts", ())])


def _is_asked(name: str, only: list[str]) -> bool:
    return not only or any(name == one or name.startswith(f"{one}/") for one in only)


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=SHARED, help="the folder with data/")
    parser.add_argument("--sites", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--roughen", type=float, default=0.0, help="noise on every point, mm")
    parser.add_argument("--decimate", action="store_true", help="half of the triangles")
    parser.add_argument("--own", action="store_true", help="no coarse meshes")
    parser.add_argument("--fat", action="store_true", help="the calf with skin and a map of its fat instead")
    parser.add_argument("--simulate", action="store_true")
    parser.add_argument("--whole", action="store_true", help="simulate the whole of each mesh")
    parser.add_argument("--only", nargs="*", default=[], help="limbs, or sites such as limb-4/1")
    parser.add_argument("--json", type=Path)
    return parser.parse_args()


def main() -> int:
    asked = options()
    known = json.loads(asked.json.read_text()) if asked.json is not None and asked.json.is_file() else {}
    limbs = {"calf": asked.shared / "data" / "calf-mri"} if asked.fat else limb_files(asked.shared)
    kinds = ["own"] if asked.own else list(default_settings())
    for name, file in limbs.items():
        every = {f"{name}/{i}/{kind}" for i in range(asked.sites) for kind in kinds}
        wanted = {one for one in every - known.keys() if _is_asked(one, asked.only)}
        if not wanted:
            continue
        try:
            limb = read_calf(file) if asked.fat else read_limb(name, file, asked.roughen, asked.decimate)
        except LimbfitError as error:
            known |= {one: {"sound": False, "failure": str(error)} for one in wanted}
            print(f"{name}: REFUSED, {error}", flush=True)
            continue
        for note in limb.notes:
            print(f"{name}: {note}", flush=True)
        for key, row in rows(limb, asked, wanted):
            known[key] = row
            print(_line(key, row), flush=True)
            if asked.json is not None:
                asked.json.write_text(json.dumps(known, indent=1))
    bad = [row for row in known.values() if not (row["sound"] and row.get("completed", True))]
    print(f"{len(known)} meshes, {len(bad)} not sound or not simulated to the end")
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
