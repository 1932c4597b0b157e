"""What commands would refuse of a study at their defaults, as they do themselves before they simulate."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from ...errors import InputError
from ...study import Study
from ..identification.problem import check_fitted
from ..simulation.limb_geometry import LimbGeometry
from .acquire import build_device_settings
from .experiments import EXPERIMENTS, check_experiment
from .export import FORMATS, check_export

_COMMANDS = {"protocol": "design --protocol", "socket_design": "socket design"}


def list_refused_commands(study: Study, limb: LimbGeometry | None) -> list[dict[str, Any]]:
    """``commands`` that would be refused, and ``why``; ``limb``: None where it is not known yet."""
    found: dict[str, list[str]] = {}
    for command, check in _iterate_checks(study, limb):
        try:
            check()
        except InputError as error:
            why = str(InputError(error.what, place=error.place, remedy=error.remedy))
            found.setdefault(why, []).append(command)
    return [{"commands": commands, "why": why} for why, commands in found.items()]


def _iterate_checks(study: Study, limb: LimbGeometry | None) -> Iterator[tuple[str, Callable[[], Any]]]:
    yield "run", partial(check_fitted, study)
    for experiment in EXPERIMENTS:
        name = experiment.name
        command = _COMMANDS.get(name, name.replace("sensitivity-", "sensitivity --only "))
        yield command, partial(check_experiment, experiment, study, limb, experiment.options)
    for to in FORMATS:
        yield f"export --to {to}", partial(check_export, study, to)
    for one in study.indentations:
        yield f"acquire --site {one.name}", partial(build_device_settings, study, one, None, False)
