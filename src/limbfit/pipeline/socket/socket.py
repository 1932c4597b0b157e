"""The experiment ``socket``: the limb in its socket, donned, held and loaded."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...anatomy.surfaces.surfaces import write_surface
from ...arrays import Array
from ...donning import DonningResult
from ...donning.model import OUTER
from ...identify.checks.domain import Extent, RecordedRange, describe_outside
from ...identify.fit.prediction import RelaxationSpread
from ...indentation import Parameters
from ...mesh import write_vtu
from ...results.identification import RecordedExtents, RelaxationBeyond
from ...results.socket import SocketResult, SocketSamples, SocketShape
from ...socket import Socket
from ...socket.landmarks import find_bone
from ...socket.published import select_published_findings
from ...study import Study
from ..engine.context import NO_PARAMETERS, Context
from ..engine.store import RUNS, ResultFiles, write_result, write_table
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.loading import NEAR_MM, LimbAxis, describe_socket_load, name_load, time_socket_loads
from .intervals import CHANGE_PERCENT, FRICTION, ParameterSpread, draw_step, store_change, widen_intervals
from .measured import compare_measured, describe_measured
from .shape import build_loadable_socket, check_tissues
from .simulation import SocketLimb, SocketRun, run_sockets, simulate_socket, solve_run, summarise_run

NAME = "socket"
NOT_COMPARED = (
    "what the fitted records did to the tissue is not stored, and the socket is not compared with it: "
    "limbfit run, then limbfit socket again"
)


def check_socket(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse tissues as `check_tissues`, and a shape or load that the limb cannot have."""
    check_tissues(study)
    if limb is not None:
        build_loadable_socket(study, limb.anatomy, limb.anatomy.skin)
    describe_measured(study, None if limb is None else limb.anatomy)


def run_socket(
    context: Context,
    folder: Path,
    *,
    parameters: Parameters = NO_PARAMETERS,
    parameters_from: str = "",
    covariance_log: Sequence[Sequence[float]] | None = None,
    most_probable: Parameters | None = None,
    recorded_range: Mapping[str, Any] | None = None,
    relaxation: Mapping[str, Any] | None = None,
    samples: int = 0,
) -> None:
    """Pressure, shear and settling in the study's socket at the ``parameters`` of the tissues.

    Parameters
    ----------
    covariance_log : (p, p) that of the parameters' logarithms, where they were identified.
    most_probable : parameters that intervals cover too; none: those that are simulated.
    recorded_range : what the fitted records did to the tissue, from ``predict.json``; None: not known.
    relaxation : ``beyond`` of the calibration's; intervals cover what it leaves of the moduli when the socket
        has been worn for ``socket.worn_s``.
    samples : draws from it that are simulated too, and more friction; the intervals then count what
        derivatives miss.
    """
    study, tell = context.study, partial(context.tell, NAME, 0, 0)
    limb = SocketLimb.from_store(study, context.store, tell)
    socket = build_loadable_socket(study, limb.anatomy, limb.outer.skin)
    write_surface(folder / "socket.stl", socket.surface)
    mesh, facts = limb.mesh(folder, socket, tell)
    kept = ResultFiles(folder / RUNS, also=[context.store[NAME] / RUNS])
    with_slopes = covariance_log is not None
    run = SocketRun(NAME, limb.build_model(socket, mesh), parameters, kept, sensitivities=with_slopes)
    limb.write_face(socket, folder / "socket-face.vtp")
    found = solve_run(run, partial(context.tell, NAME))
    known = None
    if covariance_log is not None:
        off = np.log(study.vector(most_probable or parameters) / study.vector(parameters))
        known = _build_spread(np.array(covariance_log), off, relaxation, study.socket.worn_s)
    content = summarise_run(run, found, known)
    compared = _compare_with_records(limb, run, found, recorded_range)
    for held in (content["donning"], *content["loads"]):
        held |= compared[held.get("name", "donning")]
    outside_text, simulated = list[str](), None
    if covariance_log is not None:
        outside = {name_load(name): one["outside_records"] for name, one in compared.items()}
        outside_text = describe_outside(outside) if recorded_range else [NOT_COMPARED]
        if samples:
            steps = [draw_step(np.array(covariance_log), number) for number in range(samples)]
            simulated = _simulate_samples(context, run, content, steps)
    sensors, agreement = compare_measured(limb, run, found, content)
    result = SocketResult(
        **content,
        parameters=parameters,
        parameters_from=parameters_from,
        socket=_describe_shape(limb, socket),
        mesh=facts,
        # All that was found is of transtibial limbs.
        published=select_published_findings(run.model.faces) if find_bone(limb.anatomy, "tibia") else [],
        samples=simulated,
        worn_s=None if relaxation is None else study.socket.worn_s,
        outside_text=outside_text,
        sensors=sensors,
        agreement=agreement,
    )
    write_result(folder / "socket.json", result)
    for i, one in enumerate(found.held.values()):
        fields = {"pressure_kPa": one.pressure, "shear_kPa": one.shear, "displacement_mm": one.displacement}
        write_vtu(mesh, folder / f"held-{i}.vtu", point_data=fields, cell_data=one.strains.fields)
    _write_tables(folder, result)
    kept.drop(run.partial_key)


