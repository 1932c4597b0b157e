"""The mechanical problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Indices
from ..errors import ProblemError
from ..mesh import Mesh
from ..phases import MotionPhase, find_boundaries, find_loading_end, find_phases
from .contact.rigid import Indenter
from .kernel.elements import ELEMENTS, Element
from .kernel.laws import Laws
from .materials import Material
from .motion import Activation, Drives, Motion, RigidBody, read_course
from .pressure import Pressure


@dataclass(frozen=True)
class History:
    """Piecewise linear advance of the indenter: ``times (n,)`` s from 0, ``displacement (n,)`` mm.

    ``across (n, 2)``: its move across its axis, along x and y of its frame, mm; None: none.
    ``force (n,)``: the force, N, that presses it along its axis instead of a displacement.
    """

    times: Array
    displacement: Array | None = None
    across: Array | None = None
    force: Array | None = None

    def __post_init__(self) -> None:
        if (self.displacement is None) == (self.force is None):
            raise ProblemError("a history is one of displacement or one of force, not both or none")
        driver = "displacement" if self.force is None else "force"
        times, values = read_course(f"a {driver} history", f"{driver}s", self.times, getattr(self, driver))
        if self.across is not None:
            across = np.array(self.across, dtype=float)
            if across.shape != (len(times), 2) or not np.isfinite(across).all():
                raise ProblemError("a move across the axis needs two finite numbers for each time")
            object.__setattr__(self, "across", across)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, driver, values)

    @property
    def forced(self) -> bool:
        """True if a force drives the indenter along its axis."""
        return self.force is not None

    @property
    def driver(self) -> Array:
        """(n,) displacement, mm, or force, N."""
        values = self.displacement if self.force is None else self.force
        assert values is not None
        return values

    def at(self, t: float | Array) -> Array:
        """Displacement, mm, or force, N, that drives it at time(s) ``t``."""
        return np.asarray(np.interp(t, self.times, self.driver))

    def displacement_at(self, t: float) -> float:
        """Stated displacement at time ``t``, mm; 0 where a force drives it."""
        return 0.0 if self.forced else float(self.at(t))

    @cached_property
    def motion(self) -> Motion:
        """The history as the motion of a rigid body."""
        values = np.zeros((len(self.times), 6))
        values[:, 2] = self.driver
        if self.across is not None:
            values[:, :2] = self.across
        return Motion(self.times, values, (False, False, self.forced, False, False, False))

    def travel(self, t: float) -> float:
        """The sum of driver and moves across, which changes while the indenter moves in any direction."""
        across = () if self.across is None else self.across.T
        return float(self.at(t)) + sum(float(np.interp(t, self.times, values)) for values in across)

    @cached_property
    def phases(self) -> tuple[MotionPhase, ...]:
        """The phases of the indenter: loading, holding, unloading, in any number."""
        return find_phases(self.times, self.driver)

    def delay(self, seconds: float) -> History:
        """The same history, begun so many seconds later."""
        if not seconds:
            return self
        stated = {"displacement": self.displacement, "across": self.across, "force": self.force}
        values = {name: np.concatenate([of[:1], of]) for name, of in stated.items() if of is not None}
        return History(np.append(0.0, self.times + seconds), **values)

    @property
    def kinks(self) -> Array:
        """Times where phases begin or end, or a move across the axis turns, s, both ends among them."""
        found = find_boundaries(self.phases)
        apart = np.abs(found[:, None] - self.turns).min(axis=0, initial=np.inf) > 1e-9 * self.times[-1]
        return np.union1d(found, self.turns[apart])

    @property
    def turns(self) -> Array:
        """Times where a move across the axis turns, s."""
        if self.across is None:
            return np.zeros(0)
        speeds = np.diff(self.across, axis=0) / np.diff(self.times)[:, None]
        turned = np.abs(np.diff(speeds, axis=0)).max(axis=1, initial=0.0) > 1e-9 * np.abs(speeds).max()
        return self.times[1:-1][turned]

    @property
    def loading_s(self) -> float:
        """End of the loading that first reaches the largest displacement, s; of all if nothing advances."""
        loading = find_loading_end(self.phases)
        return float(self.times[-1]) if loading is None else loading.end_s


@dataclass(frozen=True)
class Support:
    """Nodes whose displacement ``component`` (0, 1, 2) is ``factor`` times the history's displacement."""

    nodes: Indices
    component: int
    factor: float = 0.0


