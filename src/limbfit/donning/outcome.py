"""A socket's simulation: pressure and shear over regions of the limb, strain inside it, and its balance.

What was found so far is packed as facts and arrays, so that a simulation that was killed goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Self

import numpy as np

from ..arrays import Array, Mask
from ..fe import Checkpoints, Problem, Result, Snapshot, State, Step, StepControl, System, solve
from ..fe.kernel.laws import Laws
from ..fe.observables import compute_element_fields
from ..fe.tractions import Tractions, compute_tractions
from .model import SocketFit, build_socket_steps

Facts = dict[str, Any]

WHOLE, SETTLING = "the limb", "settling"
SHEAR_LEVELS = (0.25, 0.5, 0.75)  # shear strains above which the sheared volume is reported
RARE_SHARE = 0.01  # of a tissue's volume: the strain that it exceeds is reported beside the largest
RELATIVE_STEP = 1e-4  # of a parameter: how far it is moved where pressures are differentiated
# What is stored of a simulation that goes on later: the solver's arrays begin with the first.
SOLVER = "solver."
FIELDS = ("pressure", "shear", "displacement")
MAPPED = ("slopes", "derivatives")
STRAINS = ("shear", "compression", "energy_kPa", "volume_mm3")


def simulate_donning(
    problem: Problem,
    fit: SocketFit,
    regions: Mapping[str, Mask],
    sensitivities: bool = False,
    on_row: Callable[[SocketStep], None] | None = None,
    steps: StepControl | None = None,
    threads: int | None = None,
    keep: Callable[[DonningCheckpoint], None] | None = None,
    begin: DonningCheckpoint | None = None,
) -> DonningResult:
    """Simulate a socket's problem.

    Parameters
    ----------
    problem : of `build_socket_problem`.
    regions : masks (f,) of the faces of the socket's body.
    sensitivities : also derivatives with respect to every material parameter.
    on_row : called after every step.
    steps : by default `build_socket_steps`. Derivatives are those at a contact stiffness over the mean
        modulus, so that runs to be compared with them have the same steps.
    threads : of those steps, as in `build_socket_steps`.
    keep : called when donning and each load but the last have been held.
    begin : of an earlier call of the same, which goes on from there.
    """
    laws = problem.build_laws()
    system = System(problem)
    patches = {WHOLE: np.ones(len(problem.bodies[0].faces), dtype=bool), **regions}
    rows = [] if begin is None else list(begin.rows)
    held = {} if begin is None else dict(begin.held)

    def record(step: Step) -> None:
        found = compute_tractions(system, laws, step.state)
        values = {name: Patch.from_tractions(found, mask) for name, mask in patches.items()}
        row = SocketStep(
            time=step.time,
            force=step.reactions[0, :3],
            moment=step.reactions[0, 3:],
            move=step.coordinates[0, :3],
            turn=np.degrees(step.coordinates[0, 3:]),
            contact_area_mm2=found.contact_area,
            penetration_mm=step.penetration,
            imbalance=0.0,  # until the end
            whole=values.pop(WHOLE),
            regions=values,
        )
        rows.append(row)
        for name in fit.find_held(step.time):
            pressure, shear = found.average_at_nodes(len(problem.mesh.points))
            slopes, derivatives = dict[str, Array](), dict[str, Array]()
            if sensitivities:
                slopes, derivatives = _compute_derivatives(problem, system, laws, step.state, patches)
            strains = Strains.from_state(system, laws, step.state)
            held[name] = LoadedState(row, pressure, shear, step.state.u, strains, slopes, derivatives)
        if on_row is not None:
            on_row(row)

    control = steps or build_socket_steps(fit, laws.modulus, threads)
    checkpoints = None
    if keep is not None:
        ends = [off for _, _, off in fit.ends[:-1]]
        checkpoints = Checkpoints(ends, lambda now: keep(DonningCheckpoint(now, tuple(rows), dict(held))))
    result = solve(
        problem, control, sensitivities, on_step=record, store="none", system=system, checkpoints=checkpoints,
        begin=None if begin is None else begin.snapshot,
    )  # fmt: skip
    shares = result.imbalance[1:, 0]
    balanced = tuple(replace(row, imbalance=float(share)) for row, share in zip(rows, shares, strict=True))
    return DonningResult(result, balanced, held)


def _compute_derivatives(
    problem: Problem, system: System, laws: Laws, state: State, patches: Mapping[str, Mask]
) -> tuple[dict[str, Array], dict[str, Array]]:
    """Derivatives (p,) of the mean pressures and of settling, and of the state itself."""
    found = {name: np.zeros(laws.count) for name in (*patches, SETTLING)}
    assert state.sensitivity is not None
    assert state.bodies is not None
    values, at_nodes = np.array(problem.parameters), np.zeros((len(problem.mesh.points), laws.count))
    for i, value in enumerate(values):
        ways = []
        for step in (RELATIVE_STEP * value, -RELATIVE_STEP * value):
            there = replace(
                state,
                u=state.u + step * state.sensitivity[..., i],
                coordinates=state.coordinates + step * state.bodies[..., i],
                penalty=state.penalty * (1.0 + step * laws.modulus_gradient[i] / laws.modulus),
            )
            at = compute_tractions(system, laws, there)
            areas = at.areas.sum(axis=1)
            ways.append({name: _compute_mean(at, areas, mask) for name, mask in patches.items()})
            at_nodes[:, i] += np.sign(step) * at.average_at_nodes(len(at_nodes))[0] / (2.0 * RELATIVE_STEP)
        for name in patches:
            found[name][i] = (ways[0][name] - ways[1][name]) / (2.0 * RELATIVE_STEP)
        if len(state.bodies):
            found[SETTLING][i] = value * state.bodies[0, 2, i]
    move = np.zeros((6, laws.count))
    if len(state.bodies):
        move[: state.bodies.shape[1]] = values * state.bodies[0]  # one that only shifts has no turns
    return found, {"pressure": at_nodes, "displacement": values * state.sensitivity, "move": move}


def _compute_mean(found: Tractions, areas: Array, chosen: Mask) -> float:
    return float(areas[chosen] @ found.face_pressure_kPa[chosen] / areas[chosen].sum())


@dataclass(frozen=True)
class SocketStep:
    """One step: what the socket does, and what it does to the limb.

    ``force (3,)`` N and ``moment (3,)`` N mm about the pivot, on the socket, and its ``move (3,)`` mm and
    ``turn (3,)`` degrees, along anterior, the third axis and proximal (`SocketFit.frame`).
    ``penetration_mm``: how far the limb is in the wall at most.  ``imbalance``: how far the contact is from
    the stated force and moment, a share.
    """

    time: float
    force: Array
    moment: Array
    move: Array
    turn: Array
    contact_area_mm2: float
    penetration_mm: float
    imbalance: float
    whole: Patch
    regions: Mapping[str, Patch]


@dataclass(frozen=True)
class Patch:
    """Pressure and shear over a part of the outer surface.

    ``mean_kPa``: normal force over area; ``peak_kPa``: the largest mean over one face; ``shear_kPa`` and
    ``shear_peak_kPa`` likewise of the size of the shear.
    """

    mean_kPa: float
    peak_kPa: float
    shear_kPa: float
    shear_peak_kPa: float

    @classmethod
    def from_tractions(cls, found: Tractions, chosen: Mask) -> Patch:
        """Over the chosen (f,) faces."""
        areas = found.areas.sum(axis=1)
        shear = np.linalg.norm(found.face_shear_kPa[chosen], axis=1)
        return cls(
            mean_kPa=_compute_mean(found, areas, chosen),
            peak_kPa=float(found.face_pressure_kPa[chosen].max()),
            shear_kPa=float(areas[chosen] @ shear / areas[chosen].sum()),
            shear_peak_kPa=float(shear.max()),
        )


@dataclass(frozen=True)
class LoadedState:
    """The limb when donning, or a load, has been held.

    Parameters
    ----------
    row : what the socket does then.
    pressure, shear, displacement : (n,) kPa, (n, 3) kPa and (n, 3) mm at the mesh's nodes.
    strains : of the cells.
    slopes : of the whole's and each region's mean pressure, kPa, and of ``settling``, mm, the derivatives
        (p,) with respect to the logarithms of `Problem.parameter_names`; none where they were not asked for.
    derivatives : likewise of the state itself: of ``pressure (n, p)`` kPa and ``displacement (n, 3, p)`` mm
        at the mesh's nodes, and of ``move (6, p)`` of the socket, mm and rad.
    """

    row: SocketStep
    pressure: Array
    shear: Array
    displacement: Array
    strains: Strains
    slopes: Mapping[str, Array]
    derivatives: Mapping[str, Array] = field(default_factory=dict)

    def extrapolate(self, step: Array) -> LoadedState:
        """Pressure, displacement and place of the socket, to first order, at logarithms that are larger by
        ``step (p,)``; all else stays.
        """
        by, row = self.derivatives, self.row
        move, turn = by["move"][:3] @ step, np.degrees(by["move"][3:] @ step)
        return replace(
            self,
            row=replace(row, move=row.move + move, turn=row.turn + turn),
            pressure=self.pressure + by["pressure"] @ step,
            displacement=self.displacement + by["displacement"] @ step,
        )


@dataclass(frozen=True)
class Strains:
    """Strains of a state's cells (m,), from their volume-averaged principal stretches l1 >= l2 >= l3.

    Parameters
    ----------
    shear : largest shear, (l1^2 - l3^2) / 4: half the difference of principal Green-Lagrange strains.
    compression : of the most compressed direction, (1 - l3^2) / 2: its Green-Lagrange strain, positive.
    energy_kPa : long-term elastic energy over the volume at rest.
    volume_mm3 : at rest.
    """

    shear: Array
    compression: Array
    energy_kPa: Array
    volume_mm3: Array

    @classmethod
    def from_state(cls, system: System, laws: Laws, state: State) -> Self:
        """Of a state that kept its memory."""
        fields = compute_element_fields(system, laws, state)
        most, _, least = fields.stretches.T**2
        volume = system.weights.sum(axis=1)
        return cls((most - least) / 4.0, (1.0 - least) / 2.0, 1e3 * fields.energy, volume)

    @property
    def fields(self) -> dict[str, Array]:
        """As cell data of a file, by name and unit."""
        return {
            "shear_strain": self.shear,
            "compressive_strain": self.compression,
            "energy_density_kPa": self.energy_kPa,
        }

    def summarise_cells(self, cells: Mask) -> tuple[Facts, int]:
        """The strain of a tissue with the chosen cells (m,), as it is stored, and the cell most sheared.

        The largest values are those of one cell, and grow as cells get smaller; ``_rare`` is what 1 % of the
        volume exceeds, ``sheared_mm3`` the volume sheared by more than each of ``SHEAR_LEVELS``.
        """
        volume, shear, compression = self.volume_mm3[cells], self.shear[cells], self.compression[cells]
        facts = {
            "volume_mm3": float(volume.sum()),
            "shear": float(shear.max()),
            "shear_rare": _compute_exceeded(shear, volume),
            "compression": float(compression.max()),
            "compression_rare": _compute_exceeded(compression, volume),
            "energy_kPa": float(self.energy_kPa[cells].max()),
            "sheared_mm3": {f"{level:g}": float(volume[shear > level].sum()) for level in SHEAR_LEVELS},
        }
        return facts, int(np.flatnonzero(cells)[np.argmax(shear)])


def _compute_exceeded(values: Array, volume: Array) -> float:
    """The value that ``RARE_SHARE`` of the volume exceeds."""
    order = np.argsort(values)[::-1]
    above = np.cumsum(volume[order])
    return float(values[order][np.searchsorted(above, RARE_SHARE * above[-1])])


@dataclass(frozen=True)
class DonningResult:
    """A socket's simulation: its ``rows``, one for each step, and what was ``held``, by name."""

    result: Result
    rows: tuple[SocketStep, ...]
    held: Mapping[str, LoadedState]


