"""Sites on other meshes than their own, for what the mesh or the geometry changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ...anatomy.meshing.meshing import MeshSettings
from ...indentation import SiteModel
from ..shared.context import Context
from ..shared.store import file_digest
from .mesh import is_meshed, make_mesh, mesh_job


def meshed_models(
    context: Context, folder: Path, models: Sequence[SiteModel], settings: MeshSettings, title: str
) -> list[SiteModel]:
    """The models on meshes of other settings, in ``folder``; those of an interrupted run are kept.

    ``title`` is the stage or experiment that is told of progress.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [
        mesh_job(context, model.site, model.position, model.axis, settings, folder / f"{model.site}.vtu")
        for model in models
    ]
    missing = [job for job in dict.fromkeys(jobs) if not is_meshed(job.file)]
    for job, _ in zip(missing, context.executor.map(make_mesh, missing), strict=True):
        context.tell(title, 0, 0, f"mesh of site {job.site}, {folder.name}")
    return [
        replace(model, mesh=job.file, mesh_digest=file_digest(job.file)) for model, job in zip(models, jobs)
    ]


def scaled_edges(settings: MeshSettings, factor: float) -> MeshSettings:
    """The same with edges ``factor`` times as long."""
    near, far = factor * settings.edge_near_mm, factor * settings.edge_far_mm
    return replace(settings, edge_near_mm=near, edge_far_mm=far)
