"""One indentation of a study, or a FEBio input outside any study, simulated and stored for ParaView."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...execution import SerialExecutor
from ...fe import Problem, Result, Step
from ...febio import FebSettings, build_result, compute_end_time, find_febio, run_feb, run_febio, write_feb
from ...fields import write_fields
from ...identify.checks.domain import RecordedRange, describe_outside
from ...indentation import Parameters, SiteModel, build_first_steps, build_problem, simulate_fields
from ...mesh import read_vtu
from ...results.identification import RecordedExtents
from ...results.runs import SimulateResult
from ...study import Indentation, Study
from ..engine.context import Context, Listener, Progress, ignore_progress
from ..engine.store import Store, write_curves, write_result
from ..records.records import build_model
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.loading import LimbAxis, LoadHistory, describe_indentation, read_strain_extents
from ..simulation.simulations import CURVE_POINTS
from .experiments import IDENTIFIED
from .run import ensure_compiled, is_done, run_study

FEB_NAME, FORCES = "model.feb", "forces.txt"


@dataclass(frozen=True)
class PreparedIndentation:
    """An indentation of a study, ready to be simulated: ``origin`` says where the parameters are from."""

    context: Context
    stated: Indentation
    model: SiteModel
    parameters: Parameters
    origin: str

    @property
    def study(self) -> Study:
        return self.context.study

    def build_problem(self) -> Problem:
        """The problem that `simulate_site` solves."""
        return build_problem(self.model, read_vtu(self.model.mesh), self.parameters)

    def build_feb_settings(self, force_file: str) -> FebSettings:
        """What is written for FEBio beside the problem."""
        study, name = self.study, self.model.name
        title = f"{study.study.name}, site {name}, parameters: {self.origin}"
        steps = build_first_steps(self.model, study.tissues)
        return FebSettings(study.febio.penalty, steps, force_file, title)


def prepare_site(
    study: Study, name: str, *, parameters: Parameters | None = None, listener: Listener = ignore_progress
) -> PreparedIndentation:
    """A site as recorded, or as the study plans it; meshes are made where missing. Errors as `simulate_site`.

    ``name``: of a site with one record at most, or of a record. ``parameters``: per tissue; by default the
    identified ones, or the study's start where none were identified.
    """
    stated = study.indentation(name)
    used, origin = choose_parameters(study, parameters)
    run_study(study, until="mesh", listener=listener)
    ensure_compiled()
    context = Context(study, Store(study.results), SerialExecutor(), listener)
    return PreparedIndentation(context, stated, build_model(context, stated), used, origin)


def simulate_site(
    study: Study,
    name: str,
    *,
    parameters: Parameters | None = None,
    animation: bool = False,
    solver: str | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Simulate one indentation; curve and fields at the deepest point go to ``results/simulate``.

    ``name``, ``parameters``: as `prepare_site`. ``animation``: also the fields of every step, as a PVD
    collection. ``solver``: ``limbfit`` or ``febio``, by default what the study says; FEBio's fields stay in
    its own file. Raises `InputError` for a site that the study does not have, identified parameters that are
    stale, or any input of the stages before.
    """
    by_febio = (solver or study.solver.solver) == "febio"
    program = find_febio(study.febio.program, study.folder) if by_febio else None
    if program is not None and animation:
        raise InputError("FEBio's fields are in its plot file", place="--animation", remedy="leave it out")
    prepared = prepare_site(study, name, parameters=parameters, listener=listener)
    context, model, name = prepared.context, prepared.model, prepared.model.name
    folder = context.store["simulate"]
    folder.mkdir(exist_ok=True)
    for kind in ("json", "csv", "vtu", "pvd"):
        (folder / f"{name}.{kind}").unlink(missing_ok=True)  # that of another simulation
    curve = folder / f"{name}.csv"
    played = folder / f"{name}.pvd" if animation else None
    context.tell("simulate", 0, 1, f"site {name}")
    if program is not None:
        result, fields = run_febio_site(prepared, program, folder / f"{name}.febio")
    else:
        fields = folder / f"{name}.vtu"
        result = simulate_fields(model, prepared.parameters, fields, played)
    context.tell("simulate", 1, 1, f"site {name}")
    write_site_curve(model, result, curve)
    files = {"curve": curve, "fields": fields if fields.is_file() else None, "animation": played}
    # A path may tell who the patient is: what is stored names the files as they lie beside it.
    beside: dict[str, Any] = {
        kind: file and file.relative_to(folder).as_posix() for kind, file in files.items()
    }
    stored = SimulateResult(
        site=name,
        solver="limbfit" if program is None else result.statistics["linear_solver"],
        parameters=prepared.parameters,
        parameters_from=prepared.origin,
        peak_force_N=result.peak_force,
        depth_mm=float(result.displacement.max()),
        # FEBio says nothing of its penetration.
        penetration_mm=float(result.penetration.max(initial=0.0)) if program is None else None,
        completed=result.completed,
        reason=result.reason,
        warnings=result.warnings,
        element=result.statistics["element"],
        unknowns=result.statistics["unknowns"],
        **_compare_with_records(prepared, result, None if program else fields),
        **beside,
    )
    write_result(folder / f"{name}.json", stored)
    return stored.to_plain() | {kind: file and str(file) for kind, file in files.items()}