@dataclass(frozen=True)
class Problem:
    """An indentation.

    Parameters
    ----------
    mesh : points in mm.
    materials : by region name.
    fixed : (n,) nodes held in all directions.
    contact_faces : (f, 3 | 6 | 4) outward boundary faces that the indenter may touch.
    indenter : where it starts; None for a problem that is driven by its supports only.
    history : the indenter's advance.
    supports : single components held or moved.
    element : name in the element table; by default the mesh's cell type.
    contact_rule : where contact is enforced: ``nodes`` of the faces or their ``gauss`` points.
    friction : ``frictionless``, ``sticky`` (what touches does not slip along the indenter) or Coulomb's
        coefficient.
    sticking : how Coulomb's law sticks: ``anchored`` where a point first touched, or has slipped to, for as
        long as it does not slip; or ``stepwise``, as FEBio's ``sliding-elastic`` does, where it was at the
        end of the last step.
    bodies : further rigid bodies, each driven by its own motion.
    pressures : on boundary faces, normal to them as they move.
    fibres : direction of the fibres at rest, one (3,) or one for each cell (m, 3), of any length; where a
        material is `FibredMaterial`.
    activation : how much of the active stress of `ContractileMaterial` materials acts, over time.
    start : ``touching`` moves the indenter along its axis until it just touches; ``as-given`` does not.
    prestretch : elastic deformation of the tissue where the mesh is, one (3, 3) or one for each cell (m, 3,
        3), such as `isochoric_stretch`; the body is in equilibrium with it, long since, before time begins.
    touch_down_s : when it does so, s; until then it is clear of the tissue, which bodies, pressures or
        activation may have moved.  Its displacement does not change until then, and counts from there.
    """

    mesh: Mesh
    materials: Mapping[str, Material]
    fixed: Indices
    contact_faces: Indices
    indenter: Indenter | None
    history: History
    supports: tuple[Support, ...] = ()
    element: str = ""
    start: str = "touching"
    contact_rule: str = "gauss"
    friction: str | float = "frictionless"
    sticking: str = "anchored"
    bodies: tuple[RigidBody, ...] = ()
    pressures: tuple[Pressure, ...] = ()
    fibres: ArrayLike | None = None
    activation: Activation | None = None
    prestretch: ArrayLike | None = None
    touch_down_s: float = 0.0
    name: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        # A dictionary that the caller goes on filling for the next problem must not change this one.
        object.__setattr__(self, "materials", dict(self.materials))

    def with_materials(self, materials: Mapping[str, Material]) -> Problem:
        """The same problem with other materials; a prepared system stays valid."""
        return replace(self, materials=materials)

    def build_laws(self) -> Laws:
        """The materials of all regions, as the kernels read them."""
        return Laws.build([self.materials[name] for name in self.mesh.region_names])

    @cached_property
    def rigid_bodies(self) -> tuple[RigidBody, ...]:
        """The indenter, where there is one, and the further bodies."""
        if self.indenter is None:
            return self.bodies
        motion = self.history.motion
        indenter = RigidBody(
            self.indenter, self.contact_faces, motion, self.friction, name="indenter", sticking=self.sticking
        )
        return indenter, *self.bodies

    def drives(self, t: float) -> Drives:
        """What drives the rigid bodies at time ``t``."""
        return Drives.from_motions([body.motion for body in self.rigid_bodies], t)

    def take_over_forces(self, t: float, reactions: Array) -> Problem:
        """The problem with the ``reactions (b, 6)`` of the bodies as the forces left open at time ``t``."""
        first = len(self.rigid_bodies) - len(self.bodies)
        moved = [body.motion.take_over_forces(t, reactions[first + i]) for i, body in enumerate(self.bodies)]
        if all(motion is body.motion for motion, body in zip(moved, self.bodies)):
            return self
        bodies = tuple(replace(body, motion=motion) for body, motion in zip(self.bodies, moved))
        return replace(self, bodies=bodies)

    def delay(self, seconds: float) -> Problem:
        """The same problem, begun so many seconds later; until then whatever drives it rests."""
        if not seconds:
            return self
        return replace(
            self,
            history=self.history.delay(seconds),
            bodies=tuple(replace(body, motion=body.motion.delay(seconds)) for body in self.bodies),
            pressures=tuple(pressure.delay(seconds) for pressure in self.pressures),
            activation=None if self.activation is None else self.activation.delay(seconds),
            touch_down_s=self.touch_down_s + seconds if self.touch_down_s else 0.0,
        )

    def moving_s(self, t: float) -> float:
        """For how long further bodies, pressures and the activation have changed up to time ``t``, s."""
        others = (*(body.motion for body in self.bodies), *self.pressures, self.activation)
        return sum(one.moving_s(t) for one in others if one is not None)

    def travel(self, t: float) -> float:
        """A measure that grows evenly while the indenter, or what else drives the problem, changes."""
        return self.moving_s(t) + self.history.travel(t)

    @property
    def acts_at_once(self) -> bool:
        """True if a force, pressure, contraction or support acts from time 0 on, before anything moves."""
        drives = self.drives(0.0)
        moved = any(one.factor for one in self.supports) and self.history.displacement_at(0.0)
        loads = moved, self.activation_at(0.0), *(one.at(0.0) for one in self.pressures)
        return any(loads) or bool(drives.values[drives.forced].any())

    def activation_at(self, t: float) -> float:
        """Share of the active stress at time ``t``, s."""
        return 0.0 if self.activation is None else self.activation.at(t)

    @property
    def turns(self) -> Array:
        """Times at which a further body, a pressure or the activation turns, or contact begins, s."""
        knots = [np.asarray(one.times)[1:] for one in self.pressures]
        if self.touch_down_s:
            knots.append(np.array([self.touch_down_s]))
        if self.activation is not None:
            knots.append(np.asarray(self.activation.times)[1:])
        return np.unique(np.concatenate([np.zeros(0), *(body.motion.turns for body in self.bodies), *knots]))

    @property
    def kinks(self) -> Array:
        """Times, s, at which answers may have a kink: a phase of the indenter ends, or something turns."""
        return np.union1d(self.history.kinks, self.turns)

    @property
    def formulation(self) -> Element:
        """The row of the element table."""
        return ELEMENTS[self.element or self.mesh.cell_type]

    @property
    def parameter_names(self) -> tuple[tuple[str, str], ...]:
        """(region, parameter) in the order of every sensitivity."""
        return tuple(
            (region, name)
            for region in self.mesh.region_names
            for name in self.materials[region].parameter_names
        )

    @property
    def parameters(self) -> Array:
        """Values in the order of `parameter_names`; mm, N, s, MPa."""
        return np.array([v for region in self.mesh.region_names for v in self.materials[region].parameters])


def isochoric_stretch(directions: ArrayLike, stretches: ArrayLike) -> Array:
    """Pre-stretches (m, 3, 3) along ``directions`` at constant volume.

    ``directions (m, 3)``, or one (3,), of any length; ``stretches``, one or (m,), along them: what is across
    has their inverse root.  A layer that is stretched by s in its plane has 1/s^2 along its normal. Raises
    `ProblemError` where a direction has no length, or a stretch is not positive.
    """
    n, along = np.atleast_2d(np.asarray(directions, dtype=float)), np.asarray(stretches, dtype=float)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    if n.shape[1] != 3 or not (np.isfinite(n).all() and (length > 0.0).all()):
        raise ProblemError("a direction of the pre-stretch is no vector of three numbers with a length")
    if not (np.isfinite(along).all() and (along > 0.0).all()):
        raise ProblemError("a pre-stretch is not positive")
    n = n / length
    along = np.broadcast_to(along, len(n))[:, None, None]
    across = along**-0.5
    return np.asarray(across * np.eye(3) + (along - across) * n[:, :, None] * n[:, None, :])
