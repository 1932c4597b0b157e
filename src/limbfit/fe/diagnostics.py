"""Warnings about a simulation that reaches its end, by kind.

The caller decides by the kind what to do with the simulation; the text is for the user.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..arrays import Array
from ..mesh import Mesh, node_jacobians

Kind = Literal["folded", "slipped", "sunk", "unbalanced", "unsettled", "inexact"]

RELAXATION_SHARE = 0.9  # a force below this share of the one before, in an advancing step, is no relaxation
SLOWER_SHARE = 0.75  # unless the step is slower than this share of a speed before it: what was quick relaxes
# Share of the strain energy that folded elements may hold: their stiffness lost, the force would fall by
# about as much, and less than by the error of the mesh.
FOLDED_ENERGY = 0.01


@dataclass(frozen=True)
class SimulationWarning:
    """One warning about a simulation.

    Parameters
    ----------
    kind : ``folded`` (elements that matter are inside out at a node), ``slipped`` (the force falls in
        loading), ``sunk`` (the indenter is deeper in the skin than allowed), ``unbalanced`` (equilibrium to
        less than the tolerance), ``unsettled`` (friction of another normal force than there is), ``inexact``
        (sensitivities).
    text : one sentence, with its remedy.
    count : elements (``folded``), or steps.
    depth_mm : indentation at which it first occurs; of folded elements, at which they were counted.
    share : the same over the largest indentation.
    """

    kind: Kind
    text: str
    count: int
    depth_mm: float
    share: float


def list_texts(doubts: Sequence[SimulationWarning], *kinds: Kind) -> tuple[str, ...]:
    """The text of each kind of warning; empty where there is none of that kind."""
    said = {doubt.kind: doubt.text for doubt in doubts}
    return tuple(said.get(kind, "") for kind in kinds)


def _build_warning(
    kind: Kind, text: str, count: int, depth_mm: float, displacement: Array
) -> tuple[SimulationWarning]:
    most = float(np.abs(displacement).max(initial=0.0))
    return (SimulationWarning(kind, text, count, float(depth_mm), float(depth_mm) / most if most else 0.0),)


def find_inverted_elements(
    mesh: Mesh, u: Array, energy: Callable[[], Array], depth_mm: float, displacement: Array
) -> tuple[SimulationWarning, ...]:
    """Elements that are inside out at a node of theirs at the displacements ``u (n, 3)`` of a depth.

    The quadrature of ``tet10`` lies inside and does not see it; the element has lost part of its stiffness.
    There is no warning where they hold less than `FOLDED_ENERGY` of all ``energy (m,)``, N mm.
    """
    shape = mesh.with_points(mesh.points + u)
    inverted = (node_jacobians(shape) <= 0.0).any(axis=1)
    if not inverted.any():
        return ()
    held = energy()
    share = float(held[inverted].sum() / held.sum())
    if share < FOLDED_ENERGY:
        return ()
    count = int(inverted.sum())
    text = (
        f"{count} elements are inside out at a node at {depth_mm:.3g} mm; they hold {100 * share:.2g} % of "
        "the strain energy, and the force may be too small by about as much: use element tet10v, a rounded "
        "edge of the indenter or a finer mesh at its edge"
    )
    return _build_warning("folded", text, count, depth_mm, displacement)


def find_slip(times: Array, displacement: Array, force: Array) -> tuple[SimulationWarning, ...]:
    """A warning if the force (n,), N, falls while the indenter advances (n,), mm, as quickly as before.

    The tissue has lost its equilibrium.
    """
    advance = np.diff(displacement)
    speeds = advance / np.diff(times)
    steady = speeds > SLOWER_SHARE * np.maximum.accumulate(speeds)
    advancing = steady & (advance > 1e-2 * displacement.max())
    falls = np.flatnonzero(advancing & (force[1:] < RELAXATION_SHARE * force[:-1]))
    if not len(falls):
        return ()
    (before, after), (start, end) = force[falls[0] :][:2], displacement[falls[0] :][:2]
    text = (
        f"the force falls from {before:.3g} N to {after:.3g} N while the indenter advances from {start:.3g} "
        f"to {end:.3g} mm: tissue folds, or slips past the indenter between contact points; "
        "use a finer mesh there"
    )
    return _build_warning("slipped", text, len(falls), start, displacement)


def find_penetration(
    displacement: Array, penetration: Array, allowed_mm: float, penalty: float
) -> tuple[SimulationWarning, ...]:
    """Steps whose penetration (n,), mm, is more than is allowed, with contact of ``penalty`` (1/mm)."""
    deep = np.flatnonzero(penetration > allowed_mm)
    if not len(deep):
        return ()
    most = float(penetration.max())
    stiffer = float(f"{1.5 * penalty * most / allowed_mm:.2g}")
    text = (
        f"the indenter sinks in by up to {most:.3g} mm in {len(deep)} steps, more than the allowed "
        f"{allowed_mm:.3g} mm, and the force is a little too small: state a stiffer contact than "
        f"{penalty:.4g} per mm (solver.penalty_per_mm), such as {stiffer:g}"
    )
    return _build_warning("sunk", text, len(deep), displacement[deep[0]], displacement)


def find_inexact_steps(
    kind: Literal["unbalanced", "unsettled"],
    displacement: Array,
    steps: Sequence[tuple[float, float]],
    tolerance: float,
) -> tuple[SimulationWarning, ...]:
    """Steps, as (mm, residual over reactions), that were accepted at more than the tolerance, or whose
    friction did not settle with the normal force."""
    if not steps:
        return ()
    count, worst, first = len(steps), max(residual for _, residual in steps), f"first at {steps[0][0]:.3g} mm"
    texts = {
        "unbalanced": f"{count} steps are in equilibrium to {worst:.2g} of the reactions only, not to "
        f"{tolerance:.2g}, {first}: the force may be off by as much",
        "unsettled": f"the friction of {count} steps belongs to a normal force that is off by up to "
        f"{worst:.2g} of the reactions, {first}: use more steps",
    }
    return _build_warning(kind, texts[kind], count, steps[0][0], displacement)


def find_inexact_sensitivities(displacement: Array, count: int) -> tuple[SimulationWarning, ...]:
    """Sensitivities of unstable equilibria that could not be solved for."""
    text = f"{count} sensitivities at unstable equilibria are inexact"
    return _build_warning("inexact", text, count, 0.0, displacement) if count else ()