def write_site_curve(model: SiteModel, result: Result, file: Path) -> None:
    """Write displacement and force of an indentation over the time from touch-down, as far as it came."""
    times = model.curve_times(CURVE_POINTS)
    if not result.completed:
        times = times[times + model.waits_s <= result.times[-1]]
    own = times + model.waits_s  # of the simulation
    write_curves(
        file, time_s=times, displacement_mm=result.displacement_at(own), force_N=result.force_at(own)
    )


def _compare_with_records(
    prepared: PreparedIndentation, result: Result, fields: Path | None
) -> dict[str, Any]:
    """What of an indentation no fitted record did, and in words; None where that is not known.

    ``fields`` at its deepest point; without them strains are not compared.
    """
    model = prepared.model
    stored = read_recorded_range(prepared.study) if prepared.origin == IDENTIFIED else None
    if stored is None:
        return {"outside_records": None, "outside_text": []}
    tested, limb = RecordedRange.from_stored(stored), LimbGeometry.from_store(prepared.context.store)
    rows = tested.find_outside(
        describe_indentation(
            LoadHistory.from_knots(model.knots_s, model.knots_N or model.knots_mm),
            float(result.displacement.max()),
            model.indenter,
            limb.place(prepared.stated.site),
            LimbAxis(limb.anatomy),
            force_N=result.peak_force,
            strains=read_strain_extents(fields) if fields is not None and fields.is_file() else (),
            tested=tested,
        )
    )
    return {"outside_records": rows, "outside_text": describe_outside({f"site {prepared.model.name}": rows})}


def run_febio_site(prepared: PreparedIndentation, program: Path, folder: Path) -> tuple[Result, Path]:
    """The site solved by FEBio in ``folder``, and its plot file; a failure is a result with its reason."""
    problem, options = prepared.build_problem(), prepared.study.febio
    folder.mkdir(parents=True, exist_ok=True)
    write_feb(problem, folder / FEB_NAME, prepared.build_feb_settings(FORCES))
    end = compute_end_time(problem)
    run = run_febio(program, folder, end, FORCES, threads=options.threads, time_limit_s=options.time_limit_s)
    return build_result(problem, run.log, run.verdict, run.seconds), folder / "model.xplt"


def read_recorded_range(study: Study) -> RecordedExtents | None:
    """What the fitted records did to the tissue; None where the prediction, which stores it, is not done."""
    return Store(study.results).results.predict.recorded_range if is_done(study, "predict") else None


def choose_parameters(study: Study, given: Parameters | None = None) -> tuple[Parameters, str]:
    """The ``given`` parameters, else the identified ones, else the study's start; and which they are.

    Neither of the latter will do where the calibration is stale: it is not this study's, and who has
    identified a model does not expect the start.
    """
    store = Store(study.results)
    if given:
        if not all(key in given.get(tissue, {}) for tissue, key in study.parameters):
            what = f"the parameters lack some of {', '.join(study.law.keys)}"
            raise InputError(what, remedy=f"give all of them for each of {', '.join(study.tissues)}")
        return given, "given"
    if store.stamp("calibrate") is None:
        start = {tissue: study.material.get(tissue, "start") for tissue in study.tissues}
        return start, "start of the study"
    if not is_done(study, "calibrate"):
        what = "the identified parameters are stale: made from other inputs, settings or code"
        remedy = "identify again (limbfit run), or give --parameters"
        raise InputError(what, file=store["calibrate"] / "calibration.json", remedy=remedy)
    return store.results.calibration.parameters, IDENTIFIED


def simulate_feb(
    file: str | Path,
    output: str | Path | None = None,
    *,
    threads: int = 1,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Solve a FEBio 3 or 4 input; the tables that it asks for go to ``output``, by default beside it.

    The fields at the deepest point go there too, as VTU.  Without ``output`` a table that is there already,
    FEBio's own for example, is not written over but refused.

    Raises `InputError` where the file cannot be read, or holds what limbfit does not know; with its line; and
    `RunError` where the tables cannot be written.
    """
    name, told = Path(file).name, 0.0

    def tell(step: Step, last: float) -> None:
        nonlocal told
        if step.time >= told:
            told = min(step.time + 0.05 * last, last)
            listener(Progress("febio", step.time, last, f"{name}: {step.force:.3g} N"))

    folder = Path(file).parent if output is None else output
    found = run_feb(file, folder, tell, keep=output is None, threads=threads)
    result = found.result
    fields = Path(folder) / f"{Path(file).stem}-peak.vtu"
    if result.states:
        write_fields(result.system, result.problem, result.states[0], fields)
    pushed = result.problem.indenter is not None
    return {
        "file": str(file),
        "completed": result.completed,
        "reason": result.reason,
        "warnings": list(result.warnings),
        "notes": list(found.notes),
        "peak_force_N": result.peak_force if pushed else None,
        "times_s": result.times.tolist(),
        "displacement_mm": result.displacement.tolist(),
        "force_N": result.force.tolist() if pushed else None,
        "penetration_mm": float(result.penetration.max(initial=0.0)),
        "element": result.statistics["element"],
        "unknowns": result.statistics["unknowns"],
        "steps": result.statistics["steps"],
        "fields": str(fields) if result.states else None,
        "files": [str(path) for path in found.files],
    }
