"""One factorisation, used as long as it pays, as the preconditioner of conjugate gradients; or multigrid.

The factor is in single precision, half the price; the iteration runs in double.  Contact changes are few
but stiff, and would spoil an old factor at once.  They are local springs, so the preconditioner takes them
in exactly, by the Sherman-Morrison-Woodbury formula (`springs`); only the slow change of the tissue's own
stiffness is left to the iteration.

The tangent of an unstable state is made positive definite, so that Newton's direction is of descent.  The
directions in which nearly incompressible tissue is unstable shear it: folds of a soft skin over a stiff
muscle. The stiffness added is therefore that of shear alone, a share of each tissue's own modulus; one that
is relative to the diagonal would be ruled by the bulk modulus, a hundred times larger, and stop what is
stable, too.
"""

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from ...arrays import Array
from ..bodies import GROUNDING_STIFFNESS
from ..system import System
from .linear import (
    NONE,
    Index,
    LinearSolver,
    NotPositiveDefiniteError,
    build_linear_solver,
    multiply_symmetric,
    prefers_multigrid,
)
from .multigrid import Multigrid
from .springs import SpringChange, SpringColumns

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
            self._solver: LinearSolver = Multigrid(system, threads)
        else:
            self._solver = build_linear_solver(
                system.indptr, system.indices, self._choice, threads, single, self._last
            )
        self._single = single
        self.columns = SpringColumns(self._system, self)
        self.counts["double_precision"] = int(not single)
        self.seconds["factor"] += time.perf_counter() - started

    @property
    def name(self) -> str:
        return self._solver.name

    @property
    def transposed(self) -> bool:
        return self._solver.transposed

    @property
    def last(self) -> Index:
        return self._solver.last

    @property
    def shifted(self) -> bool:
        """True if what was factorised last had to be stiffened."""
        return self._shift > 0.0

    @property
    def lasting(self) -> bool:
        """True if what was factorised is worth keeping for other matrices."""
        return self._solver.lasting

    @property
    def limit(self) -> int:
        """Products after which a new factorisation would have been cheaper."""
        return int(self._solver.worth) if self.lasting else MAX_CYCLES

    def is_worn(self) -> bool:
        """True if another step with this factor costs more than the steps since it was made did on average.

        The optimal time to replace a machine whose running cost rises (Barlow and Proschan 1965).
        """
        steps = self._costs
        return self.lasting and len(steps) > 1 and steps[-1] * len(steps) > self._solver.worth + sum(steps)

    def start_step(self) -> None:
        """From here the cost counts for another step."""
        if self._costs != [0.0]:  # a factor made between steps has served none yet
            self._costs.append(0.0)

    def factorise(self, data: Array, blocks: Array | None = None) -> None:
        """Factorise; a tangent that is not positive definite is shifted until it is.

        Raises `NotPositiveDefiniteError` where no shift helps: there are entries that are not finite.

        ``blocks (c, 3, 3)``: the contact springs that are in ``data``.
        """
        made = not self.ready and self.lasting and self._is_single_enough(data)
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
        self.counts["factorisations" if self.lasting else "multigrids"] += 1
        data = self.stiffen(data, shift) if shift else data
        if len(self._ground[0]):  # a body that touches nothing yet is held by nothing
            data = data.copy()
            data[self._ground[0]] += self._ground[1]
        try:
            self._solver.factorise(data)
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
        return self._timed(self._solver.solve, b, 1.0)

    def forward(self, b: Array, last: bool = False) -> Array:
        """The first half of `apply`, as in `Halves`."""
        return self._timed(lambda b: self._solver.forward(b, last), b, 0.0 if last else 0.5)

    def backward(self, y: Array, last: bool = False) -> Array:
        """The second half of `apply`, as in `Halves`."""
        return self._timed(lambda y: self._solver.backward(y, last), y, 0.0 if last else 0.5)

    def _timed(self, half: Callable[[Array], Array], b: Array, share: float) -> Array:
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

    def change_springs(
        self, touched: NDArray[np.bool_], normals: Array, blocks: Array
    ) -> SpringChange | None:
        """What springs that differ from the factor's do to its solutions; None: they are too many.

        ``touched (c,)``: springs that will be pushed although they may not differ.
        """
        return self.columns.change(touched, normals, blocks, int(6.0 * self._solver.worth))

    def solve(
        self, data: Array, b: Array, springs: SpringChange | None, tolerance: float,
        x: Array | None = None, limit: int | None = None,
    ) -> LinearSolution:  # fmt: skip
        """Solve ``A x = b (n, r)`` by conjugate gradients from the guess ``x``.

        Parameters
        ----------
        data : entries of A.
        springs : the contact springs in which A differs from the factor.
        tolerance : of the residual of each column, relative to ``b``.
        limit : of products; by default what a factorisation would have cost.
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
                return LinearSolution(x if x.any() else r, False, self.lasting)
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
        if not self.lasting:
            self._choice = "auto"
            self._replace_solver(single=True)
        self.factorise(data, blocks)
        found = self.solve(data, b, None, tolerance, x)
        if self._single and not self.shifted and found.convex and not found.converged:
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


def compute_body_stiffness(system: System, moduli: Array) -> tuple[NDArray[np.int32], Array]:
    """Diagonal entries of the coordinates that are free to move rigid bodies, and what holds those of bodies
    that touch nothing (k,), N/mm."""
    if not system.bodies.free:
        return np.zeros(0, dtype=np.int32), np.zeros(0)
    return system.indptr[-1 - system.bodies.free : -1], system.bodies.compute_grounding(
        float(np.mean(moduli))
    )
