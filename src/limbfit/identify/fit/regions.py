"""A model of each region of the limb beside the one of the whole limb (the paper's table 3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .objective import Measured, Simulate
from .parameters import Unknowns
from .prediction import error_percent
from .state import Calibration

Array = NDArray[np.float64]
Identify = Callable[[Unknowns], Calibration]


@dataclass(frozen=True)
class RegionRecords:
    """What a region is fitted and judged on.

    Parameters
    ----------
    identify : finds parameters from the records of its fitted sites.
    simulate : force at all of its sites, in the order of ``measured``.
    """

    identify: Identify
    simulate: Simulate
    measured: tuple[Measured, ...]


@dataclass(frozen=True)
class RegionFit:
    """A region's own model and errors (percent, by site) of it and of the whole limb's model.

    An error is None where the simulation did not reach the end of the record.
    """

    calibration: Calibration
    own_percent: dict[str, float | None]
    whole_percent: dict[str, float | None]


def fit_regions(
    regions: Mapping[str, RegionRecords], unknowns: Unknowns, whole: Array
) -> dict[str, RegionFit]:
    """Parameters of each region, started from those of the whole limb.

    Parameters
    ----------
    unknowns : names and bounds; their start is not used.
    whole : (p,) the parameters identified for the whole limb.
    """
    start = unknowns.from_start(np.clip(whole, unknowns.lower, unknowns.upper))
    return {name: _fit(region, start, whole) for name, region in regions.items()}


def _fit(region: RegionRecords, start: Unknowns, whole: Array) -> RegionFit:
    before = errors(region.simulate, whole, region.measured)
    found = region.identify(start)
    return RegionFit(found, errors(region.simulate, found.parameters, region.measured), before)


def errors(simulate: Simulate, parameters: Array, measured: Sequence[Measured]) -> dict[str, float | None]:
    """The force error of each site in percent; None where its simulation is partial."""
    return {
        site.name: error_percent(response.force_N, site.force_N) if response.completed else None
        for response, site in zip(simulate(parameters), measured, strict=True)
    }


def mean_percent(errors_percent: Mapping[str, float | None]) -> float | None:
    """Mean over the sites that have an error; None where none has."""
    known = [error for error in errors_percent.values() if error is not None]
    return float(np.mean(known)) if known else None
