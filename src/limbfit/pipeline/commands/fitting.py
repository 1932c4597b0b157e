"""A socket on the limb, and its design: ``limbfit socket`` with the parameters that are known."""

from collections.abc import Sequence
from typing import Any

from ...errors import InputError
from ...indentation import Parameters
from ...priors import NONE, TISSUES, of_tissues
from ...study import Study
from ..engine.context import Listener, ignore_progress
from ..engine.store import Store
from .experiments import IDENTIFIED
from .run import run_experiment
from .simulate import choose_parameters, read_recorded_range

LITERATURE = "literature"
SIMULATIONS = 6


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

    Parameters
    ----------
    parameters : per tissue; by default the identified ones, or those of people where none were identified.
    literature : those of people even so: medians of the priors, the others as the study starts them.
    samples : draws from the identified parameters' covariance that are simulated too; intervals then count
        what derivatives miss.

    Returns
    -------
    dict
        What ``results/socket/socket.json`` holds, and ``folder``.

    Raises
    ------
    InputError
        For a socket that does not fit the limb, identified parameters that are stale, or samples of
        parameters that were not identified.
    RunError
        Where the simulation does not come to its end.
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
        study,
        "socket",
        listener=listener,
        parameters=used,
        parameters_from=origin,
        samples=samples,
        **known,
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

    Parameters
    ----------
    optimise : regions whose largest pressures are to be lowered further.
    simulations : at most so many for that, beside those of the two designs.
    parameters, literature : as for `fit_socket`.

    Returns
    -------
    dict
        What ``results/socket_design/socket_design.json`` holds, and ``folder``, which also has the socket
        with its wall (``socket.stl``).

    Raises
    ------
    InputError
        For regions or a shape that the limb cannot have, or identified parameters that are stale.
    RunError
        Where a simulation does not come to its end.
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
    values = {tissue: dict(study.material.of(tissue, "start")) for tissue in study.tissues}
    origin = "start of the study"
    others = {one: NONE for one in study.tissues if one not in TISSUES}
    medians = of_tissues(study.tissues, others | study.calibration.prior_tissues)
    for name, (median, _) in medians.items():
        tissue, key = name.split(".")
        if key in values[tissue]:
            values[tissue][key], origin = median, LITERATURE
    return values, origin
