"""What the view Model shows: surfaces, places of sites, meshes; and places that a click gives."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..anatomy.sites.sites import project_to_skin
from ..anatomy.surfaces.surfaces import Anatomy, Surface, load_anatomy, read_surface
from ..errors import InputError, SiteError
from ..mesh import read_vtu
from ..pipeline.engine.storage import compute_digest
from ..pipeline.limb.sites import place_site
from ..pipeline.limb.surfaces import read_given_anatomy
from ..results.limb import PlacedSite, SitesResult
from ..study import Site, Study
from ..web.arrays import pack
from ..web.shapes import Shell, build_patient_frame, compute_cell_quality, extract_interface, to_volume_shape
from .folder import StudyFolder, compute_fingerprint, read_stored

SKIN = "skin"


def read_anatomy(folder: StudyFolder, study: Study) -> Anatomy | None:
    """The stored surfaces, else those that the study gives; None where the image is not segmented yet."""
    return _read_marked_anatomy(folder, mark_surfaces(folder, study))


def mark_surfaces(folder: StudyFolder, study: Study) -> str:
    """Changes with the files of the limb's surfaces and with what the study says of them."""
    given, geometry = study.surfaces, study.geometry
    files = [] if given is None else [given.skin, *given.bones.values()]
    files += [one.surface for one in geometry.regions if one.surface is not None]
    made = sorted((folder.results / "surfaces").glob("*"))
    stated = compute_digest(*(one and one.model_dump(mode="json") for one in (given, geometry)))
    return f"{compute_fingerprint([*made, *map(study.path, files)])} {stated}"


@lru_cache(maxsize=1)
def _read_marked_anatomy(folder: StudyFolder, mark: str) -> Anatomy | None:
    """The last one is kept, by its ``mark``: to mend and check given surfaces can take seconds."""
    study = folder.load()
    if _is_made(folder):
        return load_anatomy(folder.results / "surfaces")
    return None if study.surfaces is None else read_given_anatomy(study)[0]


def describe_scene(folder: StudyFolder) -> dict[str, Any]:
    """Surfaces by name, the patient's sides, every site as the study file has it now, and what is meshed.

    A site without a place (not matched to a marker yet, or off the skin) has ``problem`` in words. Surfaces
    and meshes come with fingerprints, so that the page reads again only what was made anew.
    """
    study = folder.load()
    anatomy = read_anatomy(folder, study)
    stored = SitesResult.find(folder.results)
    placed = {row.site: row for row in stored.sites} if stored else {}
    meshes = read_stored(folder.results / "mesh" / "mesh.json")
    return {
        "surfaces": {} if anatomy is None else _mark_each_surface(folder, study, anatomy),
        "frame": build_patient_frame(None if anatomy is None else anatomy.cut_normal).tolist(),
        "sites": [_describe_site(site, study, anatomy, placed.get(site.name)) for site in study.sites],
        "meshes": {
            site.name: compute_fingerprint([file])
            for site in study.sites
            if (file := _mesh_file(folder, site.name)) is not None
        },
        "layers": [layer.name for layer in study.geometry.model_layers],
        "quality": meshes.get("sites", {}),
    }


def _mark_each_surface(folder: StudyFolder, study: Study, anatomy: Anatomy) -> dict[str, str]:
    if _is_made(folder):
        files = {name: _find_surface_file(folder, name) for name in (SKIN, *anatomy.bones)}
    else:
        assert study.surfaces is not None
        files = {SKIN: study.surfaces.skin, **study.surfaces.bones}
        files = {name: study.path(file) for name, file in files.items()}
    return {name: compute_fingerprint([file]) for name, file in files.items()}


def _is_made(folder: StudyFolder) -> bool:
    return (folder.results / "surfaces" / "surfaces.json").is_file()


def _find_surface_file(folder: StudyFolder, name: str) -> Path:
    return folder.artefact("surfaces", f"{name}.stl" if name == SKIN else f"bone-{name}.stl")