def _build_spread(
    covariance: Array, off: Array, relaxation: Mapping[str, Any] | None, worn_s: float
) -> ParameterSpread:
    """How well parameters are known, with ``relaxation`` beyond the records in a socket worn for so long."""
    if relaxation is None:
        return ParameterSpread(covariance, off)
    spread = RelaxationSpread.from_stored(RelaxationBeyond.model_validate(relaxation))
    own = spread.own_weight
    return ParameterSpread(own * covariance, own * off, *spread.interpolate(worn_s))


def _describe_shape(limb: SocketLimb, face: Socket) -> SocketShape:
    table = limb.study.socket
    return SocketShape(
        source="rectified" if table.file is None else table.file.name,
        reduction_percent=table.reduction_percent if table.file is None else None,
        areas=[area.name for area in table.areas],
        volume_cm3=face.volume_mm3 / 1000.0,
        deepest_mm=face.offset(limb.outer.skin).max(),
        notes=list(face.notes),
        liner=limb.liner,
    )


def _compare_with_records(
    limb: SocketLimb, run: SocketRun, found: DonningResult, stored: Mapping[str, Any] | None
) -> dict[str, dict[str, Any]]:
    """What donning and each load do to the tissue, and what of it no fitted record did, by name.

    None where what the records did is not known.
    """
    if stored is None:
        return {name: {"loading": None, "outside_records": None} for name in found.held}
    tested = RecordedRange.from_stored(RecordedExtents.model_validate(stored))
    axis, before = LimbAxis(limb.anatomy), list[Extent]()
    mesh, study = run.model.mesh, limb.study
    near_mm = NEAR_MM + study.socket.liner.thickness_mm
    compared, histories = {}, time_socket_loads(study.socket)
    for name, held in found.held.items():
        before = describe_socket_load(
            mesh, mesh.face_sets[OUTER], held, before, histories[name], study.tissues, near_mm, axis,
            tested,
        )  # fmt: skip
        compared[name] = {"loading": before, "outside_records": tested.find_outside(before)}
    return compared


def _simulate_samples(
    context: Context, run: SocketRun, content: dict[str, Any], steps: Sequence[Array]
) -> SocketSamples:
    """Simulate parameters whose logarithms differ by ``steps (k,)``, and widen the intervals by the misses.

    More friction is simulated beside them, where there is some, and what it changes stored. Told are how many
    draws came to their end, and why others did not.
    """
    study, plain = context.study, replace(run, sensitivities=False)
    at = study.vector(run.parameters)
    jobs = [
        replace(plain, name=f"draw {n}", parameters=study.by_tissue(at * np.exp(step)))
        for n, step in enumerate(steps, 1)
    ]
    fit = run.model.fit
    if not isinstance(fit.friction, str) and fit.friction > 0.0:
        rougher = replace(fit, friction=fit.friction * (1.0 + CHANGE_PERCENT / 100.0))
        jobs.append(replace(plain, name=FRICTION, model=replace(run.model, fit=rougher)))
    tell = partial(context.tell, NAME)
    reasons = run_sockets(jobs, context.executor, lambda done, words: tell(done, len(jobs), words))
    ended = [None if reason else simulate_socket(one)[0] for one, reason in zip(jobs, reasons, strict=True)]
    for other in filter(None, ended[len(steps) :]):
        store_change(content, other, FRICTION)
    names = [f"{tissue}.{name}" for tissue, name in study.parameters]
    found = [
        (dict(zip(names, step, strict=True)), facts)
        for step, facts in zip(steps, ended[: len(steps)], strict=True)
        if facts is not None
    ]
    found = found if len(found) > 1 else []  # one says nothing of a spread
    if found:
        widen_intervals(content, found)
    return SocketSamples(simulated=len(found), failed=[reason for reason in reasons if reason])


def _write_tables(folder: Path, result: SocketResult) -> None:
    columns = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")
    rows = list[list[Any]]()
    for name, held in result.states.items():
        for region in held.regions:
            values, interval = (getattr(region, key) for key in columns), region.interval_kPa or ("", "")
            rows.append([name, region.region, *values, *interval, next(iter(region.interval_from or {}), "")])
    heads = ["load", "region", *columns, "low_kPa", "high_kPa", "mostly_from"]
    write_table(folder / "regions.csv", heads, rows)
    keys = ("time_s", "peak_kPa", "mean_kPa", "contact_area_mm2", "imbalance_percent")
    heads = [*keys, *(f"force_{axis}_N" for axis in "xyz"), "settling_mm"]
    lines = [[*(getattr(row, key) for key in keys), *row.force_N, row.move_mm[2]] for row in result.steps]
    write_table(folder / "steps.csv", heads, lines)
