"""Indentations of a study by other solvers, with the same numbers: their inputs, and FEBio beside limbfit."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ... import febio
from ...arrays import Array
from ...bench.timing import build_block_model, build_layered_block
from ...errors import InputError, add_location
from ...execution import SerialExecutor
from ...fe import ELEMENTS, Problem, Result, System, solve
from ...fe.solution.control import schedule_steps
from ...indentation import Parameters, SiteModel, build_first_steps, build_problem
from ...laws import OGDEN, is_ogden
from ...mesh import write_vtu
from ...results.runs import CompareResult, CurveDifference, CurveFiles, FebioSimulation, LimbfitSimulation
from ...study import Indentation, Record, Study
from ..engine.context import Context, Listener, ignore_progress, name_file_in_errors
from ..engine.store import Store, write_curves, write_result
from ..records.records import load_site_record
from ..simulation.limb_geometry import list_material_fields
from .simulate import PreparedIndentation, choose_parameters, prepare_site, run_febio_site

FITTED = "febio-optimize"
FORMATS = ("feb", FITTED, "inp", "calculix")
_DIVISIONS = 4  # of the block on which an export is tried
_NO_CURVE = np.array([0.0, 1.0]), np.zeros(2)
MAX_PENETRATION = 1.0  # penetration over the depth: FEBio's punch sinks in as far as its penalty lets it


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

    Raises `InputError` for an unknown site or format, and where the other solver has no such material,
    element or contact; and `RunError` where a file cannot be written.

    Parameters
    ----------
    to : ``feb`` (FEBio 4), ``febio-optimize`` (FEBio's parameter optimisation: control file and model, for
        each fitted site; FEBio fits one model at a time), ``inp`` (Abaqus) or ``calculix``.
    output : a folder; by default ``results/export``.
    parameters : per tissue; by default the identified ones, or the study's start where none were identified.
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
                later = problem.history.delay(study.clamps.lead_s)
                problem = replace(problem, history=later, touch_down_s=study.clamps.lead_s)
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
        lower, upper = (study.material.get(tissue, bound) for bound in ("lower", "upper"))
        for key, value in start.items():
            if not lower[key] <= value <= upper[key]:
                what = f"{tissue}.{key} = {value:g} lies outside its bounds, {lower[key]:g} to {upper[key]:g}"
                raise InputError(what, file=study.file, place="material")
        start, lower, upper = map(study.law.in_solver_units, (start, lower, upper))
        ranges[tissue] = febio.ParameterRange(start, lower, upper, study.material.kappa_ratio)
    return ranges


def compare_site(
    study: Study,
    name: str,
    *,
    parameters: Parameters | None = None,
    febio_log: str | Path | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Solve a site by limbfit and by FEBio; JSON, CSV and a picture go to ``results/compare``.

    limbfit solves it twice: as ``limbfit simulate`` does, and with the mean contact penalty of FEBio, which
    shows how much of the difference is how far the indenter sinks in.

    Raises `InputError` where FEBio is absent and no table is given, where the table is not one of this
    indentation, and as `prepare_site`.

    ``parameters``: per tissue; by default the identified ones, or the study's start where none were
    identified. ``febio_log``: the table of the indenter's force that FEBio wrote elsewhere, for the exported
    input; FEBio itself is then not needed.
    """
    if study.indentation(name).forced:
        what = f"{name}: a force drives the indenter, and there is none to be compared"
        raise InputError(what, file=study.file, remedy="compare limbfit simulate --solver limbfit and febio")
    source: Path | febio.FebioLog
    if febio_log is None:
        source = febio.find_febio(study.febio.program, study.folder)
    else:
        source = febio.read_log(febio_log)
    prepared = prepare_site(study, name, parameters=parameters, listener=listener)
    folder, name = prepared.context.store["compare"], prepared.model.name
    folder.mkdir(parents=True, exist_ok=True)
    problem = prepared.build_problem()
    prepared.context.tell("compare", 0, 3, f"site {name}: FEBio")
    with add_location(file=febio_log):
        by_febio = _solve_by_febio(prepared, problem, source, folder / f"{name}.febio")
    prepared.context.tell("compare", 1, 3, f"site {name}: limbfit")
    steps = build_first_steps(prepared.model, prepared.study.tissues)
    runs = {
        "limbfit": solve(problem, steps, store="none"),  # as `limbfit simulate` does
        "limbfit_matched": _solve_matched(prepared, problem, by_febio),
    }
    prepared.context.tell("compare", 3, 3, f"site {name}")
    files = CurveFiles(csv=str(folder / f"{name}.csv"), png=str(folder / f"{name}.png"))
    _store_curves(name, by_febio, runs, files)
    content = CompareResult(
        site=name,
        parameters=prepared.parameters,
        parameters_from=prepared.origin,
        element=by_febio.statistics["element"],
        unknowns=runs["limbfit"].statistics["unknowns"],
        febio=FebioSimulation(
            **_summarise_solver(by_febio),
            version=by_febio.statistics["linear_solver"],
            penalty=prepared.study.febio.penalty,
        ),
        **{
            key: LimbfitSimulation(
                **_summarise_solver(run),
                penetration_mm=float(run.penetration.max(initial=0.0)),
                difference=compute_difference(by_febio, run),
            )
            for key, run in runs.items()
        },
        febio_log=None if febio_log is None else str(febio_log),
        files=files,
    )
    write_result(folder / f"{name}.json", content)
    return content.to_plain()


