"""Indentations recorded into a study, and a virtual device whose limb is the study's own simulations."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from pydantic import ValidationError

from ... import acquire
from ..._version import __version__
from ...acquire.rig import Rig, find_check, judge_weight, measure_mean_force, read_rig, store_check
from ...acquire.virtual import Endpoint, Fault, Surrogate, VirtualFitSocket, VirtualLimb, fit_surrogate, serve
from ...errors import InputError, RunError, TraceError, add_location
from ...results.base import read_curves
from ...results.limb import TracesResult
from ...study import Indentation, Record, Study
from ...traces import COLUMNS
from ...traces.formats import BINARY_SUFFIXES
from ...traces.record import find_factor
from ..engine.store import translate_disk_errors, write_curves, write_json

FOLDER = "acquired"  # beside the study file: measured data, no result
RECORD, VERDICT = "record.csv", "verdict.json"
TOUCH_STEPS = 3  # of a force sensor: a touch is felt by so many of its steps at least


def waiting(study: Study) -> list[Indentation]:
    """Sites and records that are yet to be made, site by site."""
    return [one for one in study.indentations if not study.is_recorded(one)]


def acquire_site(
    study: Study,
    name: str,
    *,
    address: str,
    operator: SimpleQueue[acquire.Event] | None = None,
    stops: SimpleQueue[acquire.Event] | None = None,
    depth_mm: float | None = None,
    replace_record: bool = False,
    listener: acquire.Listener | None = None,
) -> dict[str, Any]:
    """Record a site, or one of its records, on a device, judge it, and put it where the study names it.

    Returns ``name``, ``site``, ``completed``, ``phase``, ``reason``, ``verdict``, ``samples``, ``lost``,
    ``refused``, ``unreachable``, ``depth_mm`` and the files by kind. Raises `InputError` for a site that the
    study does not have or has a record of, or an address of no device; and `RunError` where the device does
    not answer, or the record cannot be written.

    Parameters
    ----------
    address : of the device: ``tcp://HOST[:PORT]``, ``serial:PATH[@BAUD]``, or ``rig:FILE`` for a stage and a
        force sensor of one's own.
    operator : where events of the operator come from (`limbfit.acquire.Keyboard`).  None: unattended - the
        limb counts as in place, and the key as held until the search is ``depth_mm`` deep.
    stops : unattended, where events that end the session come from (`limbfit.acquire.protocol.Abort`).
    depth_mm : where the search ends; by default the record's own, where unattended the site's ``depth_mm`` or
        the depth of its last record, else ``acquire.search_depth_mm``.
    replace_record : also where the study has this record; that one is kept beside the new one.
    listener : is told of phases and samples; see `limbfit.acquire.Told`.
    """
    one = study.indentation(name)
    settings = check_recording(
        study, name, depth_mm=depth_mm, unattended=operator is None, replace_record=replace_record
    )
    device = open_device(address, settings)
    try:
        folder, recorder = _begin_record(study, one, device, settings, unattended=operator is None)
    except BaseException:
        device.close()
        raise
    events = operator if operator is not None else stops if stops is not None else SimpleQueue()
    answer = acquire.NoOperator(events) if operator is None else None

    def tell(update: acquire.Update) -> None:
        if answer is not None:
            answer(update)
        if listener is not None:
            listener(update)

    try:
        session = acquire.Session(settings, device, site=one.site.name, recorder=recorder, listener=tell)
        ending = acquire.run_session(session, events)
    finally:
        recorder.close()
    found = {
        "name": one.name,
        "site": one.site.name,
        "completed": ending.is_completed,
        "phase": str(ending.phase),
        "reason": ending.reason,
        "unreachable": list(session.unreachable),
        "samples": session.samples,
        "lost": session.lost,
        "refused": asdict(device.refusals),
        "depth_mm": (ending.depth_um - ending.touch_um) / 1000 if ending.is_completed else None,
    }
    return found | _store_ramps(study, one, folder, ending.is_completed)


def open_device(address: str, settings: acquire.Settings) -> acquire.Device:
    """The device of an address; see `acquire_site` for the errors."""
    if not address.startswith("rig:"):
        return acquire.LineDevice(acquire.connect(address))
    file = Path(address.removeprefix("rig:"))
    table = read_rig(file)
    if settings.pin != 1:
        raise InputError("a rig has one pin", file=file, remedy="leave acquire.pin out")
    least_N = TOUCH_STEPS * table.force.resolution_N
    if settings.touch_N < least_N:
        what = f"its force is resolved to {table.force.resolution_N:g} N: too coarse for acquire.touch_N"
        raise InputError(what, file=file, place="force.resolution_N", remedy=f"state touch_N = {least_N:g}")
    if settings.force_limit_N >= table.force.range_N:
        remedy = f"state acquire.force_limit_N below {table.force.range_N:g} N"
        what = "its force sensor ends before the limit"
        raise InputError(what, file=file, place="force.range_N", remedy=remedy)
    return Rig(table, find_check(file))


def check_rig(file: str | Path, weight_kg: float, hang: Callable[[], None]) -> dict[str, float]:
    """Compare a rig's force with that of a known weight; a session with the rig needs this on the same day.

    Returns ``idle_N``, ``loaded_N`` and ``ratio`` to what the weight should show. Raises `InputError` for a
    file that is none, and `RunError` where an instrument does not answer, or the force is off by over 5 %.

    ``hang``: is called when the weight is to be hung on the sensor, and returns when it is.
    """
    path = Path(file)
    with closing(Rig(read_rig(path))) as rig:
        idle_N = measure_mean_force(rig)
        hang()
        loaded_N = measure_mean_force(rig)
    ratio, wrong = judge_weight(idle_N, loaded_N, weight_kg)
    if wrong:
        raise RunError(f"{path}: {wrong}; mend force.N_per_unit or the sensor, and check it again")
    store_check(path, ratio)
    return {"idle_N": idle_N, "loaded_N": loaded_N, "ratio": ratio}


def _begin_record(
    study: Study, one: Indentation, device: acquire.Device, settings: acquire.Settings, unattended: bool
) -> tuple[Path, acquire.Recorder]:
    """A new folder of the indentation, and in it the record with how it is made as its head."""
    with translate_disk_errors(study.folder):
        stamp = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%f}"[:-3]
        folder = study.folder / FOLDER / one.name / stamp
        folder.mkdir(parents=True)
        identity = asdict(device.identity)
        del identity["nonce"]
        head = {
            "site": one.site.name,
            "record": one.name,
            "indenter": one.indenter,
            "begun": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "limbfit": __version__,
            "unattended": unattended,
            "priority": acquire.prioritise(),
            "device": identity,
            "settings": settings.model_dump(),
        }
        return folder, acquire.Recorder(folder / RECORD, head, device.identity.pins)


def check_recording(
    study: Study,
    name: str,
    *,
    depth_mm: float | None = None,
    unattended: bool = False,
    replace_record: bool = False,
) -> acquire.Settings:
    """The device's settings for a site, or one of its records; see `acquire_site`.

    Raises `InputError` for what can be known to be wrong before the device is asked.
    """
    one = study.indentation(name)
    with add_location(file=study.file, place=f"{one.key}.trace"):
        if study.is_recorded(one) and not replace_record:
            remedy = "give --again to record it once more; the old record is kept"
            raise InputError(f"{one.trace} exists", remedy=remedy)
        if one.forced:
            what = "the device drives by displacement, and this record is made under force"
            raise InputError(what, remedy='leave out control = "force", or record it elsewhere')
        for target in filter(None, (Path(FOLDER) / one.name, one.trace)):
            if not study.path(target).resolve().is_relative_to(study.folder.resolve()):
                what = f"{target} lies outside the study's folder"
                raise InputError(what, remedy="nothing is recorded there; name a place inside")
        if one.trace is not None and one.trace.suffix.lower() in BINARY_SUFFIXES:
            what = f"records are written as text, which {one.trace} is not"
            raise InputError(what, remedy="name a file .csv")
    folder = study.folder / FOLDER
    if folder.exists() and not folder.is_dir():
        raise InputError("is a file, where records are kept", file=folder, remedy="move it away")
    return build_device_settings(study, one, depth_mm, unattended)


def judge_recording(file: Path) -> dict[str, Any]:
    """What a record holds, whole or cut short by a crash, and the verdict on its ramps.

    Raises `TraceError` where it is no record.
    """
    recording = acquire.read_recording(file)
    try:
        verdict, count = acquire.check_record(recording).to_dict(), len(acquire.find_ramps(recording))
    except (KeyError, TypeError, ValueError):
        raise TraceError("its head or its events lack what a verdict needs", file=file) from None
    seconds = float(np.ptp(recording.device_us)) / 1e6 if recording.device_us.size else 0.0
    return {
        "site": recording.head.get("site"),
        "samples": len(recording.device_us),
        "seconds": seconds,
        "lost_bytes": recording.lost_bytes,
        "ramps": count,
        "phases": [phase for phase, _, _ in recording.phases()],
        "verdict": verdict,
    }


def build_device_settings(
    study: Study, one: Indentation, depth_mm: float | None, unattended: bool
) -> acquire.Settings:
    """Those of ``[acquire]``, with what the record states of its own."""
    own = {"ramp_speed_mm_s": one.speed_mm_s, "hold_s": one.hold_s} if isinstance(one, Record) else {}
    stated = {key: value for key, value in own.items() if value is not None}
    try:
        settings = acquire.Settings(**(study.acquire.model_dump() | stated))
    except ValidationError as error:
        what = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise InputError(what, file=study.file, place=one.key) from None
    if depth_mm is None and (unattended or isinstance(one, Record)):
        depth_mm = one.depth_mm
    if depth_mm is None and unattended:
        traces = TracesResult.find(study.results)
        if traces is None or one.name not in traces.sites:
            remedy = "give --depth, or state its depth_mm"
            raise InputError("the depth is not known", file=study.file, place=one.key, remedy=remedy)
        depth_mm = traces.sites[one.name].depth_mm
    if depth_mm is None:
        return settings
    if not settings.min_depth_mm < depth_mm < settings.depth_limit_mm:
        raise InputError(
            f"{depth_mm:g} mm is not between acquire.min_depth_mm ({settings.min_depth_mm:g}) and "
            f"acquire.depth_limit_mm ({settings.depth_limit_mm:g})",
            place="--depth, or depth_mm",
        )
    return settings.model_copy(update={"search_depth_mm": depth_mm})


def _store_ramps(study: Study, one: Indentation, folder: Path, completed: bool) -> dict[str, Any]:
    """Verdict and ramps beside the record; the first ramp that counts into the study."""
    files: dict[str, Any] = {"record": str(folder / RECORD), "trace": None}
    if not completed:
        return {"verdict": None, "files": files}
    recording = acquire.read_recording(folder / RECORD)
    verdict = acquire.check_record(recording).to_dict()
    found = acquire.find_ramps(recording)
    with translate_disk_errors(study.folder):
        for ramp in found:
            write_ramp(study, folder / f"ramp-{ramp.cycle}.csv", ramp)
        counted = [ramp for ramp in found if ramp.cycle > study.acquire.precondition]
        if counted and one.trace is not None:
            file = study.path(one.trace)
            file.parent.mkdir(parents=True, exist_ok=True)
            if file.exists():  # it stays beside the new one
                until = f"until-{datetime.now(UTC):%Y%m%dT%H%M%S}"
                file.rename(file.with_name(f"{file.stem}.{until}{file.suffix}"))
            write_ramp(study, file, counted[0])
            files["trace"] = str(file)
        # Last: who waits for the verdict finds the trace in its place.
        write_json(folder / VERDICT, verdict | {"trace": str(one.trace) if files["trace"] else None})
    return {"verdict": verdict, "files": files}


def write_ramp(study: Study, file: Path, ramp: acquire.RecordedRamp) -> None:
    """The ramp under the names of ``[traces]``, in the units that these state."""
    columns = {}
    for key in COLUMNS:
        name = getattr(study.traces, key)
        head = '"' + name.replace('"', '""') + '"' if set(name) & set(',"') else name
        columns[head] = getattr(ramp.trace, key) / find_factor(key, name, "", [])
    work = file.with_name(f".{file.name}.work")
    write_curves(work, **columns)
    work.replace(file)


def virtual_fitsocket(
    study: Study, *, seed: int = 0, faults: tuple[Fault, ...] = (), paced: bool = False
) -> VirtualFitSocket:
    """A virtual FitSocket with the study's limb in it, as stored simulations describe it.

    Raises `InputError` where no site has a stored simulation.

    ``seed``: of the limb's place in the ring, and of the sensors' noise. ``paced``: the device's clock waits
    for limbfit, and may go faster than the wall's.
    """
    sites = read_surrogates(study)
    limb = VirtualLimb(sites, np.random.default_rng(seed))
    return VirtualFitSocket(limb, seed=seed, faults=faults, clock="paced" if paced else "real")


def read_surrogates(study: Study) -> dict[str, Surrogate]:
    """Each site that has a stored simulation: of the prediction, else of `limbfit simulate`."""
    found: dict[str, Surrogate] = {}
    columns = (("predict", "force_simulated_N"), ("simulate", "force_N"))
    for one in study.indentations:
        site = one.site.name
        for (folder, column), name in product(columns, dict.fromkeys((one.name, site))):
            file = study.results / folder / f"{name}.csv"
            if site not in found and file.is_file() and (folder == "simulate" or column in read_curves(file)):
                found[site] = _read_surrogate(file, column)
    if not found:
        remedy = "run it first (limbfit run), or simulate sites (limbfit simulate)"
        raise InputError("the study has no stored simulation", file=study.results, remedy=remedy)
    return found


def _read_surrogate(file: Path, column: str) -> Surrogate:
    try:
        curves = read_curves(file)
        return fit_surrogate(curves["time_s"], curves["displacement_mm"], curves[column])
    except (KeyError, InputError, ValueError):
        raise TraceError("not a simulated curve", file=file, remedy="run the stage again") from None
    except TraceError as error:
        raise TraceError(error.what, file=file) from None


def serve_fitsocket(
    device: VirtualFitSocket, serving: Endpoint, *, speed: float = 1.0, tell: Callable[[str], None]
) -> None:
    """Serve a virtual device until `Endpoint.stop`; its thread asks for real-time priority."""
    tell(f"priority: {acquire.prioritise()}")
    serve(device, serving, speed=speed, tell=tell)
