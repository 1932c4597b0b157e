"""The stage ``mesh``: one graded mesh for each site."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ...anatomy.meshing.layers import LayerSpec
from ...anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...anatomy.surfaces.thickness import read_thickness
from ...arrays import Array
from ...mesh import Mesh, write_vtu
from ...results.limb import MeshingSettings, MeshMeasures, MeshResult, MeshSet
from ...study import Study
from ...study.meshing import EdgesTable
from ..engine.context import Context
from ..engine.store import COARSE, THICKNESS, write_result


@dataclass(frozen=True)
class MeshJob:
    """A site mesh to be made by a worker."""

    site: str
    surfaces: Path
    surfaces_key: str
    position: tuple[float, ...]
    axis: tuple[float, ...]
    settings: MeshSettings
    file: Path


def plan_meshes(
    context: Context,
    folder: Path,
    places: Iterable[tuple[str, Sequence[float], Sequence[float]]],
    settings: MeshSettings,
) -> list[MeshJob]:
    """Meshes to be kept in ``folder``, by the name of each site; see `mesh_job`.

    ``places`` are the name of each site, and its position and axis in LPS mm.
    """
    return [
        mesh_job(context, site, position, axis, settings, folder / f"{site}.vtu")
        for site, position, axis in places
    ]


def mesh_job(
    context: Context,
    site: str,
    position: Sequence[float],
    axis: Sequence[float],
    settings: MeshSettings,
    file: Path,
) -> MeshJob:
    """The mesh of a site of the study's surfaces, with any settings; wider where a wider indenter touches.

    ``near_radius_mm`` is that of ``[indenter]``: it grows by as much as the site's widest one is wider.
    """
    study = context.study
    wider = max(study.width_at(study.site(site)) - study.indenter.width_mm, 0.0)
    settings = replace(settings, near_radius_mm=settings.near_radius_mm + wider / 2)
    stamp = context.store.stamp("surfaces")
    assert stamp is not None
    surfaces = context.store["surfaces"]
    return MeshJob(site, surfaces, stamp.key, tuple(position), tuple(axis), settings, file)


def make_mesh(job: MeshJob) -> MeshMeasures:
    """Mesh one site and store it; returns the facts that ``mesh.json`` holds."""
    shared = replace(job.settings, near_radius_mm=0.0)
    anatomy, base = _build_base(job.surfaces, job.surfaces_key, shared)
    mesh, facts = mesh_site(anatomy, np.array(job.position), np.array(job.axis), job.settings, base)
    keep_mesh(mesh, facts, job.file)
    return facts


def keep_mesh(mesh: Mesh, facts: MeshMeasures, file: Path) -> None:
    """Write a mesh, and beside it the facts of it."""
    write_vtu(mesh, file)
    write_result(file.with_suffix(".json"), facts)


def read_mesh_facts(file: Path) -> MeshMeasures:
    """What `keep_mesh` wrote beside a mesh."""
    return MeshMeasures.read_file(file.with_suffix(".json"), "delete its folder and run the command again")


@lru_cache(maxsize=1)
def _build_base(surfaces: Path, key: str, settings: MeshSettings) -> tuple[Anatomy, BaseMesh]:
    """What all sites of a study share, whatever their ``near_radius_mm``; a worker makes it once."""
    anatomy = load_anatomy(surfaces)
    return anatomy, build_base_mesh(anatomy, settings, read_stored_depth(surfaces, anatomy, settings))


def read_stored_depth(surfaces: Path, anatomy: Anatomy, settings: MeshSettings) -> Array | None:
    """Thickness of the mapped layer at the skin's points, mm; none where every layer's is stated."""
    mapped = any(layer.thickness_mm is None for layer in settings.layers)
    return read_thickness(surfaces / THICKNESS, anatomy.skin) if mapped else None


def mesh_settings(study: Study, stated: EdgesTable | None = None) -> MeshSettings:
    """How the site meshes of a study are made, with its own edges or others that are ``stated``."""
    table, geometry = study.mesh, study.geometry
    edges = (stated or table).model_dump(include=set(EdgesTable.model_fields))
    if study.clamps is not None:  # far from the site, edges are no longer than pins that press there are wide
        edges["edge_far_mm"] = min(edges["edge_far_mm"], study.clamps.width_mm)
    return MeshSettings(
        **edges,
        element=table.cell_type,
        engine=table.engine,
        time_limit_s=table.time_limit_s,
        layers=tuple(
            LayerSpec(layer.name, layer.thickness_mm, layer.min_thickness_mm)
            for layer in geometry.model_layers
        ),
        core=geometry.core,
        bone_policy=geometry.bone_policy,
        bone_clearance_mm=geometry.bone_clearance_mm,
    )


def build_coarse_settings(study: Study) -> MeshSettings | None:
    """How the second, coarse meshes are made; None where the study wants none."""
    coarse = study.mesh.coarse
    return None if coarse is None else mesh_settings(study, coarse)


def run_mesh(context: Context, folder: Path) -> None:
    """One graded mesh per site, and a coarse one where the study wants it; side by side.

    Meshes of an interrupted run are kept.
    """
    study = context.study
    content = MeshResult(**dict(_make_meshes(context, folder, mesh_settings(study), "")))
    coarse = build_coarse_settings(study)
    if coarse is not None:
        (folder / COARSE).mkdir(exist_ok=True)
        made = _make_meshes(context, folder / COARSE, coarse, "coarse, ")
        content = content.model_copy(update={"coarse": made})
    write_result(folder / "mesh.json", content)
    for facts in (*folder.glob("*.vtu"), *folder.glob(f"{COARSE}/*.vtu")):
        facts.with_suffix(".json").unlink()


def _make_meshes(context: Context, folder: Path, settings: MeshSettings, word: str) -> MeshSet:
    """The meshes of all sites that are not there yet; returns what ``mesh.json`` holds of all."""
    places = ((one.site, one.position_mm, one.axis) for one in context.results.sites.sites)
    jobs = plan_meshes(context, folder, places, settings)
    facts = {job.site: read_mesh_facts(job.file) for job in jobs if is_meshed(job.file)}
    missing = [job for job in jobs if job.site not in facts]
    context.tell("mesh", len(facts), len(jobs), word.removesuffix(", "))
    for job, made in zip(missing, context.executor.map(make_mesh, missing), strict=True):
        facts[job.site] = made
        context.tell("mesh", len(facts), len(jobs), f"{word}site {job.site}: {made.nodes} nodes")
        for repair in made.repairs:
            context.tell("mesh", len(facts), len(jobs), f"{word}site {job.site}: {repair}")
    return MeshSet(
        settings=MeshingSettings(**asdict(settings)), sites={job.site: facts[job.site] for job in jobs}
    )


def is_meshed(file: Path) -> bool:
    """Whether a mesh was kept whole (see `keep_mesh`)."""
    return file.is_file() and file.with_suffix(".json").is_file()


def scale_edges(settings: MeshSettings, factor: float) -> MeshSettings:
    """The same with edges ``factor`` times as long."""
    near, far = factor * settings.edge_near_mm, factor * settings.edge_far_mm
    return replace(settings, edge_near_mm=near, edge_far_mm=far)
