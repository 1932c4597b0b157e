"""Simulations of the same indentation with one thing changed: what the experiments of sensitivity share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...arrays import Array
from ...errors import InputError
from ...indentation import Parameters, Simulation, SimulationJob, SiteModel, to_vector
from ...results.variants import VariantRun, VariedSite
from ...study import Indentation, Record, Site, Study
from ..engine.context import Context
from ..engine.storage import write_curves
from ..records.deviations import measure_bone_distance_mm
from ..records.records import build_model
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import CURVE_POINTS, SimulationCache

Run = TypeVar("Run", bound=VariantRun)


@dataclass(frozen=True)
class ChosenSite:
    """An indentation that is varied; ``tissue_mm`` is between its site and the nearest bone."""

    site: Site
    model: SiteModel
    tissue_mm: float
    role: str

    @property
    def name(self) -> str:
        """That of the record, or of the site that plans it."""
        return self.model.name

    @property
    def summary(self) -> VariedSite:
        """What is stored of it."""
        return VariedSite(
            site=self.name,
            region=self.site.region,
            role=self.role,
            tissue_mm=self.tissue_mm,
            indentation_mm=max(self.model.knots_mm),
        )


@dataclass(frozen=True)
class Variant:
    """One simulation; ``facts`` say what is changed, ``base`` that nothing is."""

    chosen: ChosenSite
    model: SiteModel
    parameters: Parameters
    label: str
    facts: dict[str, Any]
    base: bool = False

    def job(self) -> SimulationJob:
        tissues = tuple(self.parameters)
        values = tuple(map(float, to_vector(self.parameters, tissues, self.model.law)))
        return SimulationJob(self.model, tissues, values, tuple(map(float, self.times)), False)

    @property
    def times(self) -> Array:
        """Times (k,) s of the compared forces."""
        return self.model.curve_times(CURVE_POINTS)


def check_variants(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse ``sites`` that cannot be varied, and a limb without a bone to measure the tissue from.

    Raises
    ------
    InputError
    """
    _select_driven(study, options["sites"])
    if limb is not None and not limb.anatomy.bones:
        what = "the limb has no bone, and this compares tissue by its thickness over bone"
        raise InputError(what, file=study.file)


def _select_driven(study: Study, names: Sequence[str]) -> list[Indentation]:
    """The named indentations, or all, under a stated displacement."""
    chosen = [study.indentation(name) for name in names] or list(study.indentations)
    driven = [one for one in chosen if not (isinstance(one, Record) and one.forced)]
    if not driven or (names and len(driven) < len(chosen)):
        raise InputError(
            'this compares forces, and a record with control = "force" has none to compare',
            file=study.file,
            remedy="name records under a stated displacement",
        )
    return driven


def choose_sites(context: Context, names: Sequence[str]) -> list[ChosenSite]:
    """The named indentations; none named: one where the tissue over the bone is thinnest, one where thickest.

    Raises
    ------
    InputError
        For a site or record that the study does not have, and a site with several.
    """
    every = [_choose_site(context, one) for one in _select_driven(context.study, names)]
    if names:
        return every
    thin, thick = min(every, key=_get_tissue), max(every, key=_get_tissue)
    if thin is thick:
        return [thin]
    return [_add_role(thin, "thin"), _add_role(thick, "thick")]


def _get_tissue(chosen: ChosenSite) -> float:
    return chosen.tissue_mm


def _add_role(chosen: ChosenSite, role: str) -> ChosenSite:
    return ChosenSite(chosen.site, chosen.model, chosen.tissue_mm, role)


def _choose_site(context: Context, one: Indentation) -> ChosenSite:
    model = build_model(context, one)
    return ChosenSite(context.study.site(model.site), model, measure_tissue_over_bone(model), "")


def measure_tissue_over_bone(model: SiteModel) -> float:
    """Distance in mm from a site to the nearest point of a bone in its mesh.

    Raises
    ------
    InputError
        Where the mesh has no bone.
    """
    found = measure_bone_distance_mm(model)
    if found is None:
        raise InputError("there is no bone in the mesh", file=model.mesh, remedy="name the sites to be used")
    return found


def run_variants(
    context: Context, name: str, cache: SimulationCache, variants: Sequence[Variant]
) -> list[Simulation]:
    """Simulate them all, in order, those that are kept for nothing."""
    done = []
    for simulation in cache.run([variant.job() for variant in variants], context.executor):
        done.append(simulation)
        words = f"site {simulation.site}, {variants[len(done) - 1].label}"
        context.tell(name, len(done), len(variants), words)
    return done


def compare_variants(
    variants: Sequence[Variant], simulations: Sequence[Simulation], run: type[Run]
) -> list[Run]:
    """A row of each: what was changed, its largest force, and how it differs from its site's base.

    Changes are in percent of the base's largest force: of the largest force, and the mean over the trace.
    They are None where a simulation is partial. ``run`` is the model of a row.
    """
    base = {
        variant.chosen.name: simulation
        for variant, simulation in zip(variants, simulations, strict=True)
        if variant.base
    }
    return [
        run(
            site=variant.chosen.name,
            label=variant.label,
            base=variant.base,
            **variant.facts,
            peak_force_N=float(simulation.force_N.max()) if simulation.completed else None,
            **_change(simulation, base[variant.chosen.name]),
            penetration_mm=simulation.penetration_mm,
            steps=simulation.facts.get("steps"),
            newton_iterations=simulation.facts.get("newton_iterations"),
            cuts=simulation.facts.get("cuts"),
            completed=simulation.completed,
            reason=simulation.reason,
            warnings=simulation.warnings,
        )
        for variant, simulation in zip(variants, simulations, strict=True)
    ]


def _change(simulation: Simulation, base: Simulation) -> dict[str, float | None]:
    if not (simulation.completed and base.completed):
        return {"peak_change_percent": None, "mean_change_percent": None}
    peak = float(base.force_N.max())
    return {
        "peak_change_percent": 100.0 * (float(simulation.force_N.max()) / peak - 1.0),
        "mean_change_percent": 100.0 * float(np.abs(simulation.force_N - base.force_N).mean()) / peak,
    }


def write_variants(folder: Path, variants: Sequence[Variant], simulations: Sequence[Simulation]) -> None:
    """``<site>.csv``: time, displacement and the force of every variant that was completed."""
    for name in dict.fromkeys(variant.chosen.name for variant in variants):
        mine = [i for i, variant in enumerate(variants) if variant.chosen.name == name]
        first = variants[mine[0]]
        forces = {
            format_column(variants[i].label): simulations[i].force_N for i in mine if simulations[i].completed
        }
        write_curves(
            folder / f"{name}.csv",
            time_s=first.times,
            displacement_mm=first.model.history.at(first.times),
            **forces,
        )


def format_column(label: str) -> str:
    """The head of a variant's column of forces."""
    plain = "".join(c if (c.isalnum() and c.isascii()) or c == "." else " " for c in label)
    return "_".join(plain.split()) + "_N"
