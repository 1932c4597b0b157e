"""Linear solvers are peers: the same answer from each that works here, and a refusal where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from blocks import drive, punch

from limbfit.bench.timing import build_punched_block
from limbfit.fe import Problem, StepControl, Support, System, solve
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.memory import Memory
from limbfit.fe.solution.factor import Factor, find_touched_unknowns
from limbfit.fe.solution.linear import (
    SOLVERS,
    WITHOUT_PARDISO,
    LinearSolver,
    NotPositiveDefiniteError,
    build_linear_solver,
    multiply_symmetric,
)
from limbfit.fe.solution.multigrid import Multigrid
from limbfit.fe.solution.simulation import SteppedRun


def system(n: int = 200) -> tuple[sp.csr_matrix, np.ndarray]:
    rng = np.random.default_rng(0)
    A = sp.random(n, n, 0.05, random_state=1, format="csr")
    A = A @ A.T + sp.identity(n)
    return A.tocsr(), rng.normal(size=(n, 3))


def upper(A: sp.csr_matrix) -> sp.csr_matrix:
    U = sp.triu(A, format="csr")
    U.sort_indices()
    return U


def solver_of(U: sp.csr_matrix, name: str, **how: object) -> LinearSolver:
    """The named solver, if there is one here."""
    try:
        return build_linear_solver(U.indptr, U.indices, name, **how)
    except (ImportError, OSError):
        pytest.skip(f"{name} is not installed")


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_peers_solve_alike(name):
    A, b = system()
    U = upper(A)
    solver = solver_of(U, name)
    for scale in (1.0, 3.0):
        solver.factorise(scale * U.data)
        np.testing.assert_allclose(solver.solve(b), np.linalg.solve(scale * A.toarray(), b), atol=1e-9)
    np.testing.assert_allclose(solver.solve(b[:, 0]), np.linalg.solve(3 * A.toarray(), b[:, 0]), atol=1e-9)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_halves_of_solutions_make_the_whole_and_those_among_the_last_unknowns_are_theirs(name, threads):
    A, b = system()
    U = upper(A)
    wanted = np.array([3, 50, 51, 120, 198, 199], dtype=np.int32)
    solver = solver_of(U, name, threads=threads, last=wanted)
    solver.factorise(U.data)
    inverse = np.linalg.inv(A.toarray())
    half = solver.forward(b)
    np.testing.assert_allclose(solver.backward(half), inverse @ b, atol=1e-9)
    N = np.eye(len(b))[:, wanted]
    W = solver.forward(N)
    P = W if solver.transposed else N
    np.testing.assert_allclose(P.T @ half, inverse[wanted] @ b, atol=1e-9)
    if len(solver.last):
        np.testing.assert_allclose(solver.backward(half[wanted], True), inverse[wanted] @ b, atol=1e-9)
        many = np.tile(np.eye(len(wanted)), 7)  # in more than one go
        np.testing.assert_allclose(solver.forward(many, True), np.tile(W[wanted], 7), atol=1e-9)
        assert np.abs(np.delete(W, wanted, axis=0)).max() == 0.0


def at_rest(problem: Problem, advance: float = 0.0) -> tuple[System, Laws, np.ndarray]:
    """The undeformed system, its laws and its tangent under an indenter that has gone ``advance`` mm."""
    system, laws = System(problem), problem.build_laws()
    increment = Memory.rest(system, laws).build_increment(
        system, laws, 0.1, 0.1, advance, 100.0 * laws.modulus, drive(advance)
    )
    return system, laws, system.evaluate(np.zeros_like(system.points), laws, increment).tangent


def test_springs_under_the_indenter_and_beside_it_are_taken_in_exactly():
    problem = build_punched_block("tet10", 6)
    system, laws, data = at_rest(problem)
    bodies, stiff = system.bodies, 50.0 * laws.modulus
    last = find_touched_unknowns(system, problem)
    factor = Factor(system, laws.moduli, last=last)
    if not factor.solver.transposed:
        pytest.skip("the factor of this machine knows no halves")
    inner = factor.columns.inner
    assert 0 < len(last) < system.unknowns / 5
    assert inner.any()
    assert not inner.all()
    factor.factorise(data, np.zeros((bodies.count, 3, 3)))
    b = np.random.default_rng(0).normal(size=(system.unknowns, 2))
    for picked in (np.flatnonzero(inner)[:9], np.r_[np.flatnonzero(~inner)[:4], np.flatnonzero(inner)[3:9]]):
        blocks = np.zeros((bodies.count, 3, 3))
        blocks[picked] = stiff * np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 3.0]])
        changed = bodies.with_springs(data, blocks)
        normals = np.tile([0.0, 0.0, 1.0], (bodies.count, 1))
        springs = factor.change_springs(blocks.any(axis=(1, 2)), normals, blocks)
        x = factor.precondition(b, springs)
        assert np.linalg.norm(factor.multiply(changed, x) - b) <= 1e-3 * np.linalg.norm(b)
        assert np.linalg.norm(factor.multiply(changed, factor.apply(b)) - b) > 0.1 * np.linalg.norm(b)


def test_springs_on_held_nodes_are_no_columns_of_unknowns_that_go_last():
    """They have no unknowns at all, so they would stand on an empty set of them."""
    problem = punch("tet10", 2, 1)
    held = np.union1d(problem.fixed, problem.contact_faces[0])
    system = System(replace(problem, fixed=held))
    factor = Factor(system, problem.build_laws().moduli)
    assert not len(factor.solver.last)
    assert not factor.columns.inner.any()
    assert len(factor.columns.W) == system.unknowns


@pytest.mark.parametrize("name", ["pardiso", "cholmod"])
def test_cholesky_notices_an_indefinite_matrix(name):
    A, _ = system()
    U = upper((A - 5.0 * sp.identity(A.shape[0])).tocsr())
    solver = solver_of(U, name)
    with pytest.raises(NotPositiveDefiniteError):
        solver.factorise(U.data)


@pytest.mark.parametrize("columns", [1, 2, 7, 8, 9, 16, 17])
def test_symmetric_product(columns):
    A, _ = system()
    U, x = upper(A), np.random.default_rng(columns).normal(size=(A.shape[0], columns))
    for threads in (1, 2):
        found = multiply_symmetric(U.indptr, U.indices, U.data, x, threads)
        np.testing.assert_allclose(found, A @ x, rtol=1e-12, atol=1e-12 * np.abs(A @ x).max())
        assert found.flags.c_contiguous


def test_a_tangent_with_negative_eigenvalues_is_solved_all_the_same():
    """As at an unstable equilibrium, where conjugate gradients end early."""
    system, laws, data = at_rest(punch("tet10", 4, 1), 0.1)
    factor = Factor(system, laws.moduli)
    factor.factorise(data)
    data[system.indptr[:40]] *= -1.0
    b = np.random.default_rng(0).standard_normal((system.unknowns, 2))
    assert not factor.solve(data, b, None, 1e-6).convex
    x = factor.solve_indefinite(data, b, 1e-6, np.zeros_like(b))
    off = np.linalg.norm(b - factor.multiply(data, x), axis=0)
    assert (off <= 1e-6 * np.linalg.norm(b, axis=0)).all()
    assert factor.counts["inexact"] == 0


def test_a_deep_first_step_does_not_cost_the_single_precision():
    """Stiff contact deep inside makes the first tangent indefinite, which says nothing of the digits."""
    run = SteppedRun(build_punched_block("tet10", 6), StepControl(), False, None)
    next(run.run())
    assert run.factor.counts["double_precision"] == 0


def iterations(divisions: int) -> int:
    """Of conjugate gradients with multigrid, to a thousandth, on a block at rest."""
    system, laws, data = at_rest(build_punched_block("tet10", divisions))
    factor = Factor(system, laws.moduli, "multigrid")
    factor.factorise(data)
    b = system.bodies.spread_forces(np.ones((system.bodies.first_body.surface.areas.size, 3, 1)))
    found = factor.solve(data, b, None, 1e-3)
    assert found.converged
    assert np.linalg.norm(b - factor.multiply(data, found.x)) <= 1.1e-3 * np.linalg.norm(b)
    return factor.counts["half_solves"] // 2


def test_iterations_with_multigrid_do_not_grow_with_the_mesh():
    coarse = iterations(4)
    assert coarse <= 45
    assert iterations(8) <= 1.3 * coarse


def test_multigrid_is_symmetric_and_positive():
    """Or conjugate gradients would not do; also with single components held."""
    problem = build_punched_block("tet10", 5)
    sides = np.flatnonzero(problem.mesh.points[:, 0] <= -30.0)
    system, _, data = at_rest(replace(problem, supports=(Support(sides, 0),)))
    multigrid = Multigrid(system)
    multigrid.factorise(data)
    v, w = np.random.default_rng(0).standard_normal((2, system.unknowns))
    assert v @ multigrid.solve(w) == pytest.approx(w @ multigrid.solve(v), rel=1e-4)
    assert v @ multigrid.solve(v) > 0.0


def test_where_multigrid_does_not_converge_a_factor_takes_over():
    """As with a bulk modulus a million times the shear modulus."""
    problem = build_punched_block("tet10", 4)
    stiff = {name: replace(m, kappa_ratio=1e6) for name, m in problem.materials.items()}
    system, laws, data = at_rest(problem.with_materials(stiff))
    factor = Factor(system, laws.moduli, "multigrid")
    factor.factorise(data)
    b = np.random.default_rng(0).standard_normal((system.unknowns, 1))
    short = factor.solve(data, b, None, 1e-6)
    assert short.convex
    assert not short.converged
    assert factor.refactor_and_solve(data, b, None, 1e-6, short.x).converged
    assert factor.is_lasting


def test_where_factors_are_dear_multigrid_takes_their_place(monkeypatch):
    """Derivatives too; forces are those of a factor within the tolerance."""
    problem, control = punch("tet10", 2, 1), StepControl(load_steps=4, unload_steps=2)
    usual = solve(problem, control, sensitivities=True)
    monkeypatch.setenv(WITHOUT_PARDISO, "1")
    monkeypatch.delitem(SOLVERS, "cholmod")
    found = solve(problem, control, sensitivities=True)
    assert found.completed
    assert found.statistics["linear_solver"] == "multigrid"
    assert found.statistics["factorisations"] == 0
    np.testing.assert_allclose(found.force, usual.force, atol=1e-4 * usual.peak_force)
    largest = np.abs(usual.force_sensitivity).max(axis=0)
    assert (np.abs(found.force_sensitivity - usual.force_sensitivity).max(axis=0) <= 1e-3 * largest).all()
