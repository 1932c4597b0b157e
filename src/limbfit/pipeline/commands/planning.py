"""What is planned on a limb with known parameters: sites or a session (``limbfit design``), a socket."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...errors import InputError
from ...identify.checks.design import Criterion
from ...indentation import Parameters
from ...priors import NONE, TISSUES, of_tissues
from ...study import Study
from ..design.protocol import SEEN
from ..engine.context import Listener, ignore_progress
from ..engine.store import Store
from ..simulation.loading import LoadHistory, time_socket_loads
from ..socket.intervals import CHANGE_PERCENT
from ..socket.socket import NAME as SOCKET
from .experiments import IDENTIFIED
from .run import run_experiment, study_status
from .simulate import choose_parameters, read_recorded_range

_SENSOR_N, _MISFIT = 0.05, 0.02  # where no calibration tells: noise, and the model's error over the peak
_HOLD_S = 30.0
_SPEED_FACTOR = 5.0  # the second speed that a protocol may have, over the first
_CORRELATION = 0.95  # of the model's error between neighbouring points of comparison
LITERATURE = "literature"
SIMULATIONS = 6


def design_study(
    study: Study,
    *,
    sites: int = 0,
    depths_mm: Sequence[float] = (),
    parameters: Parameters | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """The best choice of sites and depths at known parameters, beside the study's own choice.

    Where the study has a current socket, simulated with identified parameters, the study's own choice is also
    told with sensors in every region of it.

    Returns what ``results/design/design.json`` holds, and ``folder``. Raises `InputError` for more sites than
    there are, or identified parameters that are stale.

    Parameters
    ----------
    sites : how many to choose; 0: as many as the study fits, or four.
    depths_mm : depths to choose from at every site; none: as recorded or planned.
    parameters : per tissue; by default the identified ones, or the study's start.
    """
    used, origin = choose_parameters(study, parameters)
    known = origin == IDENTIFIED and _has_socket(study)
    return run_experiment(
        study,
        "design",
        socket_pressures=_read_socket_pressures(study) if known else {},
        listener=listener,
        sites=sites,
        depths_mm=[float(depth) for depth in depths_mm],
        parameters=used,
        parameters_from=origin,
        noise=_find_noise(study, origin),
    )


def plan_protocol(
    study: Study,
    *,
    minutes: float = 25.0,
    setup_s: float = 60.0,
    rest_s: float = 30.0,
    speeds_mm_s: Sequence[float] = (),
    holds_s: Sequence[float] = (),
    depths_mm: Sequence[float] = (),
    determine: Sequence[str] = (),
    criterion: Criterion | None = None,
    draws: int = 3,
    seed: int = 0,
    ultrasound_sd_mm: float | None = None,
    surface_sd_mm: float | None = None,
    shear_waves_sd_m_s: float | None = None,
    parameters: Parameters | None = None,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """The records that determine the parameters best in a patient's time, at several draws of the tissues.

    Returns what ``results/protocol/protocol.json`` holds, and ``folder``, where ``records.toml`` is, too.
    Raises `InputError` for unknown parameters, a time too short for any record, identified parameters that
    are stale, or pressures that are not stored with their derivatives.

    Parameters
    ----------
    minutes : of the whole session.
    setup_s, rest_s : for each site with an indenter, and for the tissue to come back after each record.
    speeds_mm_s : to choose from; none: ``acquire.ramp_speed_mm_s`` and five times as fast, or as fast as a
        socket's loads come on, within its limit.
    holds_s : at the deepest point, to choose from; 0: none. By default 0 and 30, or for a socket as long as
        its loads last, within half of the session.
    depths_mm : to choose from; none: as deep as each site was recorded or is planned. No record goes deeper
        than half of the tissue's thickness.
    determine : parameters such as ``muscle.c_kPa``; by default all. ``socket``: the mean pressures of the
        regions under every load of ``results/socket``, which needs identified parameters.
    criterion : ``D``, the smallest joint region of confidence, or ``A``, the least sum of variances; by
        default D, and A for pressures.
    draws : tissues that the protocol is judged at, the first those of ``parameters``.
    ultrasound_sd_mm : how well ultrasound through the indenter reads the thickness of a tissue; None: there
        is none.
    surface_sd_mm : how well cameras read the displacement of the skin around the indenter; None: likewise.
    shear_waves_sd_m_s : how well elastography reads the speed of shear waves in each tissue under the
        indenter, once a second; as much all speeds of a tissue may be off together. None: likewise.
    parameters : per tissue; by default the identified ones, or the study's start.
    """
    pressures = _find_relative_slopes(study) if SOCKET in determine else {}
    if pressures and (len(determine) > 1 or criterion == "D"):
        what = "with other parameters" if len(determine) > 1 else 'by the criterion "D"'
        what = f"pressures of a socket are not determined {what}: they are more than the parameters"
        raise InputError(what, place="--determine", remedy="state socket alone, and A or no criterion")
    used, origin = choose_parameters(study, parameters)
    times = time_socket_loads(study.socket) if pressures else {}
    if not len(holds_s):
        longest = max((one.end_s for one in times.values()), default=0.0)
        holds_s = (0.0, max(_HOLD_S, min(longest, 30.0 * minutes - setup_s - rest_s)))
    return run_experiment(
        study,
        "protocol",
        listener=listener,
        minutes=float(minutes),
        setup_s=float(setup_s),
        rest_s=float(rest_s),
        speeds_mm_s=[float(v) for v in speeds_mm_s] or _choose_speeds(study, times.values(), list(depths_mm)),
        holds_s=[float(hold) for hold in holds_s],
        depths_mm=[float(depth) for depth in depths_mm],
        determine=[] if pressures else list(determine),
        criterion=criterion or ("A" if pressures else "D"),
        pressures=pressures,
        socket_times={name: [one.ramp_s, one.end_s] for name, one in times.items()},
        draws=draws,
        seed=seed,
        parameters=used,
        parameters_from=origin,
        noise=_find_noise(study, origin),
        seen=dict(zip(SEEN, (ultrasound_sd_mm, surface_sd_mm, shear_waves_sd_m_s), strict=True)),
    )


def _choose_speeds(study: Study, loads: Iterable[LoadHistory], depths_mm: Sequence[float]) -> list[float]:
    """The study's speed, and five times that or as fast as the ``loads`` of a socket come on, mm/s.

    The deepest record then takes as long as the load that comes on fastest.
    """
    slow, limit = study.acquire.ramp_speed_mm_s, study.acquire.speed_limit_mm_s
    stated = [site.depth_mm for site in study.sites if site.depth_mm is not None]
    store = Store(study.results)
    if store.stamp("traces") is not None:
        stated += [facts.depth_mm for facts in store.results.traces.sites.values()]
    deepest = max(depths_mm or stated, default=0.0)
    fast = max((deepest / one.ramp_s for one in loads), default=0.0)
    return [slow, min(max(_SPEED_FACTOR * slow, fast), limit)]


def _find_relative_slopes(study: Study) -> dict[str, list[float]]:
    """Derivatives (p,) of the logarithm of every mean pressure by those of the parameters.

    Raises `InputError` where the study has no current socket, or one without derivatives.
    """
    remedy, place = "run limbfit socket on it, with identified parameters, first", "--determine socket"
    if not _has_socket(study):
        raise InputError("the study has no current socket", file=study.file, place=place, remedy=remedy)
    read = _read_socket_pressures(study)
    if not read:
        what = "its socket's pressures have no derivatives"
        raise InputError(what, file=study.file, place=place, remedy=remedy)
    return {name: (np.array(slopes) / mean).tolist() for name, (mean, *slopes) in read.items()}


def _has_socket(study: Study) -> bool:
    return "done" in [row["state"] for row in study_status(study) if row["stage"] == SOCKET]


def _read_socket_pressures(study: Study) -> dict[str, list[float]]:
    """Every mean pressure, kPa, and its derivatives (p,) by the logarithms of the parameters.

    None where the socket's parameters were not identified.
    """
    found = {}
    for load in Store(study.results).results.socket.loads:
        for region in load.regions:
            if region.change_kPa is not None and region.mean_kPa > 0:
                by = [region.change_kPa.get(f"{tissue}.{name}", 0.0) for tissue, name in study.parameters]
                slopes = np.array(by) / np.log1p(CHANGE_PERCENT / 100.0)
                found[f"{load.name}, {region.region}"] = [region.mean_kPa, *slopes.tolist()]
    return found


def _find_noise(study: Study, origin: str) -> dict[str, float]:
    """Sensor noise and the model's own error, from the calibration's residuals where there is one."""
    if origin != IDENTIFIED:
        return {"sensor_N": _SENSOR_N, "misfit": _MISFIT, "correlation": _CORRELATION}
    residuals = Store(study.results).results.calibration.uncertainty.residuals
    noise = [row.compared_noise_sd_N for row in residuals.sites.values() if row.unit == "N"]
    return {
        "sensor_N": float(max(np.median(noise), 1e-3)) if noise else _SENSOR_N,
        "misfit": residuals.misfit_elsewhere,
        "correlation": _CORRELATION,
    }


def fit_socket(
    study: Study,
    *,
    parameters: Parameters | None = None,
    literature: bool = False,
    samples: int = 0,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Put the study's socket on its limb and load it.

    Nothing here is a medical device.

    Returns what ``results/socket/socket.json`` holds, and ``folder``. Raises `InputError` for a socket that
    does not fit the limb, identified parameters that are stale, or samples of parameters that were not
    identified; and `RunError` where the simulation does not come to its end.

    Parameters
    ----------
    parameters : per tissue; by default the identified ones, or those of people where none were identified.
    literature : those of people even so: medians of the priors, the others as the study starts them.
    samples : draws from the identified parameters' covariance that are simulated too; intervals then count
        what derivatives miss.
    """
    used, origin = choose_tissues(study, literature, parameters)
    known: dict[str, Any] = {}
    if origin == IDENTIFIED:
        uncertainty = Store(study.results).results.calibration.uncertainty.to_plain()
        known = {key: uncertainty[key] for key in ("covariance_log", "most_probable")}
        known["relaxation"] = (uncertainty["relaxation"] or {}).get("beyond")
        recorded = read_recorded_range(study)
        known["recorded_range"] = None if recorded is None else recorded.to_plain()
    elif samples:
        what = f"there is nothing to draw {samples} samples from: the parameters were not identified"
        raise InputError(what, place="--samples", remedy="identify them (limbfit run)")
    return run_experiment(
        study, "socket", listener=listener, parameters=used, parameters_from=origin, samples=samples, **known
    )