def _solve_by_febio(
    prepared: PreparedIndentation, problem: Problem, source: Path | febio.FebioLog, folder: Path
) -> Result:
    """FEBio's result: of its program, run in a ``folder``, or of a table that it wrote.

    It is partial where the table ends before the problem does.
    """
    if isinstance(source, Path):
        result, _ = run_febio_site(prepared, source, folder)
        return result
    reached, end = float(source.times[-1]), febio.compute_end_time(problem)
    complete = reached > end * (1.0 - febio.TIME_TOLERANCE)
    reason = "" if complete else f"the table ends at {reached:.4g} s of {end:.4g} s"
    verdict = febio.RunVerdict("normal" if complete else "partial", reason, reached, "")
    return febio.build_result(problem, source, verdict)


def _solve_matched(prepared: PreparedIndentation, problem: Problem, by_febio: Result) -> Result:
    """limbfit with FEBio's steps, its course of the stress in them and its contact penalty."""
    name = prepared.model.name
    prepared.context.tell("compare", 2, 3, f"site {name}: limbfit with FEBio's contact and steps")
    settings = prepared.build_feb_settings("")
    end = float(problem.history.times[-1])
    times = np.minimum(by_febio.times[1:], end)  # a table has nine digits
    if not len(times):  # FEBio got nowhere: all the way then
        times = schedule_steps(problem.history, settings.steps)
    contact = febio.build_contact(problem, settings)
    penalty = febio.compute_mean_penalty(contact, problem, float(times[0]))
    control = replace(settings.steps, times=tuple(times), stress="linear")
    control = replace(control, penalty=penalty, penetration=MAX_PENETRATION)
    system = System(problem)
    weights = febio.FacePenalties(system, (contact,) * len(problem.rigid_bodies), times)
    return solve(problem, control, store="none", on_step=weights.update_after, system=system)


def _store_curves(name: str, by_febio: Result, runs: Mapping[str, Result], files: CurveFiles) -> None:
    """All curves as a table and a picture, as far as every simulation went."""
    times = _select_common_times(by_febio, min(runs.values(), key=lambda run: run.times[-1]))
    curves = {f"{key}_N": run.force_at(times) for key, run in runs.items()}
    displacement_mm, febio_N = by_febio.displacement[: len(times)], by_febio.force[: len(times)]
    columns = {"time_s": times, "displacement_mm": displacement_mm, "febio_N": febio_N}
    write_curves(Path(files.csv), **columns, **curves)
    labels = ("limbfit", "limbfit, FEBio's contact penalty")
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        drawing = Figure(figsize=(9.6, 3.2), layout="constrained", dpi=150)
        left, right = drawing.subplots(1, 2)
        left.plot(times, febio_N, "o", ms=3.5, mfc="none", color="0.3", label="FEBio")
        for force, label, style in zip(curves.values(), labels, ("-", "--"), strict=True):
            left.plot(times, force, style, label=label)
            right.plot(times, 100.0 * (force - febio_N) / max(febio_N.max(initial=0.0), 1e-12), style)
        left.set(xlabel="Time (s)", ylabel="Force (N)", title=f"Site {name}")
        right.set(xlabel="Time (s)", ylabel="Difference (% of FEBio's peak)")
        left.legend(frameon=False)
        drawing.savefig(files.png)


def _select_common_times(by_febio: Result, by_limbfit: Result) -> Array:
    """FEBio's own times, as far as both went."""
    return by_febio.times[by_febio.times <= by_limbfit.times[-1] * (1.0 + 1e-9)]


def compute_difference(by_febio: Result, by_limbfit: Result) -> CurveDifference:
    """limbfit less FEBio at FEBio's own times, in percent of FEBio's largest force."""
    times = _select_common_times(by_febio, by_limbfit)
    febio_N, limbfit_N = by_febio.force[: len(times)], by_limbfit.force_at(times)
    peak = float(febio_N.max(initial=0.0))
    if peak <= 0.0:
        return CurveDifference(max_percent=None, mean_percent=None, peak_percent=None)
    gap = np.abs(limbfit_N - febio_N)
    return CurveDifference(
        max_percent=100.0 * float(gap.max()) / peak,
        mean_percent=100.0 * float(gap.mean()) / peak,
        peak_percent=100.0 * (float(limbfit_N.max()) - peak) / peak,
    )


def _summarise_solver(run: Result) -> dict[str, Any]:
    return {
        "completed": run.completed,
        "reason": run.reason,
        "peak_force_N": run.peak_force,
        "steps": run.statistics["steps"],
        "seconds": run.statistics["seconds"]["total"] or None,
    }