def _mesh_file(folder: StudyFolder, site: str) -> Path | None:
    file = folder.results / "mesh" / f"{site}.vtu"
    return file if file.is_file() else None


def _describe_site(
    site: Site, study: Study, anatomy: Anatomy | None, placed: PlacedSite | None
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "name": site.name,
        "region": site.region,
        "fitted": site.fitted,
        "has_trace": bool(study.records_at(site)),
        "records": [record.name for record in study.records_at(site)],
        "depth_mm": site.depth_mm,
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


def build_surface_block(folder: StudyFolder, name: str) -> bytes:
    """One surface as a block of arrays: ``points``, ``faces``.

    Raises
    ------
    InputError
        For a name that the model does not have.
    """
    surface = _read_one_surface(folder, name)
    if surface is None:
        raise InputError("the model has no such surface", remedy="run the stages until surfaces")
    return _build_shell_block(Shell(surface.points.astype(np.float32), surface.faces.astype(np.uint32)))


def _read_one_surface(folder: StudyFolder, name: str) -> Surface | None:
    """One surface; of stored ones only its file is read."""
    if _is_made(folder):
        bones = read_stored(folder.results / "surfaces" / "surfaces.json").get("bones", ())
        return read_surface(_find_surface_file(folder, name)) if name == SKIN or name in bones else None
    anatomy = read_anatomy(folder, folder.load())
    return None if anatomy is None else {SKIN: anatomy.skin, **anatomy.bones}.get(name)


def _build_shell_block(shell: Shell) -> bytes:
    return pack({"points": shell.points, "faces": shell.faces})


def build_layer_block(folder: StudyFolder, site: str, layer: str) -> bytes:
    """The inner face of a layer in the mesh of a site, as a block of arrays: ``points``, ``faces``."""
    mesh = read_vtu(folder.artefact("mesh", f"{site}.vtu"))
    if layer not in mesh.region_names[:-1]:
        raise InputError("the mesh has no such layer", remedy="make the meshes again")
    return _build_shell_block(extract_interface(to_volume_shape(mesh), mesh.region_names.index(layer)))


def mesh_block(folder: StudyFolder, site: str) -> bytes:
    """The mesh of a site: the arrays of `Volume` and the quality of each cell; ``regions`` are its names."""
    mesh = read_vtu(folder.artefact("mesh", f"{site}.vtu"))
    facts = {"regions": list(mesh.region_names), "element": mesh.cell_type, "cells": len(mesh.cells)}
    return pack({**to_volume_shape(mesh).arrays(), **compute_cell_quality(mesh)}, facts)


def project_to_skin_of_study(folder: StudyFolder, position: Sequence[float]) -> list[float]:
    """The point of the skin nearest to a place (LPS, mm).

    Raises
    ------
    InputError
        Where there is no skin, or the place is far off it.
    """
    study = folder.load()
    anatomy = read_anatomy(folder, study)
    if anatomy is None:
        raise InputError("there is no skin yet to place a site on", remedy="run the stages until surfaces")
    point, _ = project_to_skin(anatomy, position)
    return [float(value) for value in point]


def check_movable(study: Study, name: str) -> None:
    """Raise where a site's place is not the study file's to change.

    Raises
    ------
    InputError
        For a site that is placed by the markups file, or an unknown one.
    """
    site = study.site(name)
    markups = study.markups
    if markups is None:
        return
    if not _read_stated_places(study.file).get(site.name, False):
        raise InputError(
            f"site {name} has its place from the markups file {markups.file}",
            file=study.file,
            place="markups",
            remedy="move its control point in 3D Slicer",
        )


def _read_stated_places(file: Path) -> dict[str, bool]:
    """Whether each site of a study file has a place of its own there."""
    sites = tomllib.loads(file.read_text(encoding="utf-8")).get("sites", [])
    return {str(site.get("name")): "position" in site or "near" in site for site in sites}
