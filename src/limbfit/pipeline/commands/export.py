"""Indentations of a study as inputs of other solvers, with the same numbers as ``limbfit simulate``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ... import febio
from ...arrays import Array
from ...bench.timing import build_block_model, build_layered_block
from ...errors import InputError
from ...execution import SerialExecutor
from ...fe import ELEMENTS, Problem
from ...indentation import Parameters, SiteModel, build_problem
from ...laws import OGDEN, is_ogden
from ...mesh import write_vtu
from ...study import Indentation, Record, Study
from ..engine.context import Context, Listener, ignore_progress
from ..engine.files import name_file_in_errors
from ..engine.store import Store
from ..records.records import load_site_record
from ..simulation.limb_geometry import list_material_fields
from .simulate import PreparedIndentation, choose_parameters, prepare_site

FITTED = "febio-optimize"
FORMATS = ("feb", FITTED, "inp", "calculix")
_DIVISIONS = 4  # of the block on which an export is tried
_NO_CURVE = np.array([0.0, 1.0]), np.zeros(2)


def export_study(
    study: Study,
    to: str,
    *,
    site: str | None = None,
    output: str | Path | None = None,
    parameters: Parameters | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Write one indentation, or all of them, for another solver; meshes are made where missing.

    Parameters
    ----------
    to : ``feb`` (FEBio 4), ``febio-optimize`` (FEBio's parameter optimisation: control file and model, for
        each fitted site; FEBio fits one model at a time), ``inp`` (Abaqus) or ``calculix``.
    output : a folder; by default ``results/export``.
    parameters : per tissue; by default the identified ones, or the study's start where none were identified.

    Raises
    ------
    InputError
        For an unknown site or format, and where the other solver has no such material, element or contact.
    RunError
        Where a file cannot be written.
    """
    chosen = check_export(study, to, site=site, parameters=parameters)
    folder = study.results / "export" if output is None else Path(output)
    rows = []
    for one in chosen:
        prepared = prepare_site(study, one.name, parameters=parameters, listener=listener)
        folder.mkdir(parents=True, exist_ok=True)
        curve = _NO_CURVE
        if to == FITTED:
            assert isinstance(prepared.stated, Record)
            record = load_site_record(prepared.context, prepared.stated)
            inside = (record.times_s >= 0.0) & (record.times_s <= prepared.model.knots_s[-1])
            curve = record.times_s[inside], record.force_N[inside]
        files, notes = _write(prepared, prepared.build_problem(), to, folder, curve)
        rows.append(
            {
                "site": one.name,
                "parameters": prepared.parameters,
                "parameters_from": prepared.origin,
                "files": [str(file) for file in files],
                "notes": list(notes),
            }
        )
    return {"format": to, "sites": rows}


def check_export(
    study: Study, to: str, *, site: str | None = None, parameters: Parameters | None = None
) -> Sequence[Indentation]:
    """The indentations to be written, each of which has been written on a small block in the limb's place.

    Raises `InputError` as `export_study`, before anything is meshed.
    """
    if to not in FORMATS:
        raise InputError(f"{to!r} is no format", place="--to", remedy=f"give one of {', '.join(FORMATS)}")
    chosen, store = _select_chosen(study, to, site), Store(study.results)
    used, origin = choose_parameters(study, parameters)
    context = Context(study, store, SerialExecutor(), ignore_progress)
    kinds = {(one.indenter, one.forced): one for one in chosen}
    with TemporaryDirectory() as folder:
        file = Path(folder) / "block.vtu"
        # In layers of the study's tissues, under a skin, held below.
        mesh = build_layered_block(ELEMENTS[study.mesh.element].cell_type, _DIVISIONS)
        middles = mesh.points[mesh.corners].mean(axis=1)[:, 2]
        ranks = np.argsort(np.argsort(-middles, kind="stable"), kind="stable")
        block = replace(
            mesh,
            regions=ranks * len(study.tissues) // len(ranks),
            region_names=study.tissues,
            node_sets={"fixed_bottom": mesh.node_sets["bottom"]},
        )
        write_vtu(block, file)
        for one in kinds.values():
            model = _build_block_model(study, one, file)
            problem = build_problem(model, block, used)
            if study.clamps is not None:
                later = problem.history.delay(study.clamps.begun_s)
                problem = replace(problem, history=later, touch_down_s=study.clamps.begun_s)
            prepared = PreparedIndentation(context, one, model, used, origin)
            with name_file_in_errors(study.file, about=f"{one.name}: "):
                _write(prepared, problem, to, Path(folder), _NO_CURVE)
    return chosen


