"""What else would change the answer, by how much: geometry, contact and discretisation, as real simulations.

Each source is the study's model with one thing changed by about one standard deviation of what is known of
it. The change of force at the fitted sites becomes a change of the parameters by the generalised inverse of
the fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from ...anatomy.meshing.meshing import MeshSettings
from ...anatomy.sites.sites import compute_indenter_axis, project_to_skin
from ...anatomy.surfaces.surfaces import load_anatomy
from ...arrays import Array
from ...fe import ORDER_IN_TIME
from ...indentation import SimulationJob, SiteModel, to_vector3
from ...shapes import SHAPES
from ...study import Study
from ..engine.context import Context
from ..identification.fine_meshes import estimate_own_mesh_error
from ..limb.mesh import build_coarse_settings, mesh_settings, plan_meshes, scale_edges
from ..limb.remesh import mesh_models
from ..records.records import RecordSet, SiteRecord
from ..simulation.extrapolation import MESH_ORDERS, estimate_coarse_error
from ..simulation.simulations import SimulationCache

FINER = 0.75  # edges of the finer mesh, where the study has no coarse one to compare with
MORE_STEPS = 2
Vary = Callable[..., "SourceVariant"]


@dataclass(frozen=True)
class SourceVariant:
    """A changed model of every fitted site: ``jobs``, beside the jobs of what they are compared with.

    ``shared``: the change is the same at all sites, or each site has its own. ``counted``: it is a spread
    that enters the covariance, or an alternative that is only told. ``scale``: of the difference of forces.
    """

    source: str
    change: str
    jobs: tuple[SimulationJob, ...]
    compared_with: tuple[SimulationJob, ...]
    shared: bool
    counted: bool
    scale: float = 1.0

    @property
    def sites(self) -> tuple[str, ...]:
        """The site of each job: what is a site's own is the same for all its records."""
        return tuple(job.model.site for job in self.jobs)


@dataclass(frozen=True)
class Change:
    """What a variant does: change of force (n,) N at every fitted site; zero at those that ``failed``."""

    variant: SourceVariant
    force_N: tuple[Array, ...]
    failed: tuple[str, ...]


def build_variants(
    context: Context, folder: Path, records: RecordSet, parameters: Array
) -> list[SourceVariant]:
    """All variants of the study, on the meshes of the search, their meshes made."""
    table = context.study.uncertainty
    plain = tuple(record.job(parameters, sensitivities=False) for record in records.searched)

    def vary(
        source: str, change: str, models: Sequence[SiteModel], shared: bool, counted: bool
    ) -> SourceVariant:
        jobs = tuple(replace(job, model=model) for job, model in zip(plain, models, strict=True))
        return SourceVariant(source, change, jobs, plain, shared, counted)

    models = [record.model for record in records.searched]
    found = [
        vary(
            "layer thickness",
            f"{table.layer_mm:g} mm thicker",
            _thicken_layer(context, folder, models),
            True,
            True,
        )
    ]
    for number, word in enumerate(("along the limb", "around the limb")):
        moved = [_move_site(context, model, number, table.position_mm) for model in models]
        found.append(vary("site position", f"{table.position_mm:g} mm {word}", moved, False, True))
    for number, word in enumerate(("along the limb", "around the limb")):
        angle = np.radians(table.axis_degrees)
        axes = [
            np.cos(angle) * np.array(m.axis) + np.sin(angle) * _build_tangents(np.array(m.axis))[number]
            for m in models
        ]
        tilted = [replace(m, axis=to_vector3(axis)) for m, axis in zip(models, axes, strict=True)]
        found.append(vary("site axis", f"{table.axis_degrees:g} degrees {word}", tilted, False, True))
    found += _build_contact_variants(context.study, models, vary)
    finer = []
    for m in models:
        counts = {key: MORE_STEPS * getattr(m.steps, key) for key in ("load_steps", "unload_steps")}
        finer.append(replace(m, steps=m.steps.model_copy(update=counts)))
    change = f"{MORE_STEPS} times as many, extrapolated at order {ORDER_IN_TIME:g}"
    in_time = vary("time steps", change, finer, True, True)
    found.append(replace(in_time, scale=estimate_coarse_error(ORDER_IN_TIME, MORE_STEPS)))
    found.append(_build_mesh_variant(context, folder, records, plain))
    return found


def _build_contact_variants(study: Study, models: Sequence[SiteModel], vary: Vary) -> list[SourceVariant]:
    """Edge radius, friction and bulk modulus; the last two are alternatives, no spreads."""
    radius = study.uncertainty.edge_radius_mm
    found = []
    if radius > 0 and any(SHAPES[m.indenter.shape].is_edge_doubted for m in models):
        rounded = [
            _change_indenter(m, edge_radius_mm=m.indenter.edge_radius_mm + radius)
            if SHAPES[m.indenter.shape].is_edge_doubted
            else m
            for m in models
        ]
        found.append(vary("indenter edge", f"radius {radius:g} mm larger", rounded, True, True))
    swapped = {"frictionless": "sticky"}  # all others slip freely
    others = [
        _change_indenter(m, friction=swapped.get(str(m.indenter.friction), "frictionless")) for m in models
    ]
    word = " or ".join(dict.fromkeys(str(m.indenter.friction) for m in others))
    found.append(vary("friction", word, others, True, False))
    softer = [replace(m, kappa_ratio=m.kappa_ratio / 2) for m in models]
    found.append(vary("bulk modulus", "half", softer, True, False))
    return found


