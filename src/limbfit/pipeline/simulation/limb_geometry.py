"""The limb of a study before anything is simulated: where its sites are, what must fit it, their models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...anatomy.surfaces.surfaces import Anatomy, load_anatomy
from ...arrays import Array
from ...indentation import Direction, SiteModel, build_clamping_pins, read_indenter, to_vector3
from ...mesh import read_vtu
from ...results.limb import PlacedSite
from ...results.study_results import StudyResults
from ...study import Indentation, IndenterTable, Site, Study, Vector
from ..engine.context import Context, name_file_in_errors
from ..engine.digests import compute_file_digest
from ..engine.store import COARSE, Store


@dataclass(frozen=True, eq=False)
class LimbGeometry:
    """Surfaces, and by site its place on them as ``sites.json`` has it: none where sites are not placed."""

    anatomy: Anatomy
    places: Mapping[str, PlacedSite] = field(default_factory=dict)

    @classmethod
    def from_store(cls, store: Store) -> LimbGeometry:
        """That of the stages ``surfaces`` and ``sites``, which are done."""
        return cls(load_anatomy(store["surfaces"]), {row.site: row for row in store.results.sites.sites})

    def place(self, site: Site) -> tuple[Vector, Vector]:
        """Position, mm, and axis of the indenter at a site, LPS."""
        row = self.places[site.name]
        return row.position_mm, row.axis

    def clamping_pins(self, study: Study) -> dict[str, int]:
        """How many pins of ``[clamps]`` hold the limb at each site.

        Raises `ProblemError` where they cannot be placed, with the study's file.
        """
        skin, along, found = self.anatomy.skin, to_vector3(self.anatomy.cut_normal), {}
        faces = skin.points, skin.faces
        for site in study.sites:
            one, place = (study.records_at(site) or (site,))[0], self.place(site)
            indenter = study.indenter_of(one)
            found[site.name] = count_pins_met(study, one.name, indenter, place, faces, along)
        return found


# Refuses (`InputError`) what a study, its limb (None: not known yet) and options rule out, before anything is
# simulated.
Check = Callable[[Study, LimbGeometry | None, Mapping[str, Any]], None]


def build_site_model(
    context: Context,
    one: Indentation,
    knots_s: Sequence[float],
    knots_mm: Sequence[float],
    knots_N: Sequence[float] = (),
    layers: Sequence[str] = (),
) -> SiteModel:
    """The stored mesh and place of an indentation's site with a history of displacement, or of force.

    ``layers``: tissues whose compression is wanted, too.

    Raises `ProblemError` where the study's clamps do not meet the limb there.
    """
    study, results, site = context.study, context.results, one.site
    placed = {row.site: row for row in results.sites.sites}[site.name]
    mesh, indenter = context.store["mesh"] / f"{site.name}.vtu", study.indenter_of(one)
    clamped: dict[str, Any] = {}
    if study.clamps is not None:
        clamped = {"clamps": study.clamps, "along": read_limb_axis(results)}
    model = SiteModel(
        name=one.name,
        site=site.name,
        fibres=find_fibre_directions(study, results),
        mesh=mesh,
        mesh_digest=compute_file_digest(mesh),
        position=placed.position_mm,
        axis=placed.axis,
        knots_s=tuple(knots_s),
        knots_mm=tuple(knots_mm),
        knots_N=tuple(knots_N),
        edge=site.edge,
        indenter=indenter,
        indenter_digest="" if indenter.file is None else compute_file_digest(indenter.file),
        steps=study.solver,
        element=study.mesh.element,
        layers=tuple(layers),
        **list_material_fields(study),
        **clamped,
    )
    _check_pins(study, model)
    return model


def list_material_fields(study: Study) -> dict[str, Any]:
    """What the study says of all tissues, as fields of a `SiteModel`: all but the directions of fibres."""
    table = study.material
    return {
        "kappa_ratio": table.kappa_ratio,
        "law": table.law,
        "relaxation_span_s": table.relaxation_span_s,
        "course": table.course,
        "prestretch": tuple(sorted(table.prestretch.items())),
        "extensions": study.extensions,
    }


def coarsen_model(context: Context, model: SiteModel) -> SiteModel:
    """A site's model as parameters are searched: on its coarse mesh where the study has one.

    No more of the mesh counts than ``calibration.search_radius_mm``.

    Raises `ProblemError` where the study's clamps do not meet the limb there.
    """
    study = context.study
    if study.mesh.coarse is not None:
        mesh = context.store["mesh"] / COARSE / f"{model.site}.vtu"
        _check_pins(study, replace(model, mesh=mesh))
        model = replace(model, mesh=mesh, mesh_digest=compute_file_digest(mesh))
    return replace(model, within_mm=study.within_mm)


def _check_pins(study: Study, model: SiteModel) -> None:
    """Refuse clamps that do not meet the limb, with the study's file, before workers build the site."""
    if study.clamps is not None:
        mesh, place = read_vtu(model.mesh), (model.position, model.axis)
        skin = mesh.points, mesh.face_sets["skin"]
        count_pins_met(study, model.name, model.indenter, place, skin, model.along)


def count_pins_met(
    study: Study,
    name: str,
    indenter: IndenterTable,
    place: tuple[Vector, Vector],
    skin: tuple[Array, NDArray[np.int64]],
    along: Vector,
) -> int:
    """How many pins hold the limb in an indentation; 0 where the study has none.

    Raises `ProblemError` where the pins cannot be placed, with the study's file.

    Parameters
    ----------
    name : of the indentation.
    place : position and axis of the indenter.
    skin : points (n, 3) mm and faces (f, 3 or more).
    along : the limb's axis, proximally.
    """
    if study.clamps is None:
        return 0
    with name_file_in_errors(study.file, "clamps", f"site {name}: "):
        tool = read_indenter(indenter, *place, None)
        return len(build_clamping_pins(*skin, tool, np.array(along), study.clamps))


def find_fibre_directions(study: Study, results: StudyResults) -> tuple[tuple[str, Direction], ...]:
    """The direction of the fibres in each tissue that has some, of length one, or that of a flow."""

    def find(stated: str | Vector) -> Direction:
        if isinstance(stated, str):
            return "flow" if stated == "flow" else read_limb_axis(results)
        return to_vector3(np.array(stated) / np.linalg.norm(stated))

    return tuple((tissue, find(stated)) for tissue, stated in study.fibres.items())


def read_limb_axis(results: StudyResults) -> Vector:
    """The limb's axis, proximally: the unit normal of its proximal cut."""
    normal = np.array(results.surfaces.cut_normal)
    return to_vector3(normal / np.linalg.norm(normal))
