"""The experiment ``sensitivity-mesh``: is the force independent of the mesh?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...indentation import Simulation
from ...results.variants import RefinedSite, RefinementResult, RefinementRun
from ...study import Study
from ..engine.context import Context
from ..engine.digests import compute_file_digest
from ..limb.mesh import make_mesh, mesh_job, mesh_settings, read_mesh_facts, scale_edges
from ..simulation.extrapolation import MESH_ORDERS, extrapolate_richardson
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import open_experiment_cache
from .sensitivity import read_identified_parameters, store_runs
from .variants import (
    ChosenSite,
    Variant,
    check_variants,
    choose_sites,
    compare_variants,
    run_variants,
    write_variants,
)

FACTORS = (1.4, 1.0, 0.7)  # of the edge lengths of the study's meshes
FARTHEST = 0.1  # of the force on the finest mesh: a limit farther away is no limit


def check_refinement(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse one mesh alone, and what `check_variants` does.

    Raises
    ------
    InputError
    """
    check_variants(study, limb, options)
    wanted = _choose_factors(options["factors"])
    if len(wanted) < 2 or wanted[-1] <= 0.0:
        raise InputError("one mesh cannot be compared", place="factors", remedy="give another edge length")


def _choose_factors(given: Sequence[float]) -> list[float]:
    """Of the edges, the coarsest first; the study's own among them."""
    return sorted({1.0, *map(float, given)}, reverse=True)


def run_refinement(
    context: Context, folder: Path, *, sites: Sequence[str], factors: Sequence[float]
) -> dict[str, Any]:
    """Force at sites on meshes whose edges are ``factors`` times the study's, and what it tends to."""
    wanted = _choose_factors(factors)
    parameters = read_identified_parameters(context)
    chosen = choose_sites(context, sites)
    facts = _make_meshes(context, folder, chosen, wanted)
    variants = [
        Variant(
            one,
            replace(one.model, mesh=file, mesh_digest=compute_file_digest(file)),
            parameters,
            f"edge x {factor:g}",
            facts[one.name, factor],
            base=factor == 1.0,
        )
        for one in chosen
        for factor in wanted
        for file in [_find_file(context, folder, one, factor)]
    ]
    simulations = run_variants(context, "sensitivity-mesh", open_experiment_cache(context, folder), variants)
    write_variants(folder, variants, simulations)
    content = RefinementResult(
        sites=[RefinedSite(**dict(one.summary), **_find_limit(one, variants, simulations)) for one in chosen],
        runs=compare_variants(variants, simulations, RefinementRun),
        parameters=parameters,
    )
    store_runs(folder, content, content.runs)
    return {}


def _find_file(context: Context, folder: Path, one: ChosenSite, factor: float) -> Path:
    return one.model.mesh if factor == 1.0 else folder / f"{one.site.name}-{factor:g}.vtu"


def _make_meshes(
    context: Context, folder: Path, chosen: Sequence[ChosenSite], factors: Sequence[float]
) -> dict[tuple[str, float], dict[str, Any]]:
    """Make the meshes that are not there yet; what is told of each, by site and factor."""
    study, stored = context.study, context.results.mesh.sites
    settings = mesh_settings(study)
    pairs = [(one, factor) for one in chosen for factor in factors]
    jobs = {
        (one.name, factor): mesh_job(
            context,
            one.site.name,
            one.model.position,
            one.model.axis,
            scale_edges(settings, factor),
            _find_file(context, folder, one, factor),
        )
        for one, factor in pairs
        if factor != 1.0
    }
    missing = [job for job in dict.fromkeys(jobs.values()) if not job.file.with_suffix(".json").is_file()]
    for i, made in enumerate(context.executor.map(make_mesh, missing)):
        context.tell("sensitivity-mesh", i + 1, len(missing), f"mesh of {made.nodes} nodes")
    found = {}
    for one, factor in pairs:
        job = jobs.get((one.name, factor))
        known = stored[one.site.name] if job is None else read_mesh_facts(job.file)
        found[one.name, factor] = {
            "factor": factor,
            "edge_near_mm": factor * settings.edge_near_mm,
            "element": settings.element,
            "nodes": known.nodes,
            "cells": known.cells,
        }
    return found


def _find_limit(
    one: ChosenSite, variants: Sequence[Variant], simulations: Sequence[Simulation]
) -> dict[str, Any]:
    """The largest force that the meshes of a site tend to, and how far the study's mesh is from it.

    Nothing where they do not tend to anything yet. With an element whose forces do not change in one
    direction, the limit is the finest mesh's force, at no order.
    """
    done = {
        float(variant.facts["edge_near_mm"]): float(simulation.force_N.max())
        for variant, simulation in zip(variants, simulations, strict=True)
        if variant.chosen is one and simulation.completed
    }
    own = next(v for v in variants if v.chosen is one and v.base)
    edge = float(own.facts["edge_near_mm"])
    nothing = dict.fromkeys(("limit_N", "order", "order_measured", "error_percent"))
    if len(done) < 2 or edge not in done:
        return nothing
    found = extrapolate_richardson(list(done), list(done.values()), MESH_ORDERS[own.facts["element"]])
    finest = done[min(done)]
    if abs(found.limit - finest) > FARTHEST * finest:
        return nothing
    return {
        "limit_N": found.limit,
        "order": found.order,
        "order_measured": found.measured,
        "error_percent": found.error_percent(done[edge]),
    }
