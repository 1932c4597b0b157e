"""The routes of the view Model: surfaces, meshes and sites, and the changes of sites in the study file."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field

from . import scene
from .editing import add_site, remove_site, set_site
from .study_routes import Folder

router = APIRouter(prefix="/api/model")
Coordinate = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
Place = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Text = Annotated[str, Field(max_length=200)]


class StrictModel(BaseModel):
    model_config = ConfigDict(extra="forbid")


class NewSite(StrictModel):
    """A site that a click places; without a record it is one to be simulated, to ``depth_mm``."""

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


def _respond_block(content: bytes) -> Response:
    return Response(content, media_type="application/octet-stream")


@router.get("/scene")
def get_scene(folder: Folder) -> dict[str, Any]:
    """Surfaces, sites and meshes as they stand."""
    return scene.describe_scene(folder)


@router.get("/surface/{name}")
def get_surface(folder: Folder, name: str) -> Response:
    """A surface as a block of arrays (see limbfit/web/arrays.py)."""
    return _respond_block(scene.build_surface_block(folder, name))


@router.get("/layer/{site}/{layer}")
def get_layer(folder: Folder, site: str, layer: str) -> Response:
    """The inner face of a layer, of a site's mesh."""
    return _respond_block(scene.build_layer_block(folder, site, layer))


@router.get("/mesh/{site}")
def get_mesh(folder: Folder, site: str) -> Response:
    """The mesh of a site with the quality of its cells."""
    return _respond_block(scene.mesh_block(folder, site))


@router.post("/sites")
def post_site(folder: Folder, site: NewSite) -> dict[str, Any]:
    """Add a site on the skin; the scene as it is afterwards."""
    position = scene.project_to_skin_of_study(folder, site.position)
    more = {"region": site.region or None, "depth_mm": site.depth_mm}
    add_site(folder.file, site.name, position, {key: value for key, value in more.items() if value})
    return scene.describe_scene(folder)


@router.post("/sites/{name}")
def post_change(folder: Folder, name: str, change: SiteChange) -> dict[str, Any]:
    """Move, rename or describe a site, or switch fitted; the scene as it is afterwards."""
    values: dict[str, Any] = change.model_dump(exclude_none=True)
    if change.position is not None:
        scene.check_movable(folder.load(), name)
        values["position"] = scene.project_to_skin_of_study(folder, change.position)
    if values:
        set_site(folder.file, name, values)
    return scene.describe_scene(folder)


@router.post("/sites/{name}/remove")
def post_removal(folder: Folder, name: str) -> dict[str, Any]:
    """Take a site out of the study file; its record stays."""
    remove_site(folder.file, name)
    return scene.describe_scene(folder)
