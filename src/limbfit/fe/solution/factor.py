"""One factorisation, used as long as it pays, as the preconditioner of conjugate gradients; or multigrid.

The factor is in single precision, half the price; the iteration runs in double.  Contact changes are few
but stiff, and would spoil an old factor at once.  They are local springs, so the preconditioner takes them
in exactly (`SpringColumns`); only the slow change of the tissue's own stiffness is left to the iteration.

The tangent of an unstable state is made positive definite, so that Newton's direction is of descent.  The
directions in which nearly incompressible tissue is unstable shear it: folds of a soft skin over a stiff
muscle. The stiffness added is therefore that of shear alone, a share of each tissue's own modulus; one that
is relative to the diagonal would be ruled by the bulk modulus, a hundred times larger, and stop what is
stable, too.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from ...arrays import Array, Index, Indices, Mask
from ..bodies import GROUNDING_STIFFNESS
from ..problem import Problem
from ..system import System
from .linear import (
    NONE,
    LinearSolver,
    NotPositiveDefiniteError,
    build_linear_solver,
    multiply_symmetric,
    prefers_multigrid,
)
from .multigrid import Multigrid

Single = NDArray[np.float32]
# Smaller changes, relative to the stiffest spring, are left to the iteration.
NOTABLE_CHANGE = 0.03
# With more columns than this the dense solutions cost too much.
MAX_COLUMNS = 500
# Over the power 2/3 of all unknowns, as a cut across the body has: with more, the factor itself costs too
# much.
MAX_LAST = 1.5
# A factor in single precision that needs more iterations at its own matrix has too few digits.
MAX_REFINEMENTS = 12
MAX_MINRES, MAX_RESTARTS = 100, 8
# With fewer unknowns a factor costs no more than multigrid, with more of them in many steps, which a factor
# outlasts as they are short; with more cycles than the last number multigrid is given up.
MIN_MULTIGRID, MIN_IN_MANY_STEPS, MANY_STEPS, MAX_CYCLES = 33_000, 60_000, 25, 150
# Smallest and largest shear stiffness added to a tangent that is not positive definite, as a share of each
# tissue's own: tissues differ by up to a hundredfold, and a common one would freeze the softest.
FIRST_SHIFT, LARGEST_SHIFT = 0.1, 1e6


@dataclass(frozen=True)
class LinearSolution:
    """``x (n, r)``; ``converged`` within the limit; ``convex``: no negative curvature was met."""

    x: Array
    converged: bool
    convex: bool


class Factor:
    """The linear algebra of one simulation: a factor of some earlier tangent and what to do with it.

    ``counts`` and ``seconds`` tell what was done.  ``name`` auto is `Multigrid` for quadratic tetrahedra,
    unless they are few or the factor is to be ``lasting``, and this machine's factorisations are not slow.
    ``moduli (r,)``: shear modulus of each region, MPa; ``steps``: of the simulation, as planned.
    """

    def __init__(
        self, system: System, moduli: Array, name: str = "auto", threads: int = 1, lasting: bool = False,
        last: Index = NONE, steps: int = 0,
    ) -> None:  # fmt: skip
        self._system, self._moduli, self._choice, self._threads = system, moduli, name, threads
        self._last = last
        suits = not system.bodies.free and system.cells.shape[1] == 10
        fewest = MIN_IN_MANY_STEPS if steps > MANY_STEPS else MIN_MULTIGRID
        many = system.unknowns >= fewest and not lasting
        if name == "auto" and suits and (many or prefers_multigrid()):
            self._choice = Multigrid.name
        self._diagonal = system.indptr[:-1]
        self._shear: Array | None = None
        self._ground = compute_body_stiffness(system, moduli)
        self.counts: Counter[str] = Counter()
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._wanted = self._choice
        self.reset()

    def reset(self) -> None:
        """Forget every matrix: what follows does not depend on those that there were."""
        self._choice, self._shift, self._next_shift, self._costs = self._wanted, 0.0, 0.0, [0.0]
        self.ready = False
        self._replace_solver(single=True)

    def _replace_solver(self, single: bool) -> None:
        started = time.perf_counter()
        system, threads = self._system, self._threads
        if self._choice == Multigrid.name:
            self.solver: LinearSolver = Multigrid(system, threads)
        else:
            self.solver = build_linear_solver(
                system.indptr, system.indices, self._choice, threads, single, self._last
            )
        self._single = single
        self.columns = SpringColumns(self._system, self)
        self.counts["double_precision"] = int(not single)
        self.seconds["factor"] += time.perf_counter() - started

    @property
    def is_shifted(self) -> bool:
        """True if what was factorised last had to be stiffened."""
        return self._shift > 0.0

    @property
    def is_lasting(self) -> bool:
        """True if what was factorised is worth keeping for other matrices."""
        return self.solver.lasting

    @property
    def limit(self) -> int:
        """Products after which a new factorisation would have been cheaper."""
        return int(self.solver.worth) if self.is_lasting else MAX_CYCLES

    def is_worn(self) -> bool:
        """True if another step with this factor costs more than the steps since it was made did on average.

        The optimal time to replace a machine whose running cost rises (Barlow and Proschan 1965).
        """
        steps = self._costs
        return self.is_lasting and len(steps) > 1 and steps[-1] * len(steps) > self.solver.worth + sum(steps)

    def start_step(self) -> None:
        """From here the cost counts for another step."""
        if self._costs != [0.0]:  # a factor made between steps has served none yet
            self._costs.append(0.0)

    def factorise(self, data: Array, blocks: Array | None = None) -> None:
        """Factorise; a tangent that is not positive definite is shifted until it is.

        Raises `NotPositiveDefiniteError` where no shift helps: there are entries that are not finite.

        ``blocks (c, 3, 3)``: the contact springs that are in ``data``.
        """
        made = not self.ready and self.is_lasting and self._is_single_enough(data)
        started = time.perf_counter()
        shift = self._next_shift
        while not made and not self._try_factorise(data, shift):
            shift = max(10.0 * shift, FIRST_SHIFT)
            if shift > LARGEST_SHIFT:
                raise NotPositiveDefiniteError
        # Less is tried next time, unless less was too little now.
        enough = shift == self._next_shift
        self._next_shift = (0.1 * shift if shift > FIRST_SHIFT else 0.0) if enough else shift
        self._shift = shift
        self.ready = True
        self.columns.clear(blocks)
        self._costs = [0.0]
        self.seconds["factor"] += time.perf_counter() - started

    def stiffen(self, data: Array, share: float) -> Array:
        """The entries ``data`` of a tangent with a share of each tissue's own shear stiffness added."""
        if self._shear is None:
            self._shear = compute_shear_stiffness(self._system, self._moduli)
        return data + share * self._shear

    def _try_factorise(self, data: Array, shift: float) -> bool:
        self.counts["factorisations" if self.is_lasting else "multigrids"] += 1
        data = self.stiffen(data, shift) if shift else data
        if len(self._ground[0]):  # a body that touches nothing yet is held by nothing
            data = data.copy()
            data[self._ground[0]] += self._ground[1]
        try:
            self.solver.factorise(data)
        except NotPositiveDefiniteError:
            return False
        return True

    def _is_single_enough(self, data: Array) -> bool:
        """Factorise the first tangent (of the body at rest) in single precision, if that is enough."""
        if self._single and self._try_factorise(data, 0.0):
            self.columns.clear(None)
            self._costs = [0.0]
            b = data[self._diagonal][:, None]
            if self.solve(data, b, None, 1e-8, limit=MAX_REFINEMENTS).converged:
                return True
        self._replace_solver(single=False)
        return False

    def apply(self, b: Array) -> Array:
        """The factor's solution for ``b (n,)`` or ``(n, r)``."""
        return self._time_half(self.solver.solve, b, 1.0)

    def forward(self, b: Array, last: bool = False) -> Array:
        """The first half of `apply`, as in `LinearSolver`."""
        return self._time_half(lambda b: self.solver.forward(b, last), b, 0.0 if last else 0.5)

    def backward(self, y: Array, last: bool = False) -> Array:
        """The second half of `apply`, as in `LinearSolver`."""
        return self._time_half(lambda y: self.solver.backward(y, last), y, 0.0 if last else 0.5)

    def _time_half(self, half: Callable[[Array], Array], b: Array, share: float) -> Array:
        """What a solver does to ``b``, which costs a ``share`` of a solution."""
        started = time.perf_counter()
        x = half(b)
        self.counts["half_solves"] += int(2.0 * share)
        # Columns share the reading of the factor: eight cost less than three times one.
        self._costs[-1] += share * (0.75 + 0.25 * (1 if b.ndim == 1 else b.shape[1]))
        self.seconds["solve"] += time.perf_counter() - started
        return x

    def multiply(self, data: Array, x: Array) -> Array:
        """``A x`` for the entries ``data`` of A."""
        started = time.perf_counter()
        self.counts["products"] += 1
        y = multiply_symmetric(self._system.indptr, self._system.indices, data, x, self._threads)
        self.seconds["product"] += time.perf_counter() - started
        return y

    def change_springs(self, touched: Mask, normals: Array, blocks: Array) -> SpringChange | None:
        """What springs that differ from the factor's do to its solutions; None: they are too many.

        ``touched (c,)``: springs that will be pushed although they may not differ.
        """
        return self.columns.change(touched, normals, blocks, int(6.0 * self.solver.worth))

    def solve(
        self, data: Array, b: Array, springs: SpringChange | None, tolerance: float,
        x: Array | None = None, limit: int | None = None,
    ) -> LinearSolution:  # fmt: skip
        """Solve ``A x = b (n, r)`` by conjugate gradients from the guess ``x``.

        ``data``: entries of A. ``springs``: the contact springs in which A differs from the factor.
        ``tolerance``: of the residual of each column, relative to ``b``. ``limit``: of products; by default
        what a factorisation would have cost.
        """
        target = tolerance * np.linalg.norm(b, axis=0)
        x = np.zeros_like(b) if x is None else x.copy()
        r = b - self.multiply(data, x) if x.any() else b.copy()
        p, rz = np.zeros_like(b), np.ones(b.shape[1])
        for _ in range(self.limit if limit is None else limit):
            if (np.linalg.norm(r, axis=0) <= target).all():
                return LinearSolution(x, True, True)
            z = self.precondition(r, springs)
            fresh = np.einsum("ij,ij->j", r, z)
            p = z + fresh / np.where(rz > 0.0, rz, 1.0) * p
            rz = fresh
            if (rz < 0.0).any():
                # Multigrid of a matrix that is not positive definite need not be either; a factor that is
                # not has too few digits.
                return LinearSolution(x if x.any() else r, False, self.is_lasting)
            Ap = self.multiply(data, p)
            curvature = np.einsum("ij,ij->j", p, Ap)
            live = rz > 0.0
            if (curvature[live] <= 0.0).any():  # Steihaug 1983: stop at the edge of the convex region
                return LinearSolution(x if x.any() else z, False, False)
            step = np.where(live, rz / np.where(live, curvature, 1.0), 0.0)
            x += step * p
            r -= step * Ap
        return LinearSolution(x, bool((np.linalg.norm(r, axis=0) <= target).all()), True)

    def refactor_and_solve(
        self, data: Array, b: Array, blocks: Array | None, tolerance: float, x: Array
    ) -> LinearSolution:
        """`solve` with a factor of this very matrix, whose springs are ``blocks (c, 3, 3)``.

        Where even that does not converge, single precision is too little for the matrix, and is given up.
        Multigrid that has not converged is given up for a factor.
        """
        if not self.is_lasting:
            self._choice = "auto"
            self._replace_solver(single=True)
        self.factorise(data, blocks)
        found = self.solve(data, b, None, tolerance, x)
        if self._single and not self.is_shifted and found.convex and not found.converged:
            self._replace_solver(single=False)
            self.factorise(data, blocks)
            found = self.solve(data, b, None, tolerance, x, limit=10 * self.limit)
        return found

    def solve_indefinite(self, data: Array, b: Array, tolerance: float, x: Array) -> Array:
        """Solve ``A x = b (n, r)`` where A has negative eigenvalues: MINRES, column by column.

        Columns that do not get within ``tolerance`` are counted as ``inexact``.
        """
        shape = (len(b), len(b))
        A = spla.LinearOperator(shape, matvec=lambda v: self.multiply(data, v.reshape(-1, 1)).ravel())
        M = spla.LinearOperator(shape, matvec=lambda v: self.apply(v.ravel()))
        out = x.copy()
        for i in range(b.shape[1]):
            target = tolerance * np.linalg.norm(b[:, i])
            for _ in range(MAX_RESTARTS):  # MINRES judges the residual in the factor's norm
                r = b[:, i] - A.matvec(out[:, i])
                if np.linalg.norm(r) <= target:
                    break
                out[:, i] += spla.minres(A, r, rtol=tolerance, maxiter=MAX_MINRES, M=M)[0]
            else:
                self.counts["inexact"] += 1
        return out

    def precondition(self, r: Array, springs: SpringChange | None) -> Array:
        """The factor's solution (n, k) for ``r (n, k)``, corrected for the changed springs."""
        if springs is None:
            return self.apply(r)
        return self.backward(springs.correct(self.forward(r)))


