"""From image or surfaces to site meshes: the stages ``segment``, ``surfaces``, ``sites``, ``mesh``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.amputation import amputate
from ...anatomy.contours import write_contours
from ...anatomy.imaging import LabelMap, read_labels, write_labels
from ...anatomy.layers import LayerSpec
from ...anatomy.markers import find_markers, match_markers
from ...anatomy.meshing import BaseMesh, MeshSettings, base_mesh, mesh_site
from ...anatomy.quality import assess
from ...anatomy.sheet import draw_sheet
from ...anatomy.sites import indenter_axis, project_to_skin
from ...anatomy.surfaces import (
    Anatomy,
    build_anatomy,
    check_anatomy,
    load_anatomy,
    read_surface,
    save_anatomy,
)
from ...anatomy.thickness import fat_depth, read_thickness, write_thickness
from ...errors import SiteError
from ...mesh import write_vtu
from ...study import Site, Study
from ..context import Context
from ..corrections import DIGEST, LABELS
from ..simulations import COARSE
from ..store import file_digest, read_json, write_json
from .inputs import automatic_labels, labelled_file, naming, study_image, study_labels
from .marked_images import MARKED_SKIN, second_skin, without_own_markers

THICKNESS = "fat-depth.vtp"


def run_segment(context: Context, folder: Path) -> dict[str, Any]:
    """Image to label map; a corrected label map of the study wins over the automatic one."""
    study = context.study
    assert study.image is not None
    context.tell("segment", 0, 3, "reading the image")
    volume, removed = without_own_markers(study, study_image(study), folder)
    context.tell("segment", 1, 3, "labelling tissues")
    given = study_labels(study, volume)
    if given is not None:
        (labels, notes), method = given, "corrected by hand"
        for note in notes:
            context.tell("segment", 1, 3, f"label map: {note}")
    else:
        labels, notes, method = automatic_labels(study, volume), [], "automatic"
    write_labels(folder / LABELS, labels)
    write_contours(folder / "contours.csv", labels)
    quality = assess(labels)
    write_json(folder / "quality.json", quality.as_json())
    draw_sheet(folder / "quality.png", volume, labels, quality)
    context.tell("segment", 2, 3, "outlining the skin with markers")
    facts = {"method": method, "volumes_cm3": label_volumes(labels), "repairs": notes}
    facts[DIGEST] = file_digest(folder / LABELS)
    write_json(folder / "segment.json", facts | removed | second_skin(study, volume, labels, folder))
    return {}


def label_volumes(labels: LabelMap) -> dict[str, float]:
    """Volume of each label in cubic centimetres."""
    voxel_cm3 = float(np.prod(labels.spacing)) / 1000
    return {
        name: round(float((labels.array == value).sum()) * voxel_cm3, 2)
        for value, name in labels.names.items()
    }


def run_surfaces(context: Context, folder: Path) -> dict[str, Any]:
    """Label map or the study's own surfaces to a checked anatomy: closed skin, closed bones, proximal cut."""
    study = context.study
    context.tell("surfaces", 0, 2, "building surfaces")
    if study.surfaces is not None:
        anatomy = given_anatomy(study)
    else:
        labels = _limb_labels(context)
        anatomy = _imaged_anatomy(study, labels)
        if any(layer.thickness == "map" for layer in study.geometry.model_layers):
            depth = fat_depth(labels, anatomy, study.geometry.surface_edge_mm)
            write_thickness(folder / THICKNESS, anatomy.skin, depth)
    save_anatomy(folder, anatomy)
    return {}


def _limb_labels(context: Context) -> LabelMap:
    """The label map of the segment stage, after the virtual amputation where there is one."""
    geometry = context.study.geometry
    labels = read_labels(context.store["segment"] / "labels.seg.nrrd")
    if geometry.amputation is None:
        return labels
    plane = geometry.amputation
    return amputate(labels, plane.point, plane.normal, pad_mm=geometry.amputation_pad_mm)


def _imaged_anatomy(study: Study, labels: LabelMap) -> Anatomy:
    geometry = study.geometry
    cut = geometry.proximal_cut
    with naming(labelled_file(study)):
        anatomy = build_anatomy(
            labels,
            edge_mm=geometry.surface_edge_mm,
            proximal_cut=None if cut is None else (np.array(cut.point), np.array(cut.normal)),
        )
        check_anatomy(anatomy)
    return anatomy


def given_anatomy(study: Study) -> Anatomy:
    """The checked anatomy of given surfaces; without a stated cut its end is the highest (z) of the skin."""
    assert study.surfaces is not None
    tables = study.surfaces
    files = {name: study.path(path) for name, path in {"skin": tables.skin, **tables.bones}.items()}
    surfaces = {name: read_surface(path, tables.coordinates, tables.unit) for name, path in files.items()}
    skin = surfaces.pop("skin")
    cut = study.geometry.proximal_cut
    if cut is not None:
        point, normal = np.array(cut.point), np.array(cut.normal)
    else:
        point, normal = np.array([0.0, 0.0, skin.points[:, 2].max()]), np.array([0.0, 0.0, 1.0])
    anatomy = Anatomy(skin=skin, bones=surfaces, cut_point=point, cut_normal=normal)
    check_anatomy(anatomy, files)
    return anatomy


def run_sites(context: Context, folder: Path) -> dict[str, Any]:
    """Where each indentation is: on the skin, with the indenter's axis; markers matched to names."""
    study = context.study
    anatomy = load_anatomy(context.store["surfaces"])
    for note in study.notes:
        context.tell("sites", 0, 1, note)
    context.tell("sites", 0, 1, "placing sites")
    markers = _matched_markers(context, anatomy)
    placed = [place_site(site, study, anatomy, markers.get(site.name)) for site in study.sites]
    write_json(folder / "sites.json", {"sites": placed})
    return {}


