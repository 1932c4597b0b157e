"""The mechanical problem, checked before anything is solved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ProblemError
from ..mesh import Mesh
from ..phases import MotionPhase, boundaries, find_phases, loading_end
from .activation import Activation
from .contact.friction import LAWS_OF_STICKING
from .contact.indenter import Indenter
from .kernel.elements import ELEMENTS, Element, reference_gradients
from .materials import Material
from .motion import Drives, Motion, RigidBody
from .pressure import Pressure


@dataclass(frozen=True)
class History:
    """Piecewise linear advance of the indenter: ``times (n,)`` s from 0, ``displacement (n,)`` mm.

    ``across (n, 2)``: its move across its axis, along x and y of its frame, mm; None: none.
    ``force (n,)``: the force, N, that presses it along its axis instead of a displacement.
    """

    times: NDArray[np.float64]
    displacement: NDArray[np.float64] | None = None
    across: NDArray[np.float64] | None = None
    force: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        if (self.displacement is None) == (self.force is None):
            raise ProblemError("a history is one of displacement or one of force, not both or none")
        driver = "displacement" if self.force is None else "force"
        times, values = np.asarray(self.times, dtype=float), np.asarray(getattr(self, driver), dtype=float)
        if self.across is not None:
            across = np.asarray(self.across, dtype=float)
            if across.shape != (len(times), 2) or not np.isfinite(across).all():
                raise ProblemError("a move across the axis needs two finite numbers for each time")
            object.__setattr__(self, "across", across)
        if times.ndim != 1 or times.shape != values.shape or len(times) < 2:
            raise ProblemError(f"a {driver} history needs two or more times and as many {driver}s")
        if not (np.isfinite(times).all() and np.isfinite(values).all()):
            raise ProblemError(f"the {driver} history holds values that are not finite")
        if times[0] != 0.0:
            raise ProblemError(f"the {driver} history starts at {times[0]} s, not at 0")
        if not (np.diff(times) > 0).all():
            raise ProblemError(f"the {driver} history goes backwards in time")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, driver, values)

    @property
    def forced(self) -> bool:
        """Whether a force drives the indenter along its axis."""
        return self.force is not None

    @property
    def driver(self) -> NDArray[np.float64]:
        """(n,) displacement, mm, or force, N."""
        values = self.displacement if self.force is None else self.force
        assert values is not None
        return values

    def at(self, t: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """What drives it at time(s) ``t``: mm, or N where it is a force."""
        return np.asarray(np.interp(t, self.times, self.driver))

    def displacement_at(self, t: float) -> float:
        """Stated displacement at time ``t``, mm; 0 where a force drives it."""
        return 0.0 if self.forced else float(self.at(t))

    @cached_property
    def motion(self) -> Motion:
        """As that of a rigid body."""
        values = np.zeros((len(self.times), 6))
        values[:, 2] = self.driver
        if self.across is not None:
            values[:, :2] = self.across
        return Motion(self.times, values, (False, False, self.forced, False, False, False))

    def across_at(self, t: float) -> tuple[float, float]:
        """Move across the axis at time ``t``, mm."""
        if self.across is None:
            return 0.0, 0.0
        x, y = (float(np.interp(t, self.times, values)) for values in self.across.T)
        return x, y

    def travel(self, t: float) -> float:
        """Driver and moves across together: what changes while the indenter moves in any direction."""
        return float(self.at(t)) + sum(self.across_at(t))

    @cached_property
    def phases(self) -> tuple[MotionPhase, ...]:
        """What the indenter does: loads, holds, unloads, in any number."""
        return find_phases(self.times, self.driver)

    @property
    def kinks(self) -> NDArray[np.float64]:
        """Times where phases begin or end, or a move across the axis turns, s, both ends among them."""
        found = boundaries(self.phases)
        apart = np.abs(found[:, None] - self.turns).min(axis=0, initial=np.inf) > 1e-9 * self.times[-1]
        return np.union1d(found, self.turns[apart])

    @property
    def turns(self) -> NDArray[np.float64]:
        """Times where a move across the axis turns, s."""
        if self.across is None:
            return np.zeros(0)
        speeds = np.diff(self.across, axis=0) / np.diff(self.times)[:, None]
        turned = np.abs(np.diff(speeds, axis=0)).max(axis=1, initial=0.0) > 1e-9 * np.abs(speeds).max()
        return self.times[1:-1][turned]

    @property
    def peak(self) -> float:
        """End of the loading that first reaches the largest displacement, s; 0 where nothing advances."""
        loading = loading_end(self.phases)
        return 0.0 if loading is None else loading.end_s

    @property
    def loading_s(self) -> float:
        """How long the way to the `peak` takes, s; all of it where nothing advances."""
        return self.peak or float(self.times[-1])


@dataclass(frozen=True)
class Support:
    """Nodes whose displacement ``component`` (0, 1, 2) is ``factor`` times the history's displacement."""

    nodes: NDArray[np.int64]
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
        material is `Fibred`.
    activation : how much of the active stress of `Contractile` materials acts, over time.
    start : ``touching`` moves the indenter along its axis until it just touches; ``as-given`` does not.
    """

    mesh: Mesh
    materials: Mapping[str, Material]
    fixed: NDArray[np.int64]
    contact_faces: NDArray[np.int64]
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
    name: str = field(default="", compare=False)

    def with_materials(self, materials: Mapping[str, Material]) -> Problem:
        """The same problem with other materials; a prepared system stays valid."""
        return replace(self, materials=materials)

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
        return Drives.of([body.motion for body in self.rigid_bodies], t)

    def taken_over(self, t: float, reactions: NDArray[np.float64]) -> Problem:
        """With the ``reactions (b, 6)`` of the bodies at time ``t`` as the forces that are left open then."""
        first = len(self.rigid_bodies) - len(self.bodies)
        moved = [body.motion.taken_over(t, reactions[first + i]) for i, body in enumerate(self.bodies)]
        if all(motion is body.motion for motion, body in zip(moved, self.bodies)):
            return self
        bodies = tuple(replace(body, motion=motion) for body, motion in zip(self.bodies, moved))
        return replace(self, bodies=bodies)

    def travel(self, t: float) -> float:
        """What grows evenly while the indenter moves, or what drives bodies or activates tissue changes."""
        contracting = 0.0 if self.activation is None else self.activation.moving_s(t)
        return contracting + self.history.travel(t) + sum(b.motion.moving_s(t) for b in self.bodies)

    def activated(self, t: float) -> float:
        """Share of the active stress at time ``t``, s."""
        return 0.0 if self.activation is None else self.activation.at(t)

    @property
    def turns(self) -> NDArray[np.float64]:
        """Times where what drives a further body, a pressure or the activation turns, s."""
        knots = [np.asarray(one.times)[1:-1] for one in self.pressures]
        if self.activation is not None:
            knots.append(np.asarray(self.activation.times)[1:])
        return np.unique(np.concatenate([np.zeros(0), *(body.motion.turns for body in self.bodies), *knots]))

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
    def parameters(self) -> NDArray[np.float64]:
        """Values in the order of `parameter_names`; mm, N, s, MPa."""
        return np.array([v for region in self.mesh.region_names for v in self.materials[region].parameters])


def check(problem: Problem) -> None:
    """Raise `ProblemError` where the problem is impossible as stated."""
    _check_choices(problem)
    mesh, n = problem.mesh, len(problem.mesh.points)
    if not np.isfinite(mesh.points).all():
        raise ProblemError("the mesh has points that are not finite")
    if not len(mesh.cells):
        raise ProblemError("the mesh has no cells")
    indices = [("cells", mesh.cells), ("fixed nodes", problem.fixed)]
    indices += [("contact faces", np.asarray(body.faces)) for body in problem.rigid_bodies]
    indices += [("pressed faces", np.asarray(one.faces)) for one in problem.pressures]
    indices += [("support nodes", support.nodes) for support in problem.supports]
    for name, value in indices:
        value = np.asarray(value)
        if value.dtype == bool:
            raise ProblemError(f"the {name} are a mask", remedy="give node numbers: numpy.flatnonzero(mask)")
        if value.size and (value.min() < 0 or value.max() >= n):
            raise ProblemError(f"the {name} refer to nodes that the mesh does not have")
    _check_cells(problem)
    _check_fibres(problem)
    _check_bodies(problem)
    if not len(problem.fixed) and not problem.supports:
        raise ProblemError("nothing is held in place", remedy="fix the bone and proximal nodes")


def _check_choices(problem: Problem) -> None:
    mesh = problem.mesh
    name = problem.element or mesh.cell_type
    if name not in ELEMENTS or ELEMENTS[name].cell_type != mesh.cell_type:
        fitting = ", ".join(e.name for e in ELEMENTS.values() if e.cell_type == mesh.cell_type)
        raise ProblemError(f"no element {name!r} for {mesh.cell_type} cells", remedy=f"use one of {fitting}")
    missing = [region for region in mesh.region_names if region not in problem.materials]
    if missing:
        given = ", ".join(problem.materials) or "none"
        raise ProblemError(
            f"region {missing[0]!r} has no material", remedy=f"name it in materials; there are: {given}"
        )
    if mesh.regions.size and (mesh.regions.min() < 0 or mesh.regions.max() >= len(mesh.region_names)):
        raise ProblemError("the mesh has region indices without a name")
    if problem.contact_rule not in ELEMENTS[name].face_rules:
        rules = ", ".join(ELEMENTS[name].face_rules)
        raise ProblemError(f"unknown contact rule {problem.contact_rule!r}", remedy=f"use one of {rules}")
    if problem.start not in ("touching", "as-given"):
        raise ProblemError(f"unknown start {problem.start!r}", remedy="use 'touching' or 'as-given'")


def _check_friction(friction: str | float, sticking: str) -> None:
    if isinstance(friction, str):
        known = friction in ("frictionless", "sticky")
    else:
        known = not isinstance(friction, bool) and 0.0 <= friction < np.inf
    if not known:
        raise ProblemError(
            f"unknown friction {friction!r}", remedy="use 'frictionless', 'sticky' or a coefficient from 0 on"
        )
    if sticking not in LAWS_OF_STICKING:
        raise ProblemError(
            f"unknown law of sticking {sticking!r}", remedy=f"use {' or '.join(map(repr, LAWS_OF_STICKING))}"
        )


def _check_cells(problem: Problem) -> None:
    mesh = problem.mesh
    unique = np.unique(np.sort(mesh.cells, axis=1), axis=0)
    if len(unique) != len(mesh.cells):
        raise ProblemError(f"the mesh has {len(mesh.cells) - len(unique)} duplicate cells")
    _, weights = reference_gradients(problem.formulation, mesh.points, mesh.cells)
    upright = (weights > 0).all(axis=1)
    # A quadratic map may be upright at its points and its corners not.
    if mesh.kind.is_tetrahedron and len(mesh.kind.nodes) > mesh.kind.corners:
        corners = mesh.points[mesh.corners]
        upright &= np.linalg.det(corners[:, 1:] - corners[:, :1]) > 0
    bad = np.flatnonzero(~upright)
    if len(bad):
        raise ProblemError(f"{len(bad)} cells are inverted or flat, the first is cell {bad[0]}")
    used = np.zeros(len(mesh.points), dtype=bool)
    used[mesh.cells] = True
    if not used.all():
        raise ProblemError(f"{(~used).sum()} nodes belong to no cell", remedy="drop them from the mesh")


def _check_fibres(problem: Problem) -> None:
    for region in problem.mesh.region_names:
        if problem.activation is None and problem.materials[region].table().active > 0.0:
            raise ProblemError(
                f"the active stress of {region!r} acts at no stated time", remedy="state Problem.activation"
            )
    if problem.fibres is None:
        for region in problem.mesh.region_names:
            if problem.materials[region].table().has_fibres:
                raise ProblemError(
                    f"the fibres of {region!r} have no direction", remedy="state fibres, (3,) or (cells, 3)"
                )
        return
    given = np.asarray(problem.fibres, dtype=float)
    if given.shape not in ((3,), (len(problem.mesh.cells), 3)):
        raise ProblemError(
            f"fibres have shape {given.shape}", remedy=f"give (3,), or ({len(problem.mesh.cells)}, 3)"
        )
    if not (np.isfinite(given).all() and (np.linalg.norm(np.atleast_2d(given), axis=1) > 0.0).all()):
        raise ProblemError("a direction of the fibres is zero or not finite")


def _check_bodies(problem: Problem) -> None:
    width, bodies = problem.mesh.kind.faces.shape[1], problem.rigid_bodies
    for i, body in enumerate(bodies):
        faces, of = np.asarray(body.faces), f" of {body.name or f'body {i}'}" if len(bodies) > 1 else ""
        if faces.ndim != 2 or faces.shape[1] != width or not len(faces):
            raise ProblemError(f"contact faces{of} have shape {faces.shape}, not (f, {width}) with f > 0")
        _check_friction(body.friction, body.sticking)
        if body.motion.grows and not body.shape.grows:
            raise ProblemError(
                f"the shape{of or ' of the body'} does not grow",
                remedy="give a SmoothSurface with a clear shape, or a growth of 1",
            )
    for one in problem.pressures:
        if np.asarray(one.faces).ndim != 2 or np.asarray(one.faces).shape[1] != width:
            raise ProblemError(f"pressed faces have shape {np.asarray(one.faces).shape}, not (f, {width})")
    end = problem.history.times[-1]
    for i, body in enumerate(problem.bodies):
        if np.isnan(body.motion.values[0]).any():
            raise ProblemError(
                f"the motion of {body.name or f'body {i}'} leaves open with which force it begins",
                remedy="state it; only a coordinate that was held before may take over its force",
            )
        if body.motion.times[-1] < end * (1.0 - 1e-9):
            raise ProblemError(
                f"the motion of {body.name or f'body {i}'} ends at {body.motion.times[-1]:g} s, before the "
                f"history does, at {end:g} s",
                remedy="state it to the end",
            )
    moved = problem.indenter is None or any(support.factor for support in problem.supports)
    if problem.history.forced and moved:
        raise ProblemError("a history of force drives an indenter, not supports")
