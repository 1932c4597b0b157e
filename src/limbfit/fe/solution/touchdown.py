"""Where the indenter meets tissue that has moved before: that pins hold, that is tensed, or strained at rest.

It stays clear of the tissue until `Problem.touch_down_s`; then it is advanced until it just touches, and its
displacement counts from there.  That place follows the parameters, and so its derivative enters all others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..contact.contact import find_touching_offset
from ..motion import Drives
from ..problem import Problem
from ..system import Evaluation, System
from .coupling import Coupling

Array = NDArray[np.float64]
CLEAR = 3.0  # widths of the indenter that it is off the tissue until it touches


@dataclass(frozen=True)
class IndenterStart:
    """How far the indenter begins beyond where it would touch the tissue at rest.

    Parameters
    ----------
    waits : whether it is still clear of the tissue.
    offset : mm along its axis.
    slope : (p,) derivative of the offset with respect to the parameters; None where it has none.
    """

    waits: bool = False
    offset: float = 0.0
    slope: Array | None = None

    @classmethod
    def of(cls, problem: Problem) -> IndenterStart:
        """That with which a simulation begins."""
        meets = problem.touch_down_s > 0.0 or (problem.prestretch is not None and problem.start == "touching")
        if problem.indenter is None or not meets:
            return cls()
        return cls(True, -CLEAR * problem.indenter.width)

    def after(self, system: System, u: Array, drives: Drives, du: Array | None) -> IndenterStart:
        """It touches the tissue at ``u (r, 3)``, whose derivative is ``du (r, 3, p)``."""
        assert system.bodies is not None
        body = system.bodies.first
        surface = replace(body.surface, points=body.surface.points + u[: system.nodes])
        offset = find_touching_offset(surface, body.start)
        if du is None:
            return IndenterStart(False, offset)
        moved = IndenterStart(False, offset).drives(drives)
        tool = system.bodies.tools(u, moved)[0]
        gaps, normals, _ = tool.body.local_distance(tool.local)
        at = np.unravel_index(gaps.argmin(), gaps.shape)
        normal = normals[at]
        return IndenterStart(False, offset, normal @ tool.moved(du)[at] / normal[2])

    def drives(self, stated: Drives) -> Drives:
        """What drives the bodies, with the indenter moved by the offset."""
        if not self.offset:
            return stated
        values = stated.values.copy()
        values[0, 2] += self.offset
        return replace(stated, values=values)

    def pushed(self, system: System, at: Evaluation, coupling: Coupling) -> Array | None:
        """Derivative (c, 3, p) of the forces on the contact points through the offset alone, N."""
        if self.slope is None or system.bodies is None or at.touch is None:
            return None
        points, axis = system.bodies.first.points, system.bodies.first.frame[2]
        out = np.zeros((system.bodies.count, 3, len(self.slope)))
        stiff = (at.touch.blocks + coupling.blocks)[points]
        out[points] = -(stiff @ axis)[..., None] * self.slope
        return out

    def beside(self, system: System, du: Array | None) -> Array | None:
        """Derivatives (r, 3, p) of displacements, relative to where the indenter touched."""
        if du is None or self.slope is None or system.bodies is None:
            return du
        return du - system.bodies.first.frame[2][:, None] * self.slope
