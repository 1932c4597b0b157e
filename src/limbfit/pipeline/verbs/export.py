"""Indentations of a study as inputs of other solvers, with the same numbers as ``limbfit simulate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...febio import (
    Range,
    check_fitted,
    differences,
    in_indenter_frame,
    write_feb,
    write_inp,
    write_optimisation,
)
from ...indentation import Parameters
from ...study import Indentation as Planned
from ...study import Record, Study
from ..shared.context import Listener, quiet
from ..stages.records import site_record
from .simulate import Indentation, feb_settings, prepare_site, site_problem

FORMATS = ("feb", "febio-optimize", "inp", "calculix")


def export_study(
    study: Study,
    to: str,
    *,
    site: str | None = None,
    output: str | Path | None = None,
    parameters: Parameters | None = None,
    listener: Listener = quiet,
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
    if to not in FORMATS:
        raise InputError(f"{to!r} is no format", place="--to", remedy=f"give one of {', '.join(FORMATS)}")
    chosen = _chosen(study, to, site)
    folder = study.results / "export" if output is None else Path(output)
    rows = []
    for one in chosen:
        found = prepare_site(study, one.name, parameters=parameters, listener=listener)
        folder.mkdir(parents=True, exist_ok=True)
        files, notes = _write(found, to, folder)
        rows.append(
            {
                "site": one.name,
                "parameters": found.parameters,
                "parameters_from": found.origin,
                "files": [str(file) for file in files],
                "notes": list(notes),
            }
        )
    return {"format": to, "sites": rows}


def _chosen(study: Study, to: str, site: str | None) -> Sequence[Planned]:
    if site is not None:
        one = study.indentation(site)
        if to == "febio-optimize" and not isinstance(one, Record):
            raise InputError("has no record to fit", file=study.file, place=f"sites.{site}")
        return (one,)
    if to == "febio-optimize":
        if not study.fitted:
            raise InputError("no site is fitted", file=study.file, remedy="give --site")
        return study.records_at(*study.fitted)
    return study.indentations


def _write(found: Indentation, to: str, folder: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """The files of a site, and what the other solver does otherwise."""
    name, problem = found.name, site_problem(found)
    settings = feb_settings(found, f"{name}-forces.txt")
    if to == "feb":
        write_feb(problem, folder / f"{name}.feb", settings)
        return (folder / f"{name}.feb",), differences(problem, settings)
    if to == "febio-optimize":
        if problem.fibres is not None:
            raise InputError("FEBio's fit is written for tissues without fibres", place="--to")
        check_fitted(problem)
        control, model = folder / f"{name}-optimize.feb", folder / f"{name}-model.feb"
        # FEBio's fit takes its automatic penalty of a step of no time: another one than in a plain run.
        settings = replace(settings, penalty=None)
        turned = in_indenter_frame(problem)
        write_feb(turned, model, settings)
        assert isinstance(found.stated, Record)
        record = site_record(found.context, found.stated)
        inside = (record.times_s >= 0.0) & (record.times_s <= problem.history.times[-1])
        ranges = _ranges(found, problem.mesh.region_names)
        iterations = found.context.study.calibration.max_iterations
        write_optimisation(
            control, ranges, record.times_s[inside], record.force_N[inside], iterations=iterations
        )
        return (control, model), differences(turned, settings)
    program = "abaqus" if to == "inp" else to
    write_inp(problem, folder / f"{name}.inp", program, settings)
    return (folder / f"{name}.inp",), ()


def _ranges(found: Indentation, tissues: Sequence[str]) -> dict[str, Range]:
    """Start and bounds of the tissues, in the solver's units."""
    study = found.context.study
    ranges = {}
    for tissue in tissues:
        start, lower, upper = (
            found.parameters[tissue],
            study.material.of(tissue, "lower"),
            study.material.of(tissue, "upper"),
        )
        for key, value in start.items():
            if not lower[key] <= value <= upper[key]:
                what = f"{tissue}.{key} = {value:g} lies outside its bounds, {lower[key]:g} to {upper[key]:g}"
                raise InputError(what, file=study.file, place="material")
        start, lower, upper = map(study.law.in_solver_units, (start, lower, upper))
        ranges[tissue] = Range(start, lower, upper, study.material.kappa_ratio)
    return ranges
