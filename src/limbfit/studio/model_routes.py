"""The view Model: surfaces, meshes and sites of the limb, and changes of sites in the study file."""

import tomllib
from collections.abc import Sequence
from functools import lru_cache
from itertools import count
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Body, Response
from pydantic import Field

from ..anatomy.sites.sites import find_markers, project_to_skin
from ..anatomy.surfaces.surfaces import Anatomy, load_anatomy, read_surface
from ..errors import InputError, SiteError
from ..mesh import read_vtu
from ..pipeline.engine.digests import compute_digest
from ..pipeline.engine.store import MARKED_SKIN
from ..pipeline.limb.sites import place_site
from ..pipeline.limb.surfaces import read_given_anatomy
from ..results.limb import MeshResult, PlacedSite, SitesResult
from ..study import Site, Study
from ..web import build_patient_frame, compute_cell_quality, extract_interface, to_volume_shape
from .editing import add_site, remove_table, set_site
from .folder import Json, StudyFolder, compute_fingerprint
from .study_routes import Folder, StrictModel, respond_block

router = APIRouter(prefix="/api/model")
SKIN = "skin"
MARKER_REACH_MM = 10.0  # of a site: a marker within it is that site's
Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Place = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Text = Annotated[str, Field(max_length=200)]


class NewSite(StrictModel):
    """A site that a click places; it has no record and is simulated to ``depth_mm``."""

    name: Text
    position: Place
    region: Text = ""
    depth_mm: Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]


class SiteChange(StrictModel):
    """What changes of a site; what is not given stays."""

    name: Text | None = None
    region: Text | None = None
    fitted: bool | None = None
    position: Place | None = None


@router.get("/scene")
def get_scene(folder: Folder) -> Json:
    """Surfaces by name, the patient's sides, every site as the study file has it now, and what is meshed.

    A site without a place (not matched to a marker yet, or off the skin) has ``problem`` in words. Surfaces
    and meshes come with fingerprints, so that the page reads again only what was made anew.
    """
    study = folder.load()
    anatomy = read_anatomy(folder, study)
    stored = SitesResult.find(folder.results)
    placed = {row.site: row for row in stored.sites} if stored else {}
    meshed = MeshResult.find(folder.results)
    meshes = {site.name: folder.results / "mesh" / f"{site.name}.vtu" for site in study.sites}
    return {
        "surfaces": {} if anatomy is None else _compute_fingerprints(folder, study, anatomy),
        "frame": build_patient_frame(None if anatomy is None else anatomy.cut_normal).tolist(),
        "sites": [_describe_site(site, study, anatomy, placed.get(site.name)) for site in study.sites],
        "meshes": {name: compute_fingerprint([file]) for name, file in meshes.items() if file.is_file()},
        "layers": [layer.name for layer in study.geometry.model_layers],
        "quality": meshed.sites if meshed else {},
    }


@router.get("/surface/{name}")
def get_surface(folder: Folder, name: str) -> Response:
    """A surface as a block of ``points`` and ``faces``; `InputError` for a name that the model has not."""
    anatomy = read_anatomy(folder, folder.load())
    surface = {SKIN: anatomy.skin, **anatomy.bones}.get(name) if anatomy else None
    if surface is None:
        raise InputError("the model has no such surface", remedy="run the stages until surfaces")
    points, faces = surface.points.astype(np.float32), surface.faces.astype(np.uint32)
    return respond_block({"points": points, "faces": faces})


@router.get("/layer/{site}/{layer}")
def get_layer(folder: Folder, site: str, layer: str) -> Response:
    """The inner face of a layer in the mesh of a site, as a block of arrays: ``points``, ``faces``."""
    mesh = read_vtu(folder.artefact("mesh", f"{site}.vtu"))
    if layer not in mesh.region_names[:-1]:
        raise InputError("the mesh has no such layer", remedy="make the meshes again")
    face = extract_interface(to_volume_shape(mesh), mesh.region_names.index(layer))
    return respond_block({"points": face.points, "faces": face.faces})


@router.get("/mesh/{site}")
def get_mesh(folder: Folder, site: str) -> Response:
    """A site's mesh as arrays of `VolumeShape`, the quality of each cell, and the names of regions."""
    mesh = read_vtu(folder.artefact("mesh", f"{site}.vtu"))
    facts = {"regions": list(mesh.region_names), "element": mesh.cell_type, "cells": len(mesh.cells)}
    return respond_block({**to_volume_shape(mesh).arrays(), **compute_cell_quality(mesh)}, facts)


@router.post("/sites")
def post_site(folder: Folder, site: NewSite) -> Json:
    """Add a site on the skin; returns the changed scene."""
    position = project_to_skin_of_study(folder, site.position)
    region = {"region": site.region} if site.region else {}
    add_site(folder.file, site.name, {"position": position, **region, "depth_mm": site.depth_mm})
    return get_scene(folder)