def _change_indenter(model: SiteModel, **changes: object) -> SiteModel:
    return replace(model, indenter=model.indenter.model_copy(update=changes))


def _build_tangents(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors across an axis: along the limb (the image's z) and around it."""
    up = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    along = up - (up @ axis) * axis
    along /= np.linalg.norm(along)
    return along, np.cross(axis, along)


def _move_site(context: Context, model: SiteModel, number: int, distance_mm: float) -> SiteModel:
    """The site elsewhere on the skin, its axis found anew; the mesh is refined widely enough around it."""
    anatomy = load_anatomy(context.store["surfaces"])
    axis = np.array(model.axis)
    wanted = np.array(model.position) + distance_mm * _build_tangents(axis)[number]
    point, _ = project_to_skin(anatomy, wanted)
    width = context.study.width_at(context.study.site(model.site))
    turned = compute_indenter_axis(anatomy.skin, point, width) - compute_indenter_axis(
        anatomy.skin, model.position, width
    )
    axis = axis + turned
    axis /= np.linalg.norm(axis)
    return replace(model, position=to_vector3(point), axis=to_vector3(axis))


def choose_searched_settings(study: Study) -> MeshSettings:
    """Of the meshes on which parameters are searched: the coarse ones where there are."""
    return build_coarse_settings(study) or mesh_settings(study)


def _thicken_layer(context: Context, folder: Path, models: Sequence[SiteModel]) -> list[SiteModel]:
    """The sites meshed anew with the outermost layer of given thickness made thicker."""
    settings = choose_searched_settings(context.study)
    layers = list(settings.layers)
    index = next((i for i, layer in enumerate(layers) if layer.thickness_mm is not None), 0)
    layer, more = layers[index], context.study.uncertainty.layer_mm
    if layer.thickness_mm is None:  # a mapped layer: its least thickness is all that can be stated
        layers[index] = replace(layer, min_thickness_mm=(layer.min_thickness_mm or 0.0) + more)
    else:
        layers[index] = replace(layer, thickness_mm=layer.thickness_mm + more)
    thicker = replace(settings, layers=tuple(layers))
    return _mesh(context, folder / "thicker", models, thicker)


def _mesh(
    context: Context, folder: Path, models: Sequence[SiteModel], settings: MeshSettings
) -> list[SiteModel]:
    folder.mkdir(exist_ok=True)
    jobs = plan_meshes(context, folder, ((one.site, one.position, one.axis) for one in models), settings)
    return mesh_models(jobs, models, context.executor, partial(context.tell, "uncertainty", 0, 0))


def _build_mesh_variant(
    context: Context,
    folder: Path,
    records: RecordSet,
    plain: tuple[SimulationJob, ...],
) -> SourceVariant:
    """How far forces are from those of an infinitely fine mesh, from two."""
    study = context.study
    settings = choose_searched_settings(study)
    if study.mesh.coarse is not None:
        models = [replace(record.model, within_mm=study.within_mm) for record in records.own]
    else:
        finer = scale_edges(settings, FINER)
        models = _mesh(context, folder / "finer", [record.model for record in records.searched], finer)
    jobs = [replace(job, model=model) for job, model in zip(plain, models, strict=True)]
    change, scale = mesh_share(study)
    # With coarse meshes the residuals' covariance has it already.
    counted = study.mesh.coarse is None
    return SourceVariant("mesh", change, tuple(jobs), plain, False, counted, scale)


def mesh_share(study: Study) -> tuple[str, float]:
    """In words and as a factor: what the mesh of the answer lacks, over the difference of two meshes."""
    order = MESH_ORDERS[study.mesh.element]
    how = "the difference itself" if order is None else f"extrapolated at order {order:g}"
    if study.mesh.coarse is not None:
        return f"error of the fine mesh, in every interval already: {how}", estimate_own_mesh_error(
            study.mesh
        )
    what = f"error of the mesh, from edges {FINER:g} times as long: {how}"
    return what, estimate_coarse_error(order, 1 / FINER)


def simulate_changes(
    context: Context, cache: SimulationCache, wanted: Sequence[SourceVariant], records: Sequence[SiteRecord]
) -> list[Change]:
    """Simulate the variants of the ``records``."""
    jobs = [job for variant in wanted for job in (*variant.jobs, *variant.compared_with)]
    forces: list[Array | None] = []
    for record, simulation in zip(cycle(records), cache.run(jobs, context.executor)):
        answer = simulation.force_N if record.seen is None else record.respond(simulation).force_N
        forces.append(answer if simulation.completed else None)
        context.tell("uncertainty", len(forces), len(jobs), f"sources, site {simulation.site}")
    found, at = [], 0
    for variant in wanted:
        n = len(variant.jobs)
        pairs = list(zip(forces[at : at + n], forces[at + n : at + 2 * n]))
        at += 2 * n
        failed = [
            job.model.name for job, (new, old) in zip(variant.jobs, pairs) if new is None or old is None
        ]
        difference = [
            np.zeros(len(record.compared)) if new is None or old is None else variant.scale * (new - old)
            for record, (new, old) in zip(records, pairs)
        ]
        found.append(Change(variant, tuple(difference), tuple(failed)))
    return found