_CELLS = 2000  # at a time


def compute_shear_stiffness(system: System, moduli: Array) -> Array:
    """Entries of the matrix of the integral of ``mu grad u : grad v``, in the pattern of ``system``.

    ``moduli (r,)``: shear modulus of each region, MPa.
    """
    data = np.zeros(len(system.indices))
    k = system.cells.shape[1]
    rows, columns = np.triu_indices(3 * k)
    same = rows // k == columns // k
    a, b = rows[same] % k, columns[same] % k
    weights = system.weights * moduli[system.regions][:, None]
    for start in range(0, len(system.cells), _CELLS):
        cells = slice(start, start + _CELLS)
        gradients = system.gradients[cells]
        nodal = np.einsum("mqia,mqib,mq->mab", gradients, gradients, weights[cells], optimize=True)
        places = system.cell_positions[cells][:, same]
        held = places < 0
        data += np.bincount(places[~held], nodal[:, a, b][~held], minlength=len(data))
    places, stiffness = compute_body_stiffness(system, moduli)
    data[places] += stiffness / GROUNDING_STIFFNESS
    return data


def compute_body_stiffness(system: System, moduli: Array) -> tuple[Index, Array]:
    """Diagonal entries of the coordinates that are free to move rigid bodies, and what holds those of bodies
    that touch nothing (k,), N/mm."""
    places = system.indptr[-1 - system.bodies.free : -1]
    return places, system.bodies.compute_grounding(float(np.mean(moduli)))


