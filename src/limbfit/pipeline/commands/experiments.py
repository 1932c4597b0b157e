"""Experiments: what a study can be asked beyond the chain of stages, for more simulations.

An experiment is stored like a stage, in ``results/<name>`` under a key of all that decides it, and is stale
when any of it has changed. It writes ``<name>.json``, which its command prints and its section of the report
reads, and CSV tables beside it. `simulations.experiment_cache` keeps its simulations, and finds those of the
stages and of other experiments, so that a killed one goes on and nothing is simulated twice.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...errors import InputError
from ...extensions import Registry
from ...report.sections.contents import SECTIONS, Maker
from ...study import Study
from ..design.design import check_design, run_design
from ..design.protocol import check_protocol, run_protocol
from ..engine.keys import Keys, Stage, StageKey
from ..engine.store import StageState, Store
from ..identification.crossvalidation import check_crossvalidate, run_crossvalidate
from ..identification.problem import check_fitted
from ..records.planned_records import SEEN
from ..simulation.limb_geometry import Check, LimbGeometry
from ..socket.design import check_socket_design, run_socket_design
from ..socket.socket import check_socket, run_socket
from ..uncertainty.uncertainty import run_uncertainty
from ..variants.cube import COMPRESSION_PERCENT, check_cube, run_cube
from ..variants.refinement import FACTORS, check_refinement, run_refinement
from ..variants.regions import check_regions, run_regions
from ..variants.sensitivity import KAPPA_RATIOS, run_contact, run_indenter, run_kappa, run_stiffness
from ..variants.variants import check_variants


@dataclass(frozen=True)
class Experiment(Stage):
    """A stage of its own, outside the chain: ``run(context, folder, **options)`` writes ``<name>.json``.

    ``needs`` names stages of the chain; ``options`` are what it can be run with and their defaults, in plain
    JSON. ``check`` refuses what study, limb and options decide.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    check: Check | None = None


_SIMULATED = ("sites", "traces", "mesh", "calibrate")
_INDENTERS, _RECORD = ("indenter", "indenters", "clamps"), ("site", "name", "indenter")


def _build_sensitivity(
    name: str, run: Callable[..., None], check: Check = check_variants, **options: Any
) -> Experiment:
    return Experiment(
        f"sensitivity-{name}",
        run,
        needs=_SIMULATED,
        tables=("material", "solver", *_INDENTERS),
        site_keys=("name", "region", "edge", "depth_mm", "speed_mm_s", "indenter"),
        record_keys=_RECORD,
        options={"sites": [], **options},
        check=check,
    )