@router.post("/markers")
def post_markers(folder: Folder, depth_mm: Annotated[float, Body(embed=True, gt=0, le=100)]) -> Json:
    """Add a site at every marker on the skin that has none yet, highest first; returns the changed scene."""
    study = folder.load()
    anatomy, marked = read_anatomy(folder, study), folder.results / "segment" / MARKED_SKIN
    if anatomy is None or not marked.is_file():
        remedy = "state image.markers, and run until surfaces"
        raise InputError("no skin with markers is known", remedy=remedy)
    places = [site.position or site.near for site in study.sites]
    numbers = (name for n in count(1) if (name := f"{n:02d}") not in {site.name for site in study.sites})
    for marker in find_markers(read_surface(marked), anatomy.skin):
        if all(np.linalg.norm(marker.position - place) > MARKER_REACH_MM for place in places if place):
            add_site(folder.file, next(numbers), {"near": marker.position.tolist(), "depth_mm": depth_mm})
    return get_scene(folder)


@router.post("/sites/{name}")
def post_change(folder: Folder, name: str, change: SiteChange) -> Json:
    """Move, rename or describe a site, or change whether it is fitted; returns the changed scene."""
    values: Json = change.model_dump(exclude_none=True)
    if change.position is not None:
        _check_movable(folder.load(), name)
        values["position"] = project_to_skin_of_study(folder, change.position)
    if values:
        set_site(folder.file, name, values)
    return get_scene(folder)


@router.post("/sites/{name}/remove")
def post_removal(folder: Folder, name: str) -> Json:
    """Take a site out of the study file; its record stays."""
    remove_table(folder.file, "sites", name)
    return get_scene(folder)


def read_anatomy(folder: StudyFolder, study: Study) -> Anatomy | None:
    """The stored surfaces, else those that the study gives; None where the image is not segmented yet."""
    return _read_cached_anatomy(folder, compute_surfaces_fingerprint(folder, study))


def compute_surfaces_fingerprint(folder: StudyFolder, study: Study) -> str:
    """A text that changes with the files of the limb's surfaces and with what the study says of them."""
    given, geometry = study.surfaces, study.geometry
    files = [] if given is None else [given.skin, *given.bones.values()]
    files += [region.surface for region in geometry.regions if region.surface is not None]
    stored = sorted((folder.results / "surfaces").glob("*"))
    settings = compute_digest(*(table and table.model_dump(mode="json") for table in (given, geometry)))
    return f"{compute_fingerprint([*stored, *map(study.path, files)])} {settings}"


@lru_cache(maxsize=1)
def _read_cached_anatomy(folder: StudyFolder, fingerprint: str) -> Anatomy | None:
    """The last anatomy is kept, by its ``fingerprint``: to mend and check given surfaces can take seconds."""
    study = folder.load()
    if _has_made_surfaces(folder):
        return load_anatomy(folder.results / "surfaces")
    return None if study.surfaces is None else read_given_anatomy(study)[0]


def project_to_skin_of_study(folder: StudyFolder, position: Sequence[float]) -> list[float]:
    """The point of the skin nearest to a place (LPS, mm); `InputError` where there is none near it."""
    anatomy = read_anatomy(folder, folder.load())
    if anatomy is None:
        raise InputError("there is no skin yet to place a site on", remedy="run the stages until surfaces")
    point, _ = project_to_skin(anatomy, position)
    return [float(value) for value in point]


def _compute_fingerprints(folder: StudyFolder, study: Study, anatomy: Anatomy) -> dict[str, str]:
    given = study.surfaces
    if given is None or _has_made_surfaces(folder):
        files = {SKIN: folder.artefact("surfaces", "skin.stl")}
        files |= {name: folder.artefact("surfaces", f"bone-{name}.stl") for name in anatomy.bones}
    else:
        files = {name: study.path(file) for name, file in {SKIN: given.skin, **given.bones}.items()}
    return {name: compute_fingerprint([file]) for name, file in files.items()}


def _has_made_surfaces(folder: StudyFolder) -> bool:
    return (folder.results / "surfaces" / "surfaces.json").is_file()


def _describe_site(site: Site, study: Study, anatomy: Anatomy | None, placed: PlacedSite | None) -> Json:
    row: Json = {
        **site.model_dump(include={"name", "region", "fitted", "depth_mm"}),
        "has_trace": bool(study.records_at(site)),
        "records": [record.name for record in study.records_at(site)],
        "given": "position" if site.position is not None else "near",
        "position_mm": None,
        "axis": None,
        "problem": None,
    }
    try:
        if site.position is not None:
            placed = None if anatomy is None else place_site(site, study, anatomy, None)
        if placed is None:
            row["problem"] = "not on the skin yet: run the stages until sites"
        else:
            row |= placed.model_dump(include={"position_mm", "axis", "off_skin_mm", "marker"}, mode="json")
    except SiteError as error:
        row["problem"] = error.what
    return row


def _check_movable(study: Study, name: str) -> None:
    """Refuse to move an unknown site, or one that the markups file places, by an `InputError`."""
    site = study.site(name)
    if study.markups is None:
        return
    for row in tomllib.loads(study.file.read_text(encoding="utf-8-sig")).get("sites", []):
        if str(row.get("name")) == site.name and ("position" in row or "near" in row):
            return
    what = f"site {name} has its place from the markups file {study.markups.file}"
    remedy = "move its control point in 3D Slicer"
    raise InputError(what, file=study.file, place="markups", remedy=remedy)
