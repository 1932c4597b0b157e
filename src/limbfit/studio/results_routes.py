"""The routes of the view Results: fields to play, tables, runs to compare, files to keep."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field

from . import outcome, playback, simulating
from .study_routes import Folder

router = APIRouter(prefix="/api/results")


class Name(BaseModel):
    """What a run is kept as."""

    model_config = ConfigDict(extra="forbid")
    name: Annotated[str, Field(min_length=1, max_length=40)]


def _respond_block(content: bytes) -> Response:
    return Response(content, media_type="application/octet-stream")


@router.get("")
def get_outcome(folder: Folder, kept: str | None = None) -> dict[str, Any]:
    """Parameters and errors of this run or of a kept one; kept runs; files to keep."""
    return {
        **outcome.collect_outcome(folder, kept),
        "kept": outcome.list_kept_runs(folder),
        "downloads": outcome.list_downloads(folder),
    }


@router.get("/site/{site}")
def get_site(folder: Folder, site: str) -> dict[str, Any]:
    """What can be shown of a site, its files, and how a simulation of it goes."""
    return {
        "sources": playback.list_sources(folder, folder.load().indentation(site).name),
        "downloads": outcome.list_site_downloads(folder, site),
        "simulating": simulating.find_simulating(folder),
        "failure": simulating.read_failure(folder, site),
    }


@router.get("/curves/{site}")
def get_curves(folder: Folder, site: str, kept: str | None = None) -> dict[str, list[float]]:
    """Predicted forces of a site, of this run or of a kept one."""
    return outcome.read_site_curves(folder, site, kept)


@router.get("/mesh/{source}/{site}")
def get_mesh(folder: Folder, source: str, site: str) -> Response:
    """The mesh that the fields of a site stand on, as a block of arrays."""
    return _respond_block(playback.mesh_block(folder, source, site))


@router.get("/moment/{source}/{site}/{moment}/{field}")
def get_moment(folder: Folder, source: str, site: str, moment: int, field: str) -> Response:
    """Displacements and a field at one moment, as a block of arrays."""
    return _respond_block(playback.build_moment_block(folder, source, site, moment, field))


@router.post("/simulate/{site}")
def post_simulation(folder: Folder, site: str) -> dict[str, Any]:
    """Start ``limbfit simulate --animation`` for a site."""
    return simulating.start_simulation(folder, site)


@router.post("/stop")
def post_stop(folder: Folder) -> dict[str, Any]:
    """Interrupt the simulation."""
    return simulating.stop_simulation(folder)


@router.post("/feb/{site}")
def post_feb(folder: Folder, site: str) -> dict[str, str]:
    """Write the FEBio input of a site."""
    return outcome.write_feb_of(folder, site)


@router.post("/keep")
def post_kept(folder: Folder, run: Name) -> dict[str, Any]:
    """Keep this run for comparison."""
    return outcome.keep_run(folder, run.name)


@router.post("/drop")
def post_drop(folder: Folder, run: Name) -> dict[str, Any]:
    """Remove a kept run."""
    outcome.drop_run(folder, run.name)
    return {}