_OWN: tuple[Experiment, ...] = (
    Experiment(
        "cube",
        run_cube,
        needs=("calibrate",),
        tables=("material",),
        options={"compression_percent": COMPRESSION_PERCENT},
        check=check_cube,
    ),
    Experiment(
        "regions",
        run_regions,
        needs=_SIMULATED,
        tables=("material", "calibration", "solver", *_INDENTERS),
        site_keys=("name", "region", "fitted", "weight", "edge", "indenter"),
        record_keys=_RECORD,
        options={"sites": "all"},
        check=check_regions,
    ),
    _build_sensitivity("c", run_stiffness),
    _build_sensitivity("kappa", run_kappa, ratios=list(KAPPA_RATIOS)),
    _build_sensitivity("contact", run_contact),
    _build_sensitivity("indenter", run_indenter),
    _build_sensitivity("mesh", run_refinement, check_refinement, factors=list(FACTORS)),
    Experiment(
        "uncertainty",
        run_uncertainty,
        needs=(*_SIMULATED, "predict"),
        tables=("material", "calibration", "solver", *_INDENTERS, "uncertainty"),
        site_keys=("name", "fitted", "weight", "edge", "indenter"),
        record_keys=_RECORD,
    ),
    Experiment(
        "crossvalidate",
        run_crossvalidate,
        needs=_SIMULATED,
        tables=("material", "calibration", "solver", *_INDENTERS),
        site_keys=("name", "region", "fitted", "weight", "edge", "indenter"),
        record_keys=_RECORD,
        options={"fit": 0, "choices": 200, "seed": 0, "runs": 12},
        check=check_crossvalidate,
    ),
    Experiment(
        "design",
        run_design,
        needs=("sites", "traces", "mesh"),
        tables=("material", "solver", *_INDENTERS),
        site_keys=("name", "fitted", "edge", "depth_mm", "speed_mm_s", "indenter"),
        record_keys=_RECORD,
        options={"sites": 0, "depths_mm": [], "parameters": {}, "parameters_from": "", "noise": {}},
        check=check_design,
    ),
    Experiment(
        "protocol",
        run_protocol,
        needs=("sites", "traces", "mesh"),
        tables=("material", "solver", "calibration", "acquire", *_INDENTERS),
        site_keys=("name", "fitted", "edge", "depth_mm", "speed_mm_s", "indenter"),
        record_keys=_RECORD,
        options={
            **{"minutes": 25.0, "setup_s": 60.0, "rest_s": 30.0, "speeds_mm_s": [], "holds_s": []},
            **{"depths_mm": [], "determine": [], "criterion": "D", "draws": 3, "seed": 0},
            **{"seen": dict.fromkeys(SEEN), "pressures": {}, "socket_times": {}},
            **{"parameters": {}, "parameters_from": "", "noise": {}},
        },
        check=check_protocol,
    ),
    Experiment(
        "socket",
        run_socket,
        needs=("surfaces",),
        tables=("socket", "geometry", "mesh", "material"),
        apart=("socket.design",),
        options={"parameters": {}, "parameters_from": "", "covariance_log": None}
        | {"most_probable": None, "recorded_range": None, "relaxation": None, "samples": 0},
        check=check_socket,
    ),
    Experiment(
        "socket_design",
        run_socket_design,
        needs=("surfaces",),
        tables=("socket", "geometry", "mesh", "material"),
        options={"parameters": {}, "parameters_from": "", "optimise": [], "simulations": 0},
        check=check_socket_design,
    ),
)


EXPERIMENTS = Registry("experiment", {experiment.name: experiment for experiment in _OWN})


def register_experiment(experiment: Experiment, section: Maker | None = None) -> None:
    """Make an experiment known by its name, in the file that a study names in ``study.extensions``.

    Parameters
    ----------
    experiment : its ``run`` writes ``<name>.json`` into the folder that it is given.
    section : makes its section of the report of what is stored and of that file's content.

    Raises
    ------
    InputError
        Where the name is taken, or cannot be that of a folder beside the others.
    """
    name, others = experiment.name, {*EXPERIMENTS.names} - {experiment.name}
    if not re.fullmatch("[a-z][a-z0-9_]*", name) or any(other.startswith(f"{name}-") for other in others):
        raise InputError(f"no experiment can be named {name!r}", remedy="use small letters and digits")
    EXPERIMENTS.add(name, experiment)
    if section is not None:
        SECTIONS.add(name, section)


def merge_options(experiment: Experiment, given: Mapping[str, Any]) -> dict[str, Any]:
    """The given options over the defaults."""
    unknown = ", ".join(sorted(set(given) - set(experiment.options)))
    if unknown:
        raise InputError(f"{experiment.name} has no option {unknown}")
    return {**experiment.options, **given}


def check_experiment(
    experiment: Experiment, study: Study, limb: LimbGeometry | None, options: Mapping[str, Any]
) -> None:
    """Refuse an experiment that its inputs rule out; ``limb``: None where it is not known yet.

    Raises
    ------
    InputError
        With the remedy.
    """
    if "calibrate" in experiment.needs:
        check_fitted(study)
    if experiment.check is not None:
        experiment.check(study, limb, options)


def list_experiment_states(
    keys: Keys, below: Mapping[str, str]
) -> list[tuple[StageState, StageKey, dict[str, Any]]]:
    """State, key and options of every experiment, each judged with the options that it was run with.

    ``below`` are the keys of the chain.
    """
    store, found = Store(keys.study.results), []
    for experiment in EXPERIMENTS:
        stamp = store.stamp(experiment.name)
        options = {**experiment.options, **(stamp.options if stamp else {})}
        key = keys.of(experiment, below, options)
        found.append((store.state(experiment.name, key.digest), key, options))
    return found