def _build_block_model(study: Study, one: Indentation, file: Path) -> SiteModel:
    """An indentation in the middle of that block's top, without pins.

    Its penalty is any: that of a site is found by solving, and nobody reads what is written of the block.
    """
    solver = study.solver.model_copy(update={"penalty_per_mm": study.solver.penalty_per_mm or 1.0})
    model = build_block_model(one.name, file, solver, study.mesh.element)
    along = (0.0, 0.0, 1.0)
    return replace(
        model,
        knots_N=(0.0, 1.0, 0.0) if one.forced else (),
        indenter=study.indenter_of(one),
        fibres=tuple((tissue, along) for tissue in study.fibres),
        **list_material_fields(study),
    )


def _select_chosen(study: Study, to: str, site: str | None) -> Sequence[Indentation]:
    if site is not None:
        one = study.indentation(site)
        if to == FITTED and not isinstance(one, Record):
            raise InputError("has no record to fit", file=study.file, place=f"sites.{site}")
        return (one,)
    if to == FITTED:
        if not study.fitted:
            raise InputError("no site is fitted", file=study.file, remedy="give --site")
        return study.records_at(*study.fitted)
    return study.indentations


def _write(
    prepared: PreparedIndentation, problem: Problem, to: str, folder: Path, curve: tuple[Array, Array]
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """The files of a site, and what the other solver does otherwise; ``curve``: what its fit compares."""
    name = prepared.model.name
    settings = prepared.build_feb_settings(f"{name}-forces.txt")
    if to == "feb":
        febio.write_feb(problem, folder / f"{name}.feb", settings)
        return (folder / f"{name}.feb",), febio.describe_differences(problem, settings)
    if to == FITTED:
        law = prepared.study.material.law
        if not is_ogden(law):
            what = f'FEBio\'s fit is written for "{OGDEN}", whatever its relaxation terms, not for "{law}"'
            raise InputError(what, remedy="identify with limbfit")
        febio.check_optimisable(problem)
        control, model = folder / f"{name}-optimize.feb", folder / f"{name}-model.feb"
        # FEBio's fit takes its automatic penalty of a step of no time: another one than in a plain run.
        settings = replace(settings, penalty=None)
        turned = febio.turn_to_indenter_frame(problem)
        febio.write_feb(turned, model, settings)
        ranges = _build_ranges(prepared, problem.mesh.region_names)
        iterations = prepared.study.calibration.max_iterations
        febio.write_optimisation(control, ranges, *curve, iterations=iterations)
        return (control, model), febio.describe_differences(turned, settings)
    program = "abaqus" if to == "inp" else to
    febio.write_inp(problem, folder / f"{name}.inp", program, settings)
    return (folder / f"{name}.inp",), ()


def _build_ranges(prepared: PreparedIndentation, tissues: Sequence[str]) -> dict[str, febio.ParameterRange]:
    """Start and bounds of the tissues, in the solver's units."""
    study = prepared.study
    ranges = {}
    for tissue in tissues:
        start = prepared.parameters[tissue]
        lower, upper = (study.material.of(tissue, bound) for bound in ("lower", "upper"))
        for key, value in start.items():
            if not lower[key] <= value <= upper[key]:
                what = f"{tissue}.{key} = {value:g} lies outside its bounds, {lower[key]:g} to {upper[key]:g}"
                raise InputError(what, file=study.file, place="material")
        start, lower, upper = map(study.law.in_solver_units, (start, lower, upper))
        ranges[tissue] = febio.ParameterRange(start, lower, upper, study.material.kappa_ratio)
    return ranges
