"""The experiment ``socket``: the limb in its socket, donned, held and loaded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
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
from ...mesh import Mesh, write_vtu
from ...results.identification import RecordedExtents, RelaxationBeyond
from ...results.socket import SocketResult
from ...socket import Socket
from ...socket.landmarks import find_bone
from ...socket.published import select_published_findings
from ...study import Study
from ..engine.context import Context
from ..engine.partial_results import Begun, ResultFiles
from ..engine.storage import write_result, write_table
from ..simulation.limb_geometry import LimbGeometry
from ..simulation.loading import NEAR_MM, LimbAxis, describe_socket_load, name_load, time_socket_loads
from .intervals import CHANGE_PERCENT, FRICTION, ParameterSpread, draw_step, store_change, widen_intervals
from .limb import SocketLimb, SocketRun, run_sockets, simulate_socket
from .shape import build_loadable_socket, check_at_rest

NAME = "socket"
NOT_COMPARED = (
    "what the fitted records did to the tissue is not stored, and the socket is not compared with it: "
    "limbfit run, then limbfit socket again"
)


def check_socket(study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]) -> None:
    """Refuse tissues that are not at rest, and a shape or load that the limb cannot have.

    Raises
    ------
    StudyError
    """
    check_at_rest(study)
    if limb is not None:
        build_loadable_socket(study, limb.anatomy, limb.anatomy.skin)


def run_socket(
    context: Context,
    folder: Path,
    *,
    parameters: Parameters,
    parameters_from: str,
    covariance_log: Sequence[Sequence[float]] | None,
    most_probable: Parameters | None,
    recorded_range: Mapping[str, Any] | None,
    relaxation: dict[str, Any] | None,
    samples: int,
) -> dict[str, Any]:
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
    limb = SocketLimb.of(context, NAME)
    socket = build_loadable_socket(context.study, limb.anatomy, limb.outer.skin)
    write_surface(folder / "socket.stl", socket.surface)
    mesh, facts = limb.mesh(context, NAME, folder, socket)

    def told(time: float, end: float, words: str) -> None:
        context.tell(NAME, time, end, words)

    covariance = None if covariance_log is None else np.array(covariance_log)
    begun = Begun(ResultFiles(folder), limb.key(folder, parameters, socket, covariance is not None))
    found = limb.don(mesh, limb.materials(parameters), socket, told, covariance is not None, begun=begun)
    known = None
    if covariance is not None:
        at, probable = (context.study.vector(one) for one in (parameters, most_probable or parameters))
        known = ParameterSpread(covariance, np.log(probable / at))
        if relaxation is not None:
            spread = RelaxationSpread.from_stored(RelaxationBeyond.model_validate(relaxation))
            known = known.relax(spread.own_weight, *spread.interpolate(context.study.socket.worn_s))
    content = limb.facts(found, socket, known) | {
        "parameters": parameters,
        "parameters_from": parameters_from,
        "socket": _describe_shape(limb, socket),
        "mesh": facts,
        # All that was found is of transtibial limbs.
        "published": select_published_findings(limb.faces(mesh, socket))
        if find_bone(limb.anatomy, "tibia")
        else [],
        "samples": None,
        "worn_s": None if relaxation is None else context.study.socket.worn_s,
    }
    compared = _compare_with_records(limb, mesh, found, recorded_range)
    for held in (content["donning"], *content["loads"]):
        held |= compared[held.get("name", "donning")]
    content["outside_text"] = [] if covariance is None else _describe_outside(content, recorded_range)
    if covariance is not None and samples:
        steps = [draw_step(covariance, number) for number in range(samples)]
        content["samples"] = _simulate_samples(context, folder, (limb, mesh, socket), content, steps)
    write_result(folder / "socket.json", SocketResult(**content))
    _write_fields(folder, mesh, found)
    _write_tables(folder, content)
    begun.drop()
    return {}


def _compare_with_records(
    limb: SocketLimb, mesh: Mesh, found: DonningResult, stored: Mapping[str, Any] | None
) -> dict[str, dict[str, Any]]:
    """What donning and each load do to the tissue, and what of it no fitted record did, by name.

    None where what the records did is not known.
    """
    if stored is None:
        return {name: {"loading": None, "outside_records": None} for name in found.held}
    tested = RecordedRange.from_stored(RecordedExtents.model_validate(stored))
    axis, before = LimbAxis(limb.anatomy), list[Extent]()
    near_mm = NEAR_MM + limb.study.socket.liner.thickness_mm
    compared, histories = {}, time_socket_loads(limb.study.socket)
    for name, held in found.held.items():
        before = describe_socket_load(
            mesh, mesh.face_sets[OUTER], held, before, histories[name], limb.study.tissues, near_mm, axis,
            tested,
        )  # fmt: skip
        compared[name] = {
            "loading": before,
            "outside_records": tested.find_outside(before),
        }
    return compared


def _describe_outside(content: Mapping[str, Any], tested: Mapping[str, Any] | None) -> list[str]:
    """In words what donning and loads do that no fitted record did."""
    if tested is None:
        return [NOT_COMPARED]
    loads = {name_load(load["name"]): load["outside_records"] for load in content["loads"]}
    return describe_outside({"donning": content["donning"]["outside_records"], **loads})


def _simulate_samples(
    context: Context,
    folder: Path,
    donned: tuple[SocketLimb, Mesh, Socket],
    content: dict[str, Any],
    steps: Sequence[Array],
) -> dict[str, Any]:
    """Simulate parameters whose logarithms differ by ``steps (k,)``, and widen the intervals by the misses.

    More friction is simulated beside them, where there is some, and what it changes stored. Told are how many
    draws came to their end, and why others did not.
    """
    (limb, mesh, socket), study = donned, context.study
    kept = ResultFiles(folder, also=[context.store[NAME]])

    def job(name: str, on: SocketLimb, parameters: Parameters) -> SocketRun:
        key = on.key(folder, parameters, socket)
        return SocketRun(name, on, mesh, on.materials(parameters), socket, kept, key)

    simulated, at = content["parameters"], study.vector(content["parameters"])
    draws = [job(f"draw {n}", limb, study.by_tissue(at * np.exp(step))) for n, step in enumerate(steps, 1)]
    rougher = _build_rougher(limb)
    more = [] if rougher is None else [job(FRICTION, rougher, simulated)]
    jobs = [*draws, *more]
    reasons = run_sockets(
        jobs, context.executor, lambda done, words: context.tell(NAME, done, len(jobs), words)
    )
    ended = [None if reason else simulate_socket(one)[0] for one, reason in zip(jobs, reasons, strict=True)]
    for other in filter(None, ended[len(draws) :]):
        store_change(content, other, FRICTION)
    names = [f"{tissue}.{name}" for tissue, name in study.parameters]
    found = [
        (dict(zip(names, step, strict=True)), facts)
        for step, facts in zip(steps, ended[: len(draws)], strict=True)
        if facts is not None
    ]
    if len(found) < 2:  # one says nothing of a spread
        found = []
    else:
        widen_intervals(content, found)
    return {"simulated": len(found), "failed": [reason for reason in reasons if reason]}


def _build_rougher(limb: SocketLimb) -> SocketLimb | None:
    """The same with a larger coefficient of friction; None where contact has none."""
    table = limb.study.socket
    if isinstance(table.friction, str) or table.friction == 0.0:
        return None
    more = table.model_copy(update={"friction": table.friction * (1.0 + CHANGE_PERCENT / 100.0)})
    return replace(limb, study=limb.study.model_copy(update={"socket": more}))


def _describe_shape(limb: SocketLimb, socket: Socket) -> dict[str, Any]:
    """What is told of the socket's shape."""
    table, depth = limb.study.socket, socket.offset(limb.outer.skin)
    return {
        "source": "rectified" if table.file is None else table.file.name,
        "reduction_percent": table.reduction_percent if table.file is None else None,
        "areas": [area.name for area in table.areas],
        "volume_cm3": socket.volume_mm3 / 1000.0,
        "deepest_mm": float(depth.max()),
        "notes": list(socket.notes),
        "liner": limb.liner,
    }


