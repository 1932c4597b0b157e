"""With what a simulation begins: its discretisation, what holds points along bodies, what it is judged by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..contact.friction import LAWS_OF_STICKING
from ..contact.grip import StickyContact
from ..contact.sticky import Anchors
from ..history import Memory
from ..kernel.laws import Laws
from ..motion import Drives
from ..problem import Problem
from ..result import Result, State
from ..system import System

Array = NDArray[np.float64]


def compute_elastic_residual(system: System, laws: Laws, state: State) -> float:
    """Norm of the nodal forces of elastic tissue in a state, N."""
    still = Memory.rest(system, laws).increment(system, laws, 0.0, 1.0, state.displacement, 0.0, state.drives)
    return float(np.linalg.norm(system.evaluate(state.rows, laws, still, tangent=False).residual))


def measure_indenter_travel(system: System, modulus: float) -> float:
    """The way against which penetration is judged, mm: the largest of a body that is driven by displacement,
    or how deep the tissue at rest lies in what a body grows to.

    Where only forces drive bodies it is that of a flat punch on a half-space of the tissue's shear
    ``modulus``, ``F / (4 mu w)``, and no more than half a width.
    """
    bodies = system.problem.rigid_bodies
    if system.bodies is None:
        return float(np.abs(system.problem.history.driver).max())
    grown = [-one.surface.gaps_at_rest(one.start.grown(1.0)).min() for one in system.bodies.all
             if one.stated.motion.grows]  # fmt: skip
    if max(grown, default=0.0) > 0.0:
        return float(max(grown))
    sizes = [np.abs(np.nan_to_num(body.motion.values[:, :3])) for body in bodies]
    ways = [np.where(body.motion.free[:3], 0.0, size).max() for body, size in zip(bodies, sizes)]
    if max(ways) > 0.0:
        return float(max(ways))
    widths = [body.shape.width for body in bodies]
    pushed = [float(size.max()) / (4.0 * modulus * width) for size, width in zip(sizes, widths)]
    return max(min(way, width / 2) for way, width in zip(pushed, widths)) or max(widths) / 2


def build_grips(system: System, parameters: int) -> tuple[StickyContact | None, ...]:
    """What holds the points of each body at first; None where nothing ever does."""
    found: list[StickyContact | None] = []
    for body in [] if system.bodies is None else system.bodies.all:
        friction = body.stated.friction
        if friction in ("frictionless", 0.0):
            found.append(None)
        elif isinstance(friction, str):
            found.append(Anchors.none(body.surface, parameters))
        else:
            law = LAWS_OF_STICKING[body.stated.sticking]
            found.append(law.none(float(friction), body.surface, parameters, body.stated.holding))
    return tuple(found)


def start_grips(
    system: System, grips: Sequence[StickyContact | None], u: Array, drives: Drives
) -> tuple[StickyContact | None, ...]:
    """The grips with which a run begins, its bodies at rest where they start."""
    tools = [] if system.bodies is None else system.bodies.tools(u, drives)
    return tuple(grip and grip.begun(tool) for grip, tool in zip(grips, tools, strict=True))


def build_system(problem: Problem, warm_start: Result | None, system: System | None, threads: int) -> System:
    for known in (system, warm_start.system if warm_start is not None else None):
        if known is not None and known.fits(problem):
            return known
    return System(problem, threads)