def find_touched_unknowns(system: System, problem: Problem) -> Index:
    """Unknowns where bodies will touch, for the factor to eliminate last; none where they are too many."""
    found = system.bodies.find_swept_unknowns([body.motion for body in problem.rigid_bodies])
    return found if len(found) <= MAX_LAST * system.unknowns ** (2 / 3) else NONE


class SpringColumns:
    """Contact springs that changed since a factorisation, taken into its solutions exactly.

    With ``F`` the factored matrix, ``N`` unit forces at the changed springs and ``D`` the change of their
    stiffness, ``(F + N D N^T)^-1 = F^-1 - F^-1 N D (I + S D)^-1 N^T F^-1``, ``S = N^T F^-1 N`` (Sherman,
    Morrison and Woodbury).  All that contact does to a solution thus happens in a small dense space.
    With ``F^-1 = B A``, the halves of a solution, it happens between them: ``W = A N`` and ``P = B^T N`` give
    ``S = P^T W`` and ``B (I - W D (I + S D)^-1 P^T) A``.  Of a Cholesky factor ``P`` is ``W``, and where the
    indenter will touch is eliminated last, so that ``W`` is small and costs nothing.

    The columns of ``W`` are made when first needed, and kept.
    ``inner (c,)``: points whose columns cost nothing, since they stand on unknowns that are eliminated last.
    ``rows``: unknowns beyond which ``W (rows, k)`` is zero.  ``at_points (c, 3, k)``: how the forces move the
    points; 0 where that is not known for nothing.
    """

    def __init__(self, system: System, factor: Factor) -> None:
        self._bodies, self._unknowns, self._factor = system.bodies, system.unknowns, factor
        self.inner = system.bodies.find_points_on(factor.solver.last)
        self._shares = system.bodies.shares[factor.solver.last]
        self.clear(None)

    def clear(self, blocks: Array | None) -> None:
        """Forget the columns: there is a new factor, whose springs are ``blocks (c, 3, 3)``."""
        self.blocks = blocks
        self.keys: dict[tuple[int, int], int] = {}
        self.rows: Index | slice = self._factor.solver.last if self.inner.any() else slice(None)
        # In single precision like the factor: they only precondition.
        rows = len(self._factor.solver.last) if self.inner.any() else self._unknowns
        self.W: Single = np.empty((rows, 0), dtype=np.float32)
        self.P = self.W
        self.S = np.empty((0, 0))
        count = 0 if blocks is None else len(blocks)
        self.at_points = np.empty((count, 3, 0))

    def change(self, touched: Mask, normals: Array, blocks: Array, most: int) -> SpringChange | None:
        """The change to ``blocks``; None where it needs more than ``most`` columns.

        ``touched (c,)``: springs to be pushed along ``normals (c, 3)`` although they may not differ.
        """
        if self.blocks is None:
            return None
        frames = self._bodies.frames  # on a flat face only the last axis is stiff
        change = frames @ (blocks - self.blocks) @ frames.transpose(0, 2, 1)
        typical = max(float(np.abs(blocks).max()), float(np.abs(self.blocks).max()), 1e-300)
        wanted = np.abs(change).max(axis=2) > NOTABLE_CHANGE * typical
        wanted |= touched[:, None] & (np.abs(np.einsum("cij,cj->ci", frames, normals)) > 0.2)
        if not self._complete(wanted, most):
            return None
        return SpringChange(self, np.array(list(self.keys), dtype=int).reshape(-1, 2), frames, change,
                            0.1 * NOTABLE_CHANGE * typical)  # fmt: skip

    def displace_points(self, y: Array, closed: Mask) -> Array:
        """Displacements (c, 3) of the contact points by the half solution ``y (n, 1)``.

        Where only inner points are ``closed (c,)``, the others are taken to stay.
        """
        if not self.inner.any() or (closed & ~self.inner).any():
            return self._bodies.move_springs(self._factor.backward(y))[..., 0]
        x = self._factor.backward(y[self._factor.solver.last], True)
        return np.where(self.inner[:, None], self._bodies.move_springs(x, self._shares)[..., 0], 0.0)

    def add_to(self, y: Array, coefficients: Array) -> Array:
        """Half solutions ``y (n, r)`` with the columns added, ``coefficients (k, r)`` times."""
        y = y.copy()
        y[self.rows] += self.W[:, : len(coefficients)] @ coefficients.astype(np.float32)
        return y

    def _complete(self, wanted: Mask, most: int) -> bool:
        """Make the columns that are missing, unless they would be too many in all."""
        new = [key for key in zip(*map(np.ndarray.tolist, np.nonzero(wanted))) if key not in self.keys]
        costly = sum(not self.inner[point] for point, _ in (*self.keys, *new))
        if costly > most or len(self.keys) + len(new) > max(most, MAX_COLUMNS):
            return False
        for inner in (True, False):
            self._add([key for key in new if self.inner[key[0]] == inner], inner)
        return True

    def _add(self, new: list[tuple[int, int]], inner: bool) -> None:
        if not new:
            return
        self.keys.update({key: len(self.keys) + i for i, key in enumerate(new)})
        points, axes = np.array(new).T
        unit = np.zeros((len(self.inner), 3, len(new)))
        unit[points, :, np.arange(len(new))] = self._bodies.frames[points, axes]
        shares = self._shares if inner else None
        N = self._bodies.spread_forces(unit, shares)
        W = self._factor.forward(N, inner)
        at_points = self._bodies.move_springs(self._factor.backward(W, inner), shares)
        if inner:
            at_points[~self.inner] = 0.0
        elif not isinstance(self.rows, slice):
            self.W, self.rows = self._widen(self.W), slice(None)
        narrow = inner and isinstance(self.rows, slice)
        self.W = np.hstack([self.W, self._widen(W) if narrow else W.astype(np.float32)])
        self.P = self.W if self._factor.solver.transposed else np.hstack([self.P, N.astype(np.float32)])
        self.S = (self.P.T @ self.W).astype(float)
        self.at_points = np.concatenate([self.at_points, at_points], axis=2)

    def _widen(self, W: Array | Single) -> Single:
        """Columns (m, k) of the unknowns that are eliminated last, as those of all (n, k)."""
        out = np.zeros((self._unknowns, W.shape[1]), dtype=np.float32)
        out[self._factor.solver.last] = W
        return out


