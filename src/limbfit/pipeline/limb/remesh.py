"""Sites on other meshes than their own, for what the mesh or the geometry changes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from ...anatomy.meshing.meshing import MeshSettings
from ...errors import MeshingError
from ...execution import run_in_background
from ...indentation import SiteModel
from ..engine.context import Context
from ..engine.storage import compute_file_digest
from .mesh import MeshJob, is_meshed, make_mesh, mesh_job

Report = Callable[[str], None]


def mesh_models(
    context: Context, folder: Path, models: Sequence[SiteModel], settings: MeshSettings, report: Report
) -> list[SiteModel]:
    """The models on meshes of other settings, in ``folder``; those of an interrupted run are kept.

    ``report`` is given a line for each mesh.
    """
    jobs = _build_jobs(context, folder, models, settings)
    missing = _select_missing(jobs)
    for job, _ in zip(missing, context.executor.map(make_mesh, missing), strict=True):
        report(f"mesh of site {job.site}, {folder.name}")
    return [_replace_mesh(model, job) for model, job in zip(models, jobs, strict=True)]


def mesh_where_possible(
    context: Context,
    folder: Path,
    models: Sequence[SiteModel],
    settings: MeshSettings,
    report: Report,
    lost: str,
) -> list[SiteModel | None]:
    """As `mesh_models`, but None for a site of which no such mesh can be made; a line says so, and that
    ``lost`` with it."""
    jobs = _build_jobs(context, folder, models, settings)
    missing = _select_missing(jobs)
    for job, error in zip(missing, context.executor.map(_try_mesh, missing), strict=True):
        words = f"mesh of site {job.site}, {folder.name}"
        report(f"warning: {words}: {error}; {lost}" if error else words)
    pairs = zip(models, jobs, strict=True)
    return [_replace_mesh(model, job) if is_meshed(job.file) else None for model, job in pairs]


def _replace_mesh(model: SiteModel, job: MeshJob) -> SiteModel:
    return replace(model, mesh=job.file, mesh_digest=compute_file_digest(job.file))


def _try_mesh(job: MeshJob) -> str:
    """Why a mesh cannot be made; empty where it was."""
    try:
        make_mesh(job)
    except MeshingError as error:
        return str(error)
    return ""


@contextmanager
def mesh_in_background(
    context: Context, folder: Path, models: Sequence[SiteModel], settings: MeshSettings
) -> Iterator[Callable[[], None]]:
    """Makes the meshes of `mesh_models` beside the block, while a core is idle; with one worker none is.

    The block is given a function that waits for them.
    """
    missing = _select_missing(_build_jobs(context, folder, models, settings))
    if not missing or context.executor.workers < 2:
        yield lambda: None
        return
    with run_in_background(_mesh_idly, missing) as wait:
        yield wait


def _mesh_idly(jobs: Sequence[MeshJob]) -> None:
    if hasattr(os, "nice"):  # not on Windows
        os.nice(19)
    for job in jobs:
        _try_mesh(job)  # why it cannot is told where the mesh is wanted


def _build_jobs(
    context: Context, folder: Path, models: Sequence[SiteModel], settings: MeshSettings
) -> list[MeshJob]:
    folder.mkdir(parents=True, exist_ok=True)
    return [
        mesh_job(context, model.site, model.position, model.axis, settings, folder / f"{model.site}.vtu")
        for model in models
    ]


def _select_missing(jobs: Sequence[MeshJob]) -> list[MeshJob]:
    return [job for job in dict.fromkeys(jobs) if not is_meshed(job.file)]


def scale_edges(settings: MeshSettings, factor: float) -> MeshSettings:
    """The same with edges ``factor`` times as long."""
    near, far = factor * settings.edge_near_mm, factor * settings.edge_far_mm
    return replace(settings, edge_near_mm=near, edge_far_mm=far)
