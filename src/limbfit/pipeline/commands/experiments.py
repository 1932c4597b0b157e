"""Experiments: what a study can be asked beyond the chain of stages, for more simulations.

An experiment is stored like a stage, in ``results/<name>`` under a key of all that decides it, and is stale
when any of it has changed. It writes ``<name>.json``, which its command prints and its section of the report
reads; some write CSV tables beside it. `simulations.open_experiment_cache` keeps its simulations, and finds
those of the stages and of other experiments, so that a killed one goes on and nothing is simulated twice.
"""

import inspect
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from inspect import Parameter, signature
from numbers import Real
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...extensions import Registry
from ...report.sections.contents import SECTIONS, Maker
from ...study import Study
from ..design.design import check_design, run_design
from ..design.protocol import check_protocol, run_protocol
from ..engine.provenance import Keys, Stage, StageKey
from ..engine.store import StageState, Store
from ..identification.crossvalidation import (
    check_crossvalidate,
    check_regions,
    run_crossvalidate,
    run_regions,
)
from ..identification.search import check_fitted
from ..simulation.limb_geometry import Check, LimbGeometry
from ..socket.design import check_socket_design, run_socket_design
from ..socket.socket import check_socket, run_socket
from ..uncertainty.uncertainty import run_uncertainty
from ..variants import sensitivity
from ..variants.cube import check_cube, run_cube
from ..variants.variants import check_variants


