"""Experiments of sensitivity: how force depends on what a study cannot measure or has to choose.

Each takes the identified parameters, changes one thing, and simulates the chosen sites again: by default the
one with the thinnest and the one with the thickest tissue over bone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...fe import solve
from ...fe.observables import compute_element_fields
from ...indentation import Parameters, Simulation, SimulationJob, build_problem, build_steps, to_parameters
from ...mesh import read_vtu
from ...results import variants as stored
from ...shapes import BUILTIN_SHAPES, SHAPES
from ...study import IndenterTable, Study
from ..engine.context import Context
from ..identification.answer import MESH_ORDERS, extrapolate_richardson
from ..limb.mesh import mesh_job, mesh_settings, read_mesh_facts, scale_edges
from ..limb.remesh import mesh_models
from ..records.records import load_records
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import SimulationCache, open_experiment_cache
from .variants import (
    Variant,
    VariantRow,
    check_variants,
    choose_sites,
    measure_tissue_over_bone,
    run_variants,
)

NO_VOLUME: Mapping[str, float | None] = dict.fromkeys(("J_min", "J_low", "J_high", "J_max", "beyond_percent"))
ALLOWED = 0.01  # departure of J from one that the paper's bulk modulus is to keep to


def simulate_with_volumes(job: SimulationJob) -> Simulation:
    """As `indentation.simulate`, without derivatives; ``facts["volume"]`` says what became of the volumes.

    Of the elements within one width of the indenter from the site: ``J_min`` and ``J_max`` are means of
    single elements, ``J_low`` and ``J_high`` bound the middle 98 % of the volume, ``beyond_percent`` is the
    share of the volume whose J is more than 1 % from one.
    """
    model = job.model
    parameters = to_parameters(job.parameters, job.tissues, job.model.law)
    problem = build_problem(model, read_vtu(model.mesh), parameters)
    result, volumes = solve(problem, steps=build_steps(model), store="peak"), NO_VOLUME
    if result.states:
        J = compute_element_fields(result.system, problem.build_laws(), result.states[-1]).J
        centres = problem.mesh.points[problem.mesh.corners].mean(axis=1)
        near = np.linalg.norm(centres - np.array(model.position), axis=1) < model.indenter.width_mm
        volumes = summarise_volumes(J[near], result.system.weights.sum(axis=1)[near])
    return Simulation(
        site=model.name,
        force_N=result.force_at(np.array(job.times_s) + model.waits_s),
        jacobian=None,
        completed=result.completed,
        reason=result.reason,
        penetration_mm=float(result.penetration.max(initial=0.0)),
        facts=dict(result.statistics) | {"volume": dict(volumes)},
        doubts=result.doubts,
    )


def summarise_volumes(J: Array, volumes: Array) -> dict[str, float]:
    """What is told of ratios of volumes J (m,) of elements of ``volumes`` (m,)."""
    order = np.argsort(J)
    share = np.cumsum(volumes[order]) / volumes.sum()
    low, high = np.interp([0.01, 0.99], share, J[order]).tolist()
    beyond = float(volumes[np.abs(J - 1.0) > ALLOWED].sum() / volumes.sum())
    return dict(zip(NO_VOLUME, (float(J.min()), low, high, float(J.max()), 100.0 * beyond), strict=True))


FACTORS = (0.5, 2.0)
KAPPA_RATIOS = (10.0, 25.0, 50.0, 100.0, 200.0, 400.0)


def run_stiffness(context: Context, folder: Path, *, sites: Sequence[str] = ()) -> None:
    """Force against the moduli of each tissue, all with the same ``m`` (the geometric mean of theirs).

    Beside it the exact derivatives at all recorded sites, with the identified ``m``.
    """
    identified, law = context.results.calibration.parameters, context.study.law
    m, equal = None, identified
    if "m" in law.keys:
        m = float(np.exp(np.mean([np.log(values["m"]) for values in identified.values()])))
        equal = {tissue: values | {"m": m} for tissue, values in identified.items()}
    variants, cache = list[Variant](), open_experiment_cache(context, folder)
    for one in choose_sites(context, sites):
        base = {"tissue": None, "factor": 1.0}
        variants.append(Variant(one, one.model, equal, "as identified", base, base=True))
        for tissue, factor in product(equal, FACTORS):
            stiffer = equal[tissue] | {key: factor * equal[tissue][key] for key in law.moduli}
            label, facts = f"{tissue} c x {factor:g}", {"tissue": tissue, "factor": factor}
            variants.append(Variant(one, one.model, equal | {tissue: stiffer}, label, facts))
    local = _collect_derivatives(context, cache, identified)
    more: dict[str, Any] = {"equal_m": m, "factors": FACTORS, "local": local}
    run_variants(context, folder, stored.StiffnessResult, variants, cache, **more)


def _collect_derivatives(
    context: Context, cache: SimulationCache, identified: Parameters
) -> list[stored.ForceDerivative]:
    """Of every record of a force: change of the largest one in percent for one percent more of a modulus.

    It is each tissue's first.  They are of where parameters are searched, as those of the prediction.
    """
    study = context.study
    records = load_records(context, [record for record in study.recorded if not record.forced]).searched
    best = study.vector(identified)
    rows: list[stored.ForceDerivative] = []
    for record, found in zip(
        records, cache.run([record.job(best) for record in records], context.executor), strict=True
    ):
        context.tell("sensitivity-c", len(rows), len(records), f"derivatives, site {found.site}")
        assert found.jacobian is not None
        peak = int(np.argmax(found.force_N))
        relative = found.jacobian[peak] * best / found.force_N[peak]
        rows.append(
            stored.ForceDerivative(
                site=record.name,
                region=record.site.region,
                tissue_mm=measure_tissue_over_bone(record.model),
                completed=found.completed,
                peak_percent_per_percent={
                    tissue: float(value) if found.completed else None
                    for (tissue, name), value in zip(study.parameters, relative, strict=True)
                    if name == study.law.moduli[0]
                },
            )
        )
    return rows


def run_kappa(
    context: Context, folder: Path, *, sites: Sequence[str] = (), ratios: Sequence[float] = KAPPA_RATIOS
) -> None:
    """Force and change of volume against the ratio of bulk modulus and ``c``."""
    identified, own = context.results.calibration.parameters, context.study.material.kappa_ratio
    variants = [
        Variant(
            one,
            replace(one.model, kappa_ratio=ratio),
            identified,
            f"kappa = {ratio:g} c",
            {"kappa_ratio": ratio, **NO_VOLUME},
            base=ratio == own,
        )
        for one in choose_sites(context, sites)
        for ratio in sorted({own, *map(float, ratios)})
    ]
    # Kept apart from simulations without volumes, which have the same key.
    cache = SimulationCache(folder / "volumes", work=simulate_with_volumes)
    run_variants(context, folder, stored.VolumeResult, variants, cache, kappa_ratio=own)


def run_contact(context: Context, folder: Path, *, sites: Sequence[str] = ()) -> None:
    """Force where the skin slips freely under the indenter, and where it sticks to it."""
    identified, chosen = context.results.calibration.parameters, choose_sites(context, sites)
    variants = [
        Variant(
            one,
            replace(one.model, indenter=one.model.indenter.model_copy(update={"friction": friction})),
            identified,
            friction if isinstance(friction, str) else f"coefficient {friction:g}",
            {"friction": friction},
            base=friction == one.model.indenter.friction,
        )
        for one in chosen
        for friction in dict.fromkeys((one.model.indenter.friction, "frictionless", "sticky"))
    ]
    friction = chosen[0].model.indenter.friction
    run_variants(context, folder, stored.FrictionResult, variants, friction=friction)


def run_indenter(context: Context, folder: Path, *, sites: Sequence[str] = ()) -> None:
    """Force and effort with the indenter as it is, and with others of its width: a sphere before all."""
    identified, chosen = context.results.calibration.parameters, choose_sites(context, sites)
    variants = [
        Variant(
            one,
            replace(one.model, indenter=table, indenter_digest=one.model.indenter_digest if base else ""),
            identified,
            label,
            {"shape": table.shape, "width_mm": table.width_mm, "edge_radius_mm": table.edge_radius_mm},
            base=base,
        )
        for one in chosen
        for label, table, base in list_other_indenters(one.model.indenter)
    ]
    run_variants(context, folder, stored.IndenterResult, variants)


def list_other_indenters(own: IndenterTable) -> list[tuple[str, IndenterTable, bool]]:
    """(label, indenter, is the study's): its own, and those of its width that it is not."""
    width = own.width_mm
    found = [(f"{own.shape} of the study", own, True)]
    for shape in dict.fromkeys((*BUILTIN_SHAPES, SHAPES[own.shape])):
        for label, rounding in shape.variants.items():
            table = IndenterTable(
                shape=shape.name, width_mm=width, edge_radius_mm=rounding * width, friction=own.friction
            )
            if table != own:
                found.append((label, table, False))
    return found


EDGE_FACTORS = (1.4, 1.0, 0.7)  # of the edge lengths of the study's meshes
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


def run_refinement(
    context: Context, folder: Path, *, sites: Sequence[str] = (), factors: Sequence[float] = EDGE_FACTORS
) -> None:
    """Force at sites on meshes whose edges are ``factors`` times the study's, and what it tends to."""
    parameters, chosen = context.results.calibration.parameters, choose_sites(context, sites)
    settings, meshes = mesh_settings(context.study), context.results.mesh.sites
    wanted = list(product(chosen, _choose_factors(factors)))
    others = [(one.model, factor) for one, factor in wanted if factor != 1.0]
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
    for one, factor in wanted:
        model = one.model if factor == 1.0 else next(meshed)
        known = meshes[model.site] if factor == 1.0 else read_mesh_facts(model.mesh)
        facts = {
            "factor": factor,
            "edge_near_mm": factor * settings.edge_near_mm,
            "element": settings.element,
            "nodes": known.nodes,
            "cells": known.cells,
        }
        variants.append(Variant(one, model, parameters, f"edge x {factor:g}", facts, base=factor == 1.0))
    run_variants(context, folder, stored.RefinementResult, variants, find_more=_find_limit)


def _find_limit(runs: Sequence[VariantRow]) -> dict[str, Any]:
    """The largest force that the ``runs`` of a site tend to, and how far the study's mesh is from it.

    Nothing where they do not tend to anything yet. With an element whose forces do not change in one
    direction, the limit is the finest mesh's force, at no order.
    """
    keys = ("limit_N", "order", "order_measured", "error_percent")
    own = next(run for run in runs if run["base"])
    done = {run["edge_near_mm"]: run["peak_force_N"] for run in runs if run["peak_force_N"] is not None}
    if len(done) >= 2 and own["edge_near_mm"] in done:
        found = extrapolate_richardson(list(done), list(done.values()), MESH_ORDERS[own["element"]])
        finest = done[min(done)]
        if abs(found.limit - finest) <= FARTHEST * finest:
            off = found.error_percent(done[own["edge_near_mm"]])
            return dict(zip(keys, (found.limit, found.order, found.measured, off), strict=True))
    return dict.fromkeys(keys)
