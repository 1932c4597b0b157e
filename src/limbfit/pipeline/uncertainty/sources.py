"""What else would change the answer, by how much: geometry, contact and discretisation, as real simulations.

Each source is the study's model with one thing changed by about one standard deviation of what is known of
it. The change of force at the fitted sites becomes a change of the parameters by the generalised inverse of
the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, cycle
from pathlib import Path

import numpy as np

from ...anatomy.meshing.meshing import MeshSettings
from ...anatomy.sites.sites import compute_indenter_axis
from ...anatomy.surfaces.surfaces import load_anatomy
from ...arrays import Array
from ...fe import ORDER_IN_TIME
from ...indentation import SimulationJob, SiteModel, to_vector3
from ...shapes import SHAPES
from ...study import Study
from ..engine.context import Context
from ..identification.answer import MESH_ORDERS, estimate_coarse_error, estimate_own_mesh_error
from ..limb.mesh import build_coarse_settings, mesh_settings, plan_meshes, scale_edges
from ..limb.remesh import mesh_models
from ..records.records import RecordSet
from ..simulation.simulations import SimulationCache

FINER = 0.75  # edges of the finer mesh, where the study has no coarse one to compare with
MORE_STEPS = 2


@dataclass(frozen=True)
class Change:
    """A changed model of every fitted site, as ``jobs``, and what it does.

    ``shared``: the change is the same at all sites, or each site has its own. ``counted``: it is a spread
    that enters the covariance, or an alternative that is only told. ``scale``: of the difference of forces.
    Once simulated, ``force_N`` are the changes of force (n,) N at the sites, zero at those that ``failed``.
    """

    source: str
    change: str
    jobs: tuple[SimulationJob, ...]
    shared: bool
    counted: bool
    scale: float = 1.0
    force_N: tuple[Array, ...] = ()
    failed: tuple[str, ...] = ()

    @property
    def sites(self) -> tuple[str, ...]:
        """The site of each job: what is a site's own is the same for all its records."""
        return tuple(job.model.site for job in self.jobs)


def simulate_sources(
    context: Context, folder: Path, cache: SimulationCache, records: RecordSet, parameters: Array
) -> list[Change]:
    """Simulate all variants of the study, on the meshes of the search, and the records as they are."""
    plain = [record.job(parameters, sensitivities=False) for record in records.searched]
    answers = list(cache.run(plain, context.executor))
    # With the contact penalty of its simulation no source is mistaken for another penalty, and none is
    # searched for each variant by a simulation of its own.
    models = []
    for job, done in zip(plain, answers, strict=True):
        held = job.model.steps.model_copy(update={"penalty_per_mm": done.facts.get("penalty_per_mm")})
        models.append(replace(job.model, steps=held))
    variants = _build_variants(context, folder, records, plain, models)
    jobs = [job for variant in variants for job in variant.jobs]
    total = len(plain) + len(jobs)
    forces: list[Array | None] = []
    for record, simulation in zip(cycle(records.own), chain(answers, cache.run(jobs, context.executor))):
        answer = simulation.force_N if record.seen is None else record.respond(simulation).force_N
        forces.append(answer if simulation.completed else None)
        context.tell("uncertainty", len(forces), total, f"sources, site {simulation.site}")
    before, *rows = (forces[i : i + len(plain)] for i in range(0, total, len(plain)))
    found = []
    for variant, after in zip(variants, rows, strict=True):
        differences, failed = [], []
        for record, job, old, new in zip(records.own, variant.jobs, before, after, strict=True):
            if old is None or new is None:
                failed.append(job.model.name)
                differences.append(np.zeros(len(record.compared)))
            else:
                differences.append(variant.scale * (new - old))
        found.append(replace(variant, force_N=tuple(differences), failed=tuple(failed)))
    return found


