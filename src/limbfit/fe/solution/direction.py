"""Newton's direction, with a prediction of the contact points that it closes and opens.

The set of closed points is iterated on the linear model (a primal-dual active set, Hintermueller, Ito and
Kunisch 2003).  Each missed point would cost an assembly of all elements; here it costs a small dense
solution.
"""

from dataclasses import replace

import numpy as np

from ...arrays import Array, Mask
from ..contact.contact import Touch
from ..system import Evaluation, System
from .factor import Factor, LinearSolution, SpringChange

SWEEPS, ROUNDS = 12, 4


def find_newton_direction(
    system: System, at: Evaluation, factor: Factor, tolerance: float, damping: float = 0.0
) -> Array:
    """Direction (n, 3) that solves the linear model within ``tolerance``, relative to the residual.

    ``damping``: share of each tissue's shear stiffness that is added to the tangent.
    Where the model is not convex it is only a direction of descent.
    """
    b = -at.residual.ravel()[system.free][:, None]
    if not factor.ready and factor.is_lasting:
        _begin(system, at, factor)
    if damping:
        at = replace(at, data=factor.stiffen(at.tangent, damping))
    if at.touch is None:
        if not factor.is_lasting:
            factor.factorise(at.tangent)
        found = factor.solve(at.tangent, b, None, tolerance)
        if not found.converged and found.convex:
            found = factor.refactor_and_solve(at.tangent, b, None, tolerance, found.x)
    else:
        found = _solve_with_contact(system, at, at.touch, factor, b, tolerance)
        if float(b[:, 0] @ found.x[:, 0]) <= 0.0:
            springs = _match_springs(factor, at, at.touch, at.touch.is_closed, at.tangent)
            found = factor.solve(at.tangent, b, springs, tolerance)  # the closed points stay closed
    direction = np.zeros(at.residual.size)
    direction[system.free] = found.x[:, 0]
    return direction.reshape(at.residual.shape)


def _change(factor: Factor, at: Evaluation, touch: Touch, closed: Mask) -> SpringChange | None:
    """How the springs of a set of closed points differ from the factor's; None where too many close or open.

    Where those of the present set already differ too much, there is a new factor.
    """
    still = np.zeros_like(touch.is_closed)
    if factor.change_springs(still, touch.normals, touch.blocks) is None:
        factor.factorise(at.tangent, touch.blocks)
    return factor.change_springs(closed != touch.is_closed, touch.normals, touch.assume_closed(closed)[0])


def _match_springs(
    factor: Factor, at: Evaluation, touch: Touch, closed: Mask, data: Array
) -> SpringChange | None:
    """`_change`; what does not last is made anew for ``data``, the tangent with those springs, instead."""
    if factor.is_lasting:
        return _change(factor, at, touch, closed)
    factor.factorise(data, touch.assume_closed(closed)[0])
    return None


def _solve_with_contact(
    system: System, at: Evaluation, touch: Touch, factor: Factor, b: Array, tolerance: float
) -> LinearSolution:
    bodies = system.bodies
    found, closed = LinearSolution(np.zeros_like(b), True, True), touch.is_closed
    for _ in range(ROUNDS):
        guess = found.x
        if factor.is_lasting:
            guess, closed = _predict_closed(system, at, touch, factor, b, guess, closed)
        blocks, change = touch.assume_closed(closed)
        data = bodies.with_springs(at.tangent, blocks - touch.blocks)
        springs = _match_springs(factor, at, touch, closed, data)
        right = b - bodies.spread_forces(change)[:, None]
        found = factor.solve(data, right, springs, tolerance, guess)
        if not found.converged and found.convex:
            found = factor.refactor_and_solve(data, right, blocks, tolerance, found.x)
        if not found.convex and factor.is_lasting:
            found = _solve_for_descent(factor, data, right, blocks, tolerance)
        predicted = _find_closed(touch, bodies.move_springs(found.x[:, 0]))
        if (predicted == closed).all() or (factor.is_lasting and springs is None) or not found.convex:
            break
        closed = predicted
    return found


def _solve_for_descent(
    factor: Factor, data: Array, b: Array, blocks: Array, tolerance: float
) -> LinearSolution:
    """Where an old factor met negative curvature: the solution of a new one, stiffened where need be."""
    factor.factorise(data, blocks)
    if not factor.is_shifted:
        found = factor.solve(data, b, None, tolerance)
        if found.convex:
            return found
    return LinearSolution(factor.apply(b), False, False)


def _find_closed(touch: Touch, moved: Array) -> Mask:
    return touch.gaps + np.einsum("ci,ci->c", touch.normals, moved) < 0.0


def _predict_closed(
    system: System, at: Evaluation, touch: Touch, factor: Factor, b: Array, x: Array, closed: Mask
) -> tuple[Array, Mask]:
    """Displacement (n, 1) and closed points by the factor's model, from ``x (n, 1)`` on."""
    springs = _change(factor, at, touch, closed)
    if springs is None:
        return x, touch.is_closed
    before = system.bodies.move_springs(x[:, 0])
    y = factor.forward(b - factor.multiply(at.tangent, x) if x.any() else b)
    moved = factor.columns.displace_points(y, closed | touch.is_closed)
    part = None
    for _ in range(SWEEPS):
        blocks, change = touch.assume_closed(closed)
        springs = factor.change_springs(closed != touch.is_closed, touch.normals, blocks)
        if springs is None:
            break
        forces = -change - np.einsum("cij,cj->ci", blocks - touch.blocks, before)
        part, kept = springs.coefficients(moved, forces), closed
        closed = _find_closed(touch, before + moved + springs.combine_at_points(part))
        if (closed == kept).all():
            break
    if part is None:
        return x, touch.is_closed
    return x + factor.backward(factor.columns.add_to(y, part[:, None])), kept


def solve_at(at: Evaluation, factor: Factor, b: Array, x: Array, tolerance: float) -> Array:
    """Solution (n, r) of the tangent at an equilibrium for ``b (n, r)``, from the guess ``x``."""
    springs = update_springs(at, factor)
    found = factor.solve(at.tangent, b, springs, tolerance, x)
    if not found.converged:
        blocks = None if at.touch is None else at.touch.blocks
        found = factor.refactor_and_solve(at.tangent, b, blocks, tolerance, found.x)
    if not found.convex:
        return factor.solve_indefinite(at.tangent, b, tolerance, x)
    return found.x


def update_springs(at: Evaluation, factor: Factor) -> SpringChange | None:
    """The springs by which an evaluation differs from what is factorised; what does not last is made anew."""
    if not factor.ready or not factor.is_lasting:
        refactor_at(at, factor)
    if at.touch is None or not factor.is_lasting:
        return None
    return _change(factor, at, at.touch, at.touch.is_closed)


def _begin(system: System, at: Evaluation, factor: Factor) -> None:
    """The first factor, without contact: it is positive definite, however deep the indenter is at first."""
    if at.touch is None:
        factor.factorise(at.tangent)
    else:
        without = system.bodies.with_springs(at.tangent, -at.touch.blocks)
        factor.factorise(without, np.zeros_like(at.touch.blocks))


def refactor_at(at: Evaluation, factor: Factor) -> None:
    """Factorise the tangent of an equilibrium: there it is positive definite."""
    factor.factorise(at.tangent, None if at.touch is None else at.touch.blocks)