class SpringChange:
    """One set of changed springs: of all columns ``points (k,)`` and ``directions (k, 3)``; of those
    ``stiffer (j,)`` whose stiffness changed, ``D (j, j)``.

    ``keys (k, 2)``: point and axis of the columns; ``change (c, 3, 3)`` of stiffness in the points'
    ``frames``, N/mm, of which less than ``little`` is none.
    """

    def __init__(
        self, columns: SpringColumns, keys: Indices, frames: Array, change: Array, little: float
    ) -> None:
        self._columns, (self._points, axes) = columns, keys.T
        self._directions = frames[self._points, axes]
        self._stiffer = np.flatnonzero((np.abs(change[self._points]) > little).any(axis=(1, 2)))
        points, axes = self._points[self._stiffer], axes[self._stiffer]
        D = np.where(points[:, None] == points, change[points[:, None], axes[:, None], axes], 0.0)
        S = columns.S[np.ix_(self._stiffer, self._stiffer)]
        self._answer = D @ np.linalg.inv(np.eye(len(D)) + S @ D)

    def project(self, values: Array) -> Array:
        """Components (k, ...) along the springs of vectors (c, 3, ...) at the contact points."""
        return np.einsum("ki,ki...->k...", self._directions, values[self._points])

    def correct(self, y: Array) -> Array:
        """First halves of solutions (n, r) of the changed matrix from those ``y (n, r)`` of the factor."""
        if not len(self._stiffer):
            return y
        moved = (self._columns.P.T @ y[self._columns.rows].astype(np.float32))[self._stiffer]
        coefficients = np.zeros((len(self._points), y.shape[1]))
        coefficients[self._stiffer] = -(self._answer @ moved)
        return self._columns.add_to(y, coefficients)

    def coefficients(self, moved: Array, forces: Array) -> Array:
        """What to add (k,) of each column, for displacements of the factor's solution and forces (c, 3)."""
        out = self.project(forces)
        at = self._stiffer
        out[at] -= self._answer @ (self.project(moved) + self._columns.S @ out)[at]
        return out

    def combine_at_points(self, coefficients: Array) -> Array:
        """The combination of columns at the contact points (c, 3)."""
        return self._columns.at_points @ coefficients