def _build_variants(
    context: Context,
    folder: Path,
    records: RecordSet,
    plain: Sequence[SimulationJob],
    models: Sequence[SiteModel],
) -> list[Change]:
    """All variants of the study, of ``models`` that hold their contact penalties; their meshes are made."""
    study, table, found = context.study, context.study.uncertainty, list[Change]()

    def add(
        source: str, change: str, changed: Sequence[SiteModel], shared: bool, counted: bool, scale: float = 1
    ) -> None:
        jobs = tuple(replace(job, model=model) for job, model in zip(plain, changed, strict=True))
        found.append(Change(source, change, jobs, shared, counted, scale))

    thicker = _thicken_layer(context, folder, models)
    add("layer thickness", f"{table.layer_mm:g} mm thicker", thicker, True, True)
    directions = tuple(enumerate(("along the limb", "around the limb")))
    for number, word in directions:
        moved = [_move_site(context, model, number, table.position_mm) for model in models]
        add("site position", f"{table.position_mm:g} mm {word}", moved, False, True)
    angle = np.radians(table.axis_degrees)
    for number, word in directions:
        tilted = []
        for model in models:
            axis = np.array(model.axis)
            off = np.cos(angle) * axis + np.sin(angle) * _build_tangents(axis)[number]
            tilted.append(replace(model, axis=to_vector3(off)))
        add("site axis", f"{table.axis_degrees:g} degrees {word}", tilted, False, True)
    radius, doubted = table.edge_radius_mm, [SHAPES[m.indenter.shape].is_edge_doubted for m in models]
    if radius > 0 and any(doubted):
        rounded = [
            _change_indenter(m, edge_radius_mm=m.indenter.edge_radius_mm + radius) if is_doubted else m
            for m, is_doubted in zip(models, doubted, strict=True)
        ]
        add("indenter edge", f"radius {radius:g} mm larger", rounded, True, True)
    # Friction and bulk modulus are alternatives, no spreads. All but frictionless ones slip freely then.
    others = [
        _change_indenter(m, friction="sticky" if m.indenter.friction == "frictionless" else "frictionless")
        for m in models
    ]
    word = " or ".join(dict.fromkeys(str(m.indenter.friction) for m in others))
    add("friction", word, others, True, False)
    add("bulk modulus", "half", [replace(m, kappa_ratio=m.kappa_ratio / 2) for m in models], True, False)
    finer = []
    for m in models:
        counts = {key: MORE_STEPS * getattr(m.steps, key) for key in ("load_steps", "unload_steps")}
        finer.append(replace(m, steps=m.steps.model_copy(update=counts)))
    change = f"{MORE_STEPS} times as many, extrapolated at order {ORDER_IN_TIME:g}"
    add("time steps", change, finer, True, True, estimate_coarse_error(ORDER_IN_TIME, MORE_STEPS))
    # How far forces are from those of an infinitely fine mesh, from two. With coarse meshes the residuals'
    # covariance has it already.
    if study.mesh.coarse is not None:
        remeshed = [replace(record.model, within_mm=study.within_mm) for record in records.own]
    else:
        edges = scale_edges(choose_searched_settings(study), FINER)
        remeshed = _mesh(context, folder / "finer", models, edges)
    change, scale = mesh_share(study)
    add("mesh", change, remeshed, False, study.mesh.coarse is None, scale)
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
    skin = load_anatomy(context.store["surfaces"]).open_skin
    axis = np.array(model.axis)
    wanted = np.array(model.position) + distance_mm * _build_tangents(axis)[number]
    (point,) = skin.find_nearest(wanted)[2]
    width = context.study.width_at(context.study.site(model.site))
    here, there = (compute_indenter_axis(skin, place, width, model.edge) for place in (model.position, point))
    axis = axis + there - here
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


def mesh_share(study: Study) -> tuple[str, float]:
    """In words and as a factor: what the mesh of the answer lacks, over the difference of two meshes."""
    order = MESH_ORDERS[study.mesh.element]
    how = "the difference itself" if order is None else f"extrapolated at order {order:g}"
    if study.mesh.coarse is not None:
        what = f"error of the fine mesh, in every interval already: {how}"
        return what, estimate_own_mesh_error(study.mesh)
    what = f"error of the mesh, from edges {FINER:g} times as long: {how}"
    return what, estimate_coarse_error(order, 1 / FINER)
