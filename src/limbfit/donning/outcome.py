"""A socket's simulation: pressure and shear over regions of the limb, step by step, and its balance."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fe import Problem, Result, Step, System, Tractions, solve, tractions
from ..fe.kernel.laws import Laws
from .model import Fit, socket_steps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Patch:
    """Pressure and shear over a part of the outer surface.

    ``mean_kPa``: normal force over area; ``peak_kPa``: largest mean of the faces around a node; ``shear_kPa``
    and ``shear_peak_kPa`` likewise of the size of the shear.
    """

    mean_kPa: float
    peak_kPa: float
    shear_kPa: float
    shear_peak_kPa: float

    @classmethod
    def of(cls, found: Tractions, chosen: NDArray[np.bool_], nodal: tuple[Array, Array]) -> Patch:
        """Over the chosen (f,) faces; ``nodal`` are pressure (n,) and size of the shear (n,) at nodes, kPa."""
        areas = found.areas[chosen].sum(axis=1)
        nodes = np.unique(found.faces[chosen])
        shear = np.linalg.norm(found.face_shear_kPa[chosen], axis=1)
        return cls(
            mean_kPa=float(areas @ found.face_pressure_kPa[chosen] / areas.sum()),
            peak_kPa=float(nodal[0][nodes].max()),
            shear_kPa=float(areas @ shear / areas.sum()),
            shear_peak_kPa=float(nodal[1][nodes].max()),
        )


@dataclass(frozen=True)
class Row:
    """One step: what the socket does, and what it does to the limb.

    ``force (3,)`` N and ``moment (3,)`` N mm about the pivot, on the socket, and its ``move (3,)`` mm and
    ``turn (3,)`` degrees, along anterior, the third axis and proximal (`Fit.frame`).  ``imbalance``: how far
    the contact is from the stated force and moment, a share.
    """

    time: float
    force: Array
    moment: Array
    move: Array
    turn: Array
    contact_area_mm2: float
    imbalance: float
    whole: Patch
    regions: Mapping[str, Patch]


@dataclass(frozen=True)
class Donned:
    """A socket's simulation: its ``rows``, one for each step, and pressure (n,) and shear (n, 3), kPa, at the
    mesh's nodes and displacement (n, 3), mm, when donning and each load have been held (by name)."""

    result: Result
    rows: tuple[Row, ...]
    pressure: Mapping[str, Array]
    shear: Mapping[str, Array]
    displacement: Mapping[str, Array]

    def at(self, time: float) -> Row:
        """The row of the step at a time, s."""
        return min(self.rows, key=lambda row: abs(row.time - time))


def don(
    problem: Problem,
    fit: Fit,
    regions: Mapping[str, NDArray[np.bool_]],
    on_row: Callable[[Row], None] | None = None,
) -> Donned:
    """Simulate a socket's problem.

    Parameters
    ----------
    problem : of `socket_problem`.
    regions : masks (f,) of the faces of the socket's body.
    on_row : called after every step.
    """
    laws = Laws.build([problem.materials[name] for name in problem.mesh.region_names])
    system = System(problem)
    rows: list[Row] = []
    kept: dict[str, tuple[Array, Array, Array]] = {}
    ends = {off: name for name, _, off in fit.ends}

    def note(step: Step) -> None:
        found = tractions(system, laws, step.state)
        pressure, shear = found.at_nodes(len(problem.mesh.points))
        rows.append(_row(step, found, (pressure, np.linalg.norm(shear, axis=1)), regions))
        for off, name in ends.items():
            if np.isclose(step.time, off):
                kept[name] = pressure, shear, step.state.u
        if on_row is not None:
            on_row(rows[-1])

    result = solve(
        problem, socket_steps(problem, fit, laws.modulus), on_step=note, store="none", system=system
    )
    off_by = result.imbalance[1:, 0]
    told = tuple(_balanced(row, float(share)) for row, share in zip(rows, off_by, strict=True))
    return Donned(result, told, *({name: values[i] for name, values in kept.items()} for i in range(3)))


def _row(
    step: Step, found: Tractions, nodal: tuple[Array, Array], regions: Mapping[str, NDArray[np.bool_]]
) -> Row:
    everywhere = np.ones(len(found.faces), dtype=bool)
    return Row(
        time=step.time,
        force=step.reactions[0, :3],
        moment=step.reactions[0, 3:],
        move=step.coordinates[0, :3],
        turn=np.degrees(step.coordinates[0, 3:]),
        contact_area_mm2=found.contact_area,
        imbalance=0.0,
        whole=Patch.of(found, everywhere, nodal),
        regions={name: Patch.of(found, mask, nodal) for name, mask in regions.items()},
    )


def _balanced(row: Row, imbalance: float) -> Row:
    return Row(**{**row.__dict__, "imbalance": imbalance})


def stretches(fit: Fit, rows: tuple[Row, ...]) -> Iterator[tuple[str, tuple[Row, ...]]]:
    """The rows of donning and of each load, by name."""
    start = 0.0
    for name, _, off in fit.ends:
        yield name, tuple(row for row in rows if start < row.time <= off * (1.0 + 1e-9))
        start = off