def design_socket(
    study: Study,
    *,
    optimise: Sequence[str] = (),
    simulations: int = SIMULATIONS,
    parameters: Parameters | None = None,
    literature: bool = False,
    listener: Listener = ignore_progress,
) -> dict[str, Any]:
    """Design a socket from the study's target pressure, and compare it with a uniformly reduced one.

    Nothing here is a medical device.

    Returns what ``results/socket_design/socket_design.json`` holds, and ``folder``, which also has the socket
    with its wall (``socket.stl``). Raises `InputError` for regions or a shape that the limb cannot have, or
    identified parameters that are stale; and `RunError` where a simulation does not come to its end.

    Parameters
    ----------
    optimise : regions whose largest pressures are to be lowered further.
    simulations : at most so many for that, beside those of the two designs.
    parameters, literature : as for `fit_socket`.
    """
    if simulations < 1:
        raise InputError(f"{simulations} simulations are too few", remedy="allow one or more")
    doubled = sorted({name for name in optimise if list(optimise).count(name) > 1})
    if doubled:
        raise InputError(f"region {doubled[0]!r} is named twice", remedy="name it once")
    used, origin = choose_tissues(study, literature, parameters)
    return run_experiment(
        study,
        "socket_design",
        listener=listener,
        parameters=used,
        parameters_from=origin,
        optimise=list(optimise),
        simulations=simulations if optimise else 0,
    )


def choose_tissues(
    study: Study, literature: bool = False, given: Parameters | None = None
) -> tuple[Parameters, str]:
    """Parameters of a study's tissues, and where they are from.

    They are ``given``, else identified, else, or with ``literature``, those of people. A tissue or parameter
    that these do not know starts as the study says.
    """
    if given or (not literature and Store(study.results).stamp("calibrate") is not None):
        return choose_parameters(study, given)
    values = {tissue: dict(study.material.get(tissue, "start")) for tissue in study.tissues}
    origin = "start of the study"
    others = {one: NONE for one in study.tissues if one not in TISSUES}
    medians = of_tissues(study.tissues, others | study.calibration.prior_tissues)
    for name, (median, _) in medians.items():
        tissue, key = name.split(".")
        if key in values[tissue]:
            values[tissue][key], origin = median, LITERATURE
    return values, origin