def _matched_markers(context: Context, anatomy: Anatomy) -> dict[str, Any]:
    hints = {site.name: np.array(site.near) for site in context.study.sites if site.near is not None}
    if not hints:
        return {}
    marked = read_surface(context.store["segment"] / MARKED_SKIN)
    return dict(match_markers(find_markers(marked, anatomy.skin), hints))


def place_site(site: Site, study: Study, anatomy: Anatomy, marker: Any) -> dict[str, Any]:
    """A site on the skin with its axis; ``marker`` is what was matched to it, or None.

    Raises
    ------
    SiteError
        When the site is too far off the skin.
    """
    wanted = np.array(site.position) if marker is None else marker.position
    try:
        point, off = project_to_skin(anatomy, wanted)
        axis = site.axis or indenter_axis(anatomy.skin, point, study.indenter.width_mm)
    except SiteError as error:
        raise SiteError(
            error.what, file=study.file, place=f"sites.{site.name}", remedy=error.remedy
        ) from None
    evidence = None
    if marker is not None:
        assert site.near is not None
        distance = float(np.linalg.norm(marker.position - np.array(site.near)))
        evidence = {"height_mm": round(float(marker.height), 3), "distance_to_hint_mm": round(distance, 3)}
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    return {
        "site": site.name,
        "region": site.region,
        "fitted": site.fitted,
        "position_mm": [float(x) for x in point],
        "axis": [float(x) for x in unit],
        "off_skin_mm": round(float(off), 3),
        "marker": evidence,
    }


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


def mesh_job(
    context: Context,
    site: str,
    position: Sequence[float],
    axis: Sequence[float],
    settings: MeshSettings,
    file: Path,
) -> MeshJob:
    """The mesh of a site of the study's surfaces, with any settings."""
    key = str((context.store.stamp("surfaces") or {})["key"])
    surfaces = context.store["surfaces"]
    return MeshJob(site, surfaces, key, tuple(position), tuple(axis), settings, file)


def make_mesh(job: MeshJob) -> dict[str, Any]:
    """Mesh one site and store it; returns the facts that ``mesh.json`` holds."""
    anatomy, base = _base(job.surfaces, job.surfaces_key, job.settings)
    mesh, report = mesh_site(anatomy, np.array(job.position), np.array(job.axis), job.settings, base)
    write_vtu(mesh, job.file)
    facts = {**asdict(report), "element": job.settings.element}
    write_json(job.file.with_suffix(".json"), facts)
    return facts


@lru_cache(maxsize=1)
def _base(surfaces: Path, key: str, settings: MeshSettings) -> tuple[Anatomy, BaseMesh]:
    """What all sites of a study share; a worker makes it once."""
    anatomy = load_anatomy(surfaces)
    mapped = any(layer.thickness_mm is None for layer in settings.layers)
    depth = read_thickness(surfaces / THICKNESS, anatomy.skin) if mapped else None
    return anatomy, base_mesh(anatomy, settings, depth)


def mesh_settings(study: Study) -> MeshSettings:
    """How the site meshes of a study are made."""
    table, geometry = study.mesh, study.geometry
    return MeshSettings(
        element=table.cell_type,
        edge_near_mm=table.edge_near_mm,
        edge_far_mm=table.edge_far_mm,
        near_radius_mm=table.near_radius_mm,
        growth=table.growth,
        flatness=table.flatness,
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


def coarse_settings(study: Study) -> MeshSettings | None:
    """How the second, coarse meshes are made; None where the study wants none."""
    table = study.mesh.coarse
    return None if table is None else replace(mesh_settings(study), **table.model_dump())


def run_mesh(context: Context, folder: Path) -> dict[str, Any]:
    """One graded mesh per site, and a coarse one where the study wants it; side by side.

    Meshes of an interrupted run are kept.
    """
    study = context.study
    content = _make_meshes(context, folder, mesh_settings(study), "")
    coarse = coarse_settings(study)
    if coarse is not None:
        (folder / COARSE).mkdir(exist_ok=True)
        content["coarse"] = _make_meshes(context, folder / COARSE, coarse, "coarse, ")
    write_json(folder / "mesh.json", content)
    for facts in (*folder.glob("*.vtu"), *folder.glob(f"{COARSE}/*.vtu")):
        facts.with_suffix(".json").unlink()
    return {}


def _make_meshes(context: Context, folder: Path, settings: MeshSettings, word: str) -> dict[str, Any]:
    """The meshes of all sites that are not there yet; returns what ``mesh.json`` holds of all."""
    sites = context.stored("sites", "sites.json")["sites"]
    jobs = [
        mesh_job(
            context,
            site["site"],
            site["position_mm"],
            site["axis"],
            settings,
            folder / f"{site['site']}.vtu",
        )
        for site in sites
    ]
    facts = {job.site: read_json(job.file.with_suffix(".json")) for job in jobs if _is_meshed(job)}
    missing = [job for job in jobs if job.site not in facts]
    context.tell("mesh", len(facts), len(jobs), word.removesuffix(", "))
    for job, made in zip(missing, context.executor.map(make_mesh, missing), strict=True):
        facts[job.site] = made
        context.tell("mesh", len(facts), len(jobs), f"{word}site {job.site}: {made['nodes']} nodes")
    return {"settings": asdict(settings), "sites": {job.site: facts[job.site] for job in jobs}}


def _is_meshed(job: MeshJob) -> bool:
    return job.file.is_file() and job.file.with_suffix(".json").is_file()
