"""Site meshes at random sites of five limbs: failures, angles, thickness, volume, time."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..anatomy.meshing.engines import ENGINES
from ..anatomy.meshing.meshing import BaseMesh, MeshSettings, build_base_mesh, mesh_site
from ..anatomy.surfaces.surfaces import Anatomy
from ..errors import InputError, LimbfitError
from .limbs import draw_random_sites, list_limbs
from .reference import Tell, find_reference

SITES = 20
Row = dict[str, Any]


def bench_meshing(
    shared: Path | None = None,
    sites: int = SITES,
    engine: str = "mmg",
    *,
    settings: MeshSettings | None = None,
    tell: Tell,
    makers: Mapping[str, Callable[[], Anatomy]] | None = None,
) -> dict[str, Any]:
    """Mesh random sites of each limb and sum up.

    Parameters
    ----------
    shared : the folder with ``data`` and ``reference``; by default that here or above.
    sites : of each limb.
    engine : name of the mesher.
    settings : of the meshes; the defaults where not given.
    makers : other limbs than the five, by name.

    Returns
    -------
    dict
        ``sites``, ``failures``, ``min_dihedral_deg``, ``seconds_median`` (CPU seconds of a site's mesh, its
        mesher included) and more over all limbs; ``limbs`` has a summary of each, ``failed`` the messages.

    Raises
    ------
    InputError
        Where the real limbs are missing, or for an engine that is not in the table.
    """
    if engine not in ENGINES:
        raise InputError(f"no mesher is named {engine!r}", remedy=f"use one of {', '.join(ENGINES)}")
    settings = replace(settings or MeshSettings(), engine=engine)
    if makers is None:
        makers = list_limbs(shared or find_reference(Path.cwd()).parent)
    rows: list[Row] = []
    failed: list[str] = []
    seconds_base = {}
    for done, (name, make) in enumerate(makers.items()):
        tell(done * sites, len(makers) * sites, name)
        anatomy = make()
        start = measure_cpu_seconds()
        base = build_base_mesh(anatomy, settings)
        seconds_base[name] = measure_cpu_seconds() - start
        for i, (position, axis) in enumerate(draw_random_sites(anatomy, sites)):
            try:
                rows.append({"limb": name, **_measure_mesh(anatomy, position, axis, settings, base)})
            except LimbfitError as error:
                failed.append(f"{name}, site {i}: {error}")
            tell(done * sites + i + 1, len(makers) * sites, name)
    return {
        "engine": settings.engine,
        **_summarise(rows, failed),
        "base_seconds_median": float(np.median(list(seconds_base.values()))),
        "failed": failed,
        "limbs": {
            name: _summarise(
                [row for row in rows if row["limb"] == name],
                [text for text in failed if text.startswith(f"{name},")],
            )
            for name in makers
        },
    }


def _measure_mesh(anatomy: Anatomy, position: Any, axis: Any, settings: MeshSettings, base: BaseMesh) -> Row:
    start = measure_cpu_seconds()
    _, report = mesh_site(anatomy, position, axis, settings, base)
    return {
        "seconds": measure_cpu_seconds() - start,
        "nodes": report.nodes,
        "cells": report.cells,
        "dihedral": report.min_dihedral_deg,
        "error_mean": report.interface_error_mm["mean"],
        "error_max": report.interface_error_mm["max"],
        "thickness": report.layer_mean_mm,
        "thickness_std": report.layer_std_mm,
        "volume_error": report.volume_error,
    }


def _summarise(rows: list[Row], failed: list[str]) -> dict[str, Any]:
    summary: dict[str, Any] = {"sites": len(rows) + len(failed), "failures": len(failed)}
    if not rows:
        return summary
    column = {key: np.array([row[key] for row in rows]) for key in rows[0] if key != "limb"}
    return summary | {
        "min_dihedral_deg": float(column["dihedral"].min()),
        "median_of_min_dihedral_deg": float(np.median(column["dihedral"])),
        "nodes_median": float(np.median(column["nodes"])),
        "cells_median": float(np.median(column["cells"])),
        "cells_max": int(column["cells"].max()),
        "interface_error_mean_mm": float(column["error_mean"].mean()),
        "interface_error_max_mm": float(column["error_max"].max()),
        "thickness_mean_mm": float(column["thickness"].mean()),
        "thickness_std_mm": float(column["thickness_std"].mean()),
        "volume_error_max_percent": float(100 * np.abs(column["volume_error"]).max()),
        "seconds_median": float(np.median(column["seconds"])),
        "seconds_max": float(column["seconds"].max()),
    }


def measure_cpu_seconds() -> float:
    """CPU seconds of this process and of the mesher's processes that ended."""
    usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in usage)
