"""Sites on other meshes than their own, for what the mesh or the geometry changes."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from ...errors import MeshingError
from ...execution import Executor, run_in_background
from ...indentation import SiteModel
from ..engine.digests import compute_file_digest
from .mesh import MeshJob, is_meshed, make_mesh

Report = Callable[[str], None]


@contextmanager
def mesh_in_background(jobs: Sequence[MeshJob], executor: Executor) -> Iterator[Callable[[], None]]:
    """Makes meshes beside the block, while a core is idle; with one worker none is.

    The block is given a function that waits for them.
    """
    missing = _select_missing(jobs)
    if not missing or executor.workers < 2:
        yield lambda: None
        return
    with run_in_background(_mesh_idly, missing) as wait:
        yield wait


def _mesh_idly(jobs: Sequence[MeshJob]) -> None:
    if hasattr(os, "nice"):  # not on Windows
        os.nice(19)
    for job in jobs:
        _try_mesh(job)  # why it cannot is told where the mesh is wanted


def mesh_models(
    jobs: Sequence[MeshJob], models: Sequence[SiteModel], executor: Executor, report: Report
) -> list[SiteModel]:
    """The models on the meshes planned for them (`plan_meshes`); those of an interrupted run are kept.

    ``report`` is given a line for each mesh.
    """
    missing = _select_missing(jobs)
    for job, _ in zip(missing, executor.map(make_mesh, missing), strict=True):
        report(f"mesh of site {job.site}, {job.file.parent.name}")
    return [_replace_mesh(model, job) for model, job in zip(models, jobs, strict=True)]


def mesh_where_possible(
    jobs: Sequence[MeshJob], models: Sequence[SiteModel], executor: Executor, report: Report, lost: str
) -> list[SiteModel | None]:
    """As `mesh_models`, but None for a site of which no such mesh can be made; a line says so, and that
    ``lost`` with it."""
    missing = _select_missing(jobs)
    for job, error in zip(missing, executor.map(_try_mesh, missing), strict=True):
        words = f"mesh of site {job.site}, {job.file.parent.name}"
        report(f"warning: {words}: {error}; {lost}" if error else words)
    pairs = zip(models, jobs, strict=True)
    return [_replace_mesh(model, job) if is_meshed(job.file) else None for model, job in pairs]


def _select_missing(jobs: Sequence[MeshJob]) -> list[MeshJob]:
    return [job for job in dict.fromkeys(jobs) if not is_meshed(job.file)]


def _try_mesh(job: MeshJob) -> str:
    """Why a mesh cannot be made; empty where it was."""
    try:
        make_mesh(job)
    except MeshingError as error:
        return str(error)
    return ""


def _replace_mesh(model: SiteModel, job: MeshJob) -> SiteModel:
    return replace(model, mesh=job.file, mesh_digest=compute_file_digest(job.file))