def _write_fields(folder: Path, mesh: Mesh, found: DonningResult) -> None:
    """One VTU for donning and each load: pressure, shear, displacement at the nodes, strains of the cells."""
    for i, one in enumerate(found.held.values()):
        fields = {"pressure_kPa": one.pressure, "shear_kPa": one.shear, "displacement_mm": one.displacement}
        write_vtu(mesh, folder / f"held-{i}.vtu", point_data=fields, cell_data=one.strains.fields)


def _write_tables(folder: Path, content: Mapping[str, Any]) -> None:
    """Regions and steps as CSV."""
    columns = ("mean_kPa", "peak_kPa", "shear_kPa", "shear_peak_kPa")
    rows = [
        [name, region["region"], *(region[key] for key in columns), *_describe_interval(region)]
        for name, held in (("donning", content["donning"]), *((one["name"], one) for one in content["loads"]))
        for region in held["regions"]
    ]
    heads = ["load", "region", *columns, "low_kPa", "high_kPa", "mostly_from"]
    write_table(folder / "regions.csv", heads, rows)
    keys = ("time_s", "peak_kPa", "mean_kPa", "contact_area_mm2", "imbalance_percent")
    heads = [*keys, *(f"force_{axis}_N" for axis in "xyz"), "settling_mm"]
    lines = [[*(row[key] for key in keys), *row["force_N"], row["move_mm"][2]] for row in content["steps"]]
    write_table(folder / "steps.csv", heads, lines)


def _describe_interval(region: Mapping[str, Any]) -> tuple[Any, ...]:
    """Interval of a region's mean, and the parameter that most of it comes from; empty where not known."""
    if region["interval_kPa"] is None:
        return "", "", ""
    return *region["interval_kPa"], next(iter(region["interval_from"]))
