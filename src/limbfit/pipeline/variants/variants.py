"""Simulations of the same indentation with one thing changed: what the experiments of sensitivity share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...indentation import Parameters, Simulation, SimulationJob, SiteModel, to_vector
from ...results.variants import VariedResult, VariedSite
from ...study import Indentation, Study
from ..engine.context import Context
from ..engine.store import write_curves, write_result, write_rows
from ..records.records import build_model, measure_bone_distance_mm
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.simulations import CURVE_POINTS, SimulationCache, build_curve_job, open_experiment_cache

VariantRow = Mapping[str, Any]  # a run, by the keys of its model


@dataclass(frozen=True)
class ChosenSite:
    """An indentation that is varied, and what is stored of it."""

    model: SiteModel
    summary: VariedSite


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
        values = to_vector(self.parameters, tissues, self.model.law)
        return replace(build_curve_job(self.model, tissues, values), sensitivities=False)


def check_variants(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse ``sites`` that cannot be varied, and a limb without a bone to measure the tissue from."""
    _select_driven(study, options["sites"])
    if limb is not None and not limb.anatomy.bones:
        what = "the limb has no bone, and this compares tissue by its thickness over bone"
        raise InputError(what, file=study.file)


def _select_driven(study: Study, names: Sequence[str]) -> list[Indentation]:
    """The named indentations, or all, under a stated displacement."""
    chosen = [study.indentation(name) for name in names] or list(study.indentations)
    driven = [one for one in chosen if not one.forced]
    if not driven or (names and len(driven) < len(chosen)):
        raise InputError(
            'this compares forces, and a record with control = "force" has none to compare',
            file=study.file,
            remedy="name records under a stated displacement",
        )
    return driven


def choose_sites(context: Context, names: Sequence[str]) -> list[ChosenSite]:
    """The named indentations; none named: one where the tissue over the bone is thinnest, one where thickest.

    Raises `InputError` for a site or record that the study does not have, and a site with several.
    """
    every = []
    for one in _select_driven(context.study, names):
        model = build_model(context, one)
        summary = VariedSite(
            site=model.name,
            region=context.study.site(model.site).region,
            role="",
            tissue_mm=measure_tissue_over_bone(model),
            indentation_mm=max(model.knots_mm),
        )
        every.append(ChosenSite(model, summary))
    if names:
        return every
    thin = min(every, key=lambda one: one.summary.tissue_mm)
    thick = max(every, key=lambda one: one.summary.tissue_mm)
    roles = {"thin": thin, "thick": thick} if thin is not thick else {"": thin}
    return [
        replace(one, summary=one.summary.model_copy(update={"role": role})) for role, one in roles.items()
    ]


def measure_tissue_over_bone(model: SiteModel) -> float:
    """Distance in mm from a site to the nearest point of a bone in its mesh, which has one."""
    found = measure_bone_distance_mm(model)
    assert found is not None  # `check_variants` refuses a limb without a bone
    return found


def run_variants(
    context: Context,
    folder: Path,
    result: type[VariedResult],
    variants: Sequence[Variant],
    cache: SimulationCache | None = None,
    find_more: Callable[[Sequence[VariantRow]], dict[str, Any]] = lambda runs: {},
    **more: Any,
) -> None:
    """Simulate variants and store a ``result`` with a run of each, and ``more`` of its keys.

    ``find_more`` tells more of a site from its runs. Beside the JSON are the runs as ``runs.csv``, and the
    curves of each site.
    """
    cache = open_experiment_cache(context, folder) if cache is None else cache
    done: list[Simulation] = []
    found = cache.run([variant.job() for variant in variants], context.executor)
    for variant, simulation in zip(variants, found, strict=True):
        done.append(simulation)
        words = f"site {simulation.site}, {variant.label}"
        context.tell(Path(result.FILE).stem, len(done), len(variants), words)
    _write_curves(folder, variants, done)
    runs = _compare_variants(variants, done)
    sites = {variant.model.name: variant.chosen.summary for variant in variants}
    rows = [
        dict(site) | find_more([run for run in runs if run["site"] == name]) for name, site in sites.items()
    ]
    parameters = context.results.calibration.parameters
    content = result.model_validate({"sites": rows, "runs": runs, "parameters": parameters, **more})
    write_result(folder / Path(result.FILE).name, content)
    write_rows(folder / "runs.csv", content.runs, leave_out=("warnings", "label", "base"))


def _compare_variants(variants: Sequence[Variant], simulations: Sequence[Simulation]) -> list[VariantRow]:
    """A row of each: what was changed, its largest force, and how it differs from its site's base.

    Changes are in percent of the base's largest force: of the largest force, and the mean over the trace.
    They are None where a simulation is partial.
    """
    base = {
        variant.model.name: simulation
        for variant, simulation in zip(variants, simulations, strict=True)
        if variant.base
    }
    return [
        {
            "site": variant.model.name,
            "label": variant.label,
            "base": variant.base,
            **variant.facts | simulation.facts.get("volume", {}),
            "peak_force_N": float(simulation.force_N.max()) if simulation.completed else None,
            **_change(simulation, base[variant.model.name]),
            "penetration_mm": simulation.penetration_mm,
            **{key: simulation.facts.get(key) for key in ("steps", "newton_iterations", "cuts")},
            "completed": simulation.completed,
            "reason": simulation.reason,
            "warnings": simulation.warnings,
        }
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


def _write_curves(folder: Path, variants: Sequence[Variant], simulations: Sequence[Simulation]) -> None:
    """``<site>.csv``: time, displacement and the force of every variant that was completed."""
    pairs = list(zip(variants, simulations, strict=True))
    for model in {variant.model.name: variant.chosen.model for variant in variants}.values():
        times = model.curve_times(CURVE_POINTS)
        forces = {
            format_column(variant.label): simulation.force_N
            for variant, simulation in pairs
            if variant.model.name == model.name and simulation.completed
        }
        file = folder / f"{model.name}.csv"
        write_curves(file, time_s=times, displacement_mm=model.history.at(times), **forces)


def format_column(label: str, unit: str = "N") -> str:
    """A label in words as the head of a CSV column, with the unit."""
    plain = "".join(c if (c.isalnum() and c.isascii()) or c == "." else " " for c in label)
    return "_".join([*plain.split(), unit])