@dataclass(frozen=True, eq=False)
class DonningCheckpoint:
    """A socket's simulation as far as donning, or a load, was held: ``snapshot`` is the solver's."""

    snapshot: Snapshot
    rows: tuple[SocketStep, ...]
    held: Mapping[str, LoadedState]


def pack(part: DonningCheckpoint) -> tuple[Facts, dict[str, Array]]:
    """As facts that JSON can hold, and arrays by name."""
    arrays = {f"{SOLVER}{name}": array for name, array in part.snapshot.arrays.items()}
    held: Facts = {}
    for i, (name, one) in enumerate(part.held.items()):
        arrays |= {f"{i}.{field}": getattr(one, field) for field in FIELDS}
        arrays |= {f"{i}.strains.{field}": getattr(one.strains, field) for field in STRAINS}
        held[name] = {"row": asdict(one.row)}
        for kind in MAPPED:
            arrays |= {f"{i}.{kind}.{key}": array for key, array in getattr(one, kind).items()}
            held[name][kind] = list(getattr(one, kind))
    rows = [asdict(row) for row in part.rows]
    return {"solver": dict(part.snapshot.facts), "rows": rows, "held": held}, arrays


def unpack(facts: Facts, arrays: Mapping[str, Array]) -> DonningCheckpoint:
    """From what `pack` gave."""
    own = {name.removeprefix(SOLVER): array for name, array in arrays.items() if name.startswith(SOLVER)}
    held = {}
    for i, (name, one) in enumerate(facts["held"].items()):
        fields: Facts = {field: arrays[f"{i}.{field}"] for field in FIELDS}
        fields |= {kind: {part: arrays[f"{i}.{kind}.{part}"] for part in one[kind]} for kind in MAPPED}
        strains = Strains(**{field: arrays[f"{i}.strains.{field}"] for field in STRAINS})
        held[name] = LoadedState(row=_to_row(one["row"]), strains=strains, **fields)
    return DonningCheckpoint(Snapshot(facts["solver"], own), tuple(map(_to_row, facts["rows"])), held)


def _to_row(facts: Facts) -> SocketStep:
    vectors = {name: np.array(facts[name]) for name in ("force", "moment", "move", "turn")}
    regions = {name: Patch(**patch) for name, patch in facts["regions"].items()}
    return SocketStep(**{**facts, **vectors, "whole": Patch(**facts["whole"]), "regions": regions})
