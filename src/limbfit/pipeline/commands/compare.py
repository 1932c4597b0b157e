"""One indentation by limbfit and by FEBio: same mesh, same history, both curves and their difference."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ... import febio
from ...arrays import Array
from ...errors import InputError, add_location
from ...fe import Problem, Result, System, solve
from ...fe.solution.control import schedule_steps
from ...indentation import Parameters, build_first_steps
from ...results.runs import CompareResult, CurveDifference, CurveFiles, FebioSimulation, LimbfitSimulation
from ...study import Study
from ..engine.context import Listener, ignore_progress
from ..engine.files import write_curves, write_result
from .simulate import PreparedIndentation, prepare_site, run_febio_site

MAX_PENETRATION = 1.0  # penetration over the depth: FEBio's punch sinks in as far as its penalty lets it


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

    Parameters
    ----------
    parameters : per tissue; by default the identified ones, or the study's start where none were identified.
    febio_log : the table of the indenter's force that FEBio wrote elsewhere, for the exported input; FEBio
        itself is then not needed.

    Raises
    ------
    InputError
        Where FEBio is absent and no table is given, where the table is not one of this indentation, and as
        `prepare_site`.
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
    curves = {key: run.force_at(times) for key, run in runs.items()}
    febio_N = by_febio.force[: len(times)]
    write_curves(
        Path(files.csv),
        time_s=times,
        displacement_mm=by_febio.displacement[: len(times)],
        febio_N=febio_N,
        **{f"{key}_N": force for key, force in curves.items()},
    )
    _draw(Path(files.png), name, times, febio_N, curves)


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


def _draw(file: Path, name: str, times: Array, febio_N: Array, curves: dict[str, Array]) -> None:
    words = {"limbfit": "limbfit", "limbfit_matched": "limbfit, FEBio's contact penalty"}
    with matplotlib.rc_context({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False}):
        drawing = Figure(figsize=(9.6, 3.2), layout="constrained", dpi=150)
        left, right = drawing.subplots(1, 2)
        left.plot(times, febio_N, "o", ms=3.5, mfc="none", color="0.3", label="FEBio")
        for (key, force), style in zip(curves.items(), ("-", "--")):
            left.plot(times, force, style, label=words[key])
            right.plot(times, 100.0 * (force - febio_N) / max(febio_N.max(initial=0.0), 1e-12), style)
        left.set(xlabel="Time (s)", ylabel="Force (N)", title=f"Site {name}")
        right.set(xlabel="Time (s)", ylabel="Difference (% of FEBio's peak)")
        left.legend(frameon=False)
        drawing.savefig(file)
