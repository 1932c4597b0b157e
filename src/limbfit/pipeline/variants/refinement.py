"""The experiment ``sensitivity-mesh``: is the force independent of the mesh?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...indentation import Parameters, Simulation
from ...results.variants import RefinedSite, RefinementResult, RefinementRun
from ...study import Study
from ..engine.context import Context
from ..limb.mesh import mesh_job, mesh_settings, read_mesh_facts, scale_edges
from ..limb.remesh import mesh_models
from ..simulation.extrapolation import MESH_ORDERS, extrapolate_richardson
from ..simulation.limb_geometry import LimbGeometry
from .variants import (
    ChosenSite,
    Variant,
    check_variants,
    choose_sites,
    compare_variants,
    simulate_variants,
    store_variants,
)

FACTORS = (1.4, 1.0, 0.7)  # of the edge lengths of the study's meshes
FARTHEST = 0.1  # of the force on the finest mesh: a limit farther away is no limit


def check_refinement(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse one mesh alone, and what `check_variants` does."""
    check_variants(study, limb, options)
    wanted = _choose_factors(options["factors"])
    if len(wanted) < 2 or wanted[-1] <= 0.0:
        raise InputError("one mesh cannot be compared", place="factors", remedy="give another edge length")


def _choose_factors(given: Sequence[float]) -> list[float]:
    """Of the edges, the coarsest first; the study's own among them."""
    return sorted({1.0, *map(float, given)}, reverse=True)


def run_refinement(context: Context, folder: Path, *, sites: Sequence[str], factors: Sequence[float]) -> None:
    """Force at sites on meshes whose edges are ``factors`` times the study's, and what it tends to."""
    parameters, chosen = context.results.calibration.parameters, choose_sites(context, sites)
    variants = _build_variants(context, folder, chosen, _choose_factors(factors), parameters)
    simulations = simulate_variants(context, folder, RefinementResult, variants)
    refined = [RefinedSite(**dict(one.summary), **_find_limit(one, variants, simulations)) for one in chosen]
    runs = compare_variants(variants, simulations, RefinementRun)
    store_variants(context, folder, RefinementResult, runs, sites=refined)


def _build_variants(
    context: Context,
    folder: Path,
    chosen: Sequence[ChosenSite],
    factors: Sequence[float],
    parameters: Parameters,
) -> list[Variant]:
    """Each site on each mesh; those that are not there yet are made."""
    settings, stored = mesh_settings(context.study), context.results.mesh.sites
    others = [(one.model, factor) for one in chosen for factor in factors if factor != 1.0]
    jobs = [
        mesh_job(
            context,
            model.site,
            model.position,
            model.axis,
            scale_edges(settings, factor),
            folder / f"{model.site}-{factor:g}.vtu",
        )
        for model, factor in others
    ]
    report = partial(context.tell, "sensitivity-mesh", 0, 0)
    meshed = iter(mesh_models(jobs, [model for model, _ in others], context.executor, report))
    variants = []
    for one in chosen:
        for factor in factors:
            model = one.model if factor == 1.0 else next(meshed)
            known = stored[model.site] if factor == 1.0 else read_mesh_facts(model.mesh)
            facts = {
                "factor": factor,
                "edge_near_mm": factor * settings.edge_near_mm,
                "element": settings.element,
                "nodes": known.nodes,
                "cells": known.cells,
            }
            label = f"edge x {factor:g}"
            variants.append(Variant(one, model, parameters, label, facts, base=factor == 1.0))
    return variants


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