@dataclass(frozen=True)
class Experiment(Stage):
    """A stage of its own, outside the chain: ``run(context, folder, **options)`` writes ``<name>.json``.

    ``needs`` names stages of the chain; ``options`` are what it can be run with and their defaults, in plain
    JSON: those of ``run`` where none are given. ``check`` refuses what study, limb and options decide.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    check: Check | None = None

    def __post_init__(self) -> None:
        if not self.options:
            stated = signature(self.run).parameters.values()
            defaults = {one.name: one.default for one in stated if one.default is not Parameter.empty}
            object.__setattr__(self, "options", defaults)

    def check_options(self, given: Mapping[str, Any]) -> None:
        """Refuse options that the experiment does not have, or of another kind than their default."""
        unknown = ", ".join(sorted(given.keys() - self.options.keys()))
        if unknown:
            raise InputError(f"{self.name} has no option {unknown}")
        for option, value in given.items():
            default = self.options[option]
            if value is not None and _find_kind(default) not in (None, _find_kind(value)):
                what = f"option {option} of {self.name} cannot be {value!r}"
                raise InputError(what, remedy=f"its default is {default!r}")


def _find_kind(value: Any) -> type | None:
    """Which kind of option a value is; None for no kind."""
    kinds = (bool, Real, str, Mapping, Collection)  # a switch is no number, a text no list
    return next((kind for kind in kinds if isinstance(value, kind)), None)


IDENTIFIED = "identified"  # where parameters are from
_MESHED, _SIMULATED = ("sites", "traces", "mesh"), ("sites", "traces", "mesh", "calibrate")
_TABLES = ("material", "solver", "indenter", "indenters", "clamps")
_CALIBRATED, _UNCERTAIN = ("calibration", *_TABLES), ("calibration", "uncertainty", *_TABLES)
_ACQUIRED = ("calibration", "acquire", *_TABLES)
# Keys of sites and of records.
_WEIGHED = ("name", "fitted", "weight", "edge", "indenter")
_FITTED = ("name", "region", "fitted", "weight", "edge", "indenter")
_PLANNED = ("name", "fitted", "edge", "depth_mm", "speed_mm_s", "indenter")
_VARIED = ("name", "region", "edge", "depth_mm", "speed_mm_s", "indenter")
_RECORD = ("site", "name", "indenter")
# What experiments stand on that choose fitted sites anew, and those of the socket.
_CHOICES = (_SIMULATED, _CALIBRATED, _FITTED, _RECORD)
_SOCKET = ("surfaces",), ("socket", "geometry", "mesh", "material")

_OWN: tuple[Experiment, ...] = (
    Experiment("cube", run_cube, ("calibrate",), ("material",), check=check_cube),
    Experiment("regions", run_regions, *_CHOICES, check=check_regions),
    *(
        Experiment(f"sensitivity-{name}", run, _SIMULATED, _TABLES, _VARIED, _RECORD, check=check)
        for name, run, check in (
            ("c", sensitivity.run_stiffness, check_variants),
            ("kappa", sensitivity.run_kappa, check_variants),
            ("contact", sensitivity.run_contact, check_variants),
            ("indenter", sensitivity.run_indenter, check_variants),
            ("mesh", sensitivity.run_refinement, sensitivity.check_refinement),
        )
    ),
    Experiment("uncertainty", run_uncertainty, (*_SIMULATED, "predict"), _UNCERTAIN, _WEIGHED, _RECORD),
    Experiment("crossvalidate", run_crossvalidate, *_CHOICES, check=check_crossvalidate),
    Experiment("design", run_design, _MESHED, _CALIBRATED, _PLANNED, _RECORD, check=check_design),
    Experiment("protocol", run_protocol, _MESHED, _ACQUIRED, _PLANNED, _RECORD, check=check_protocol),
    Experiment("socket", run_socket, *_SOCKET, apart=("socket.design",), check=check_socket),
    Experiment(
        "socket_design", run_socket_design, *_SOCKET, apart=("socket.measured",), check=check_socket_design
    ),
)
EXPERIMENTS = Registry("experiment", {experiment.name: experiment for experiment in _OWN})


def register_experiment(experiment: Experiment, section: Maker | None = None) -> None:
    """Make an experiment known by its name, in the file that a study names in ``study.extensions``.

    Raises `InputError` where the name is taken, or cannot be that of a folder beside the others, or ``run``
    is in no file.

    ``experiment``: its ``run`` writes ``<name>.json`` into the folder that it is given. ``section``: makes
    its section of the report of what is stored and of that file's content.
    """
    name, others = experiment.name, {*EXPERIMENTS.names} - {experiment.name}
    if not re.fullmatch("[a-z][a-z0-9_]*", name) or any(other.startswith(f"{name}-") for other in others):
        raise InputError(f"no experiment can be named {name!r}", remedy="use small letters and digits")
    if not Path(inspect.getfile(experiment.run)).is_file():
        what = "its run is defined in no file, and results could not tell when it changes"
        raise InputError(what, place=name, remedy="write it to a Python file, and import or name that")
    EXPERIMENTS.add(name, experiment)
    if section is not None:
        SECTIONS.add(name, section)


def check_experiment(
    experiment: Experiment, study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]
) -> None:
    """Raise `InputError` for an experiment that inputs rule out; ``limb``: None where it is not known yet."""
    if set(experiment.needs) - {"segment", "surfaces"}:
        study.refuse_no_site()
    if "calibrate" in experiment.needs:
        check_fitted(study)
    if experiment.check is not None:
        experiment.check(study, limb, options)


def compute_experiment_key(
    keys: Keys, experiment: Experiment, below: Mapping[str, str], options: Mapping[str, Any]
) -> StageKey:
    """The key of an experiment with its ``options``; ``below`` are the keys of the chain.

    What was done with identified parameters stands on the calibration that they are from.
    """
    if options.get("parameters_from") == IDENTIFIED:
        experiment = replace(experiment, needs=(*experiment.needs, "calibrate"))
    return keys.compute_key(experiment, below, options)


def list_experiment_states(
    keys: Keys, below: Mapping[str, str]
) -> list[tuple[StageState, StageKey, dict[str, Any]]]:
    """State, key and options of every experiment, each judged with the options that it was run with.

    ``below`` are the keys of the chain. One that was never done has begun with whatever options it was given.
    """
    store, found = Store(keys.study.results), []
    for experiment in EXPERIMENTS:
        stamp = store.stamp(experiment.name)
        options = {**experiment.options, **(stamp.options if stamp else {})}
        key = compute_experiment_key(keys, experiment, below, options)
        state = store.state(experiment.name, key.digest)
        if state.state == "missing" and any(store.folder.glob(f".work-{experiment.name}-*")):
            state = replace(state, state="begun")
        found.append((state, key, options))
    return found
