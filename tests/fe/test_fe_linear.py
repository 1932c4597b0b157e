"""Linear solvers are peers: the same answer from each that works here, and a refusal where there is none."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from limbfit.fe.linear import SOLVERS, NotPositiveDefiniteError, linear_solver, symmetric_product


def system(n: int = 200) -> tuple[sp.csr_matrix, np.ndarray]:
    rng = np.random.default_rng(0)
    A = sp.random(n, n, 0.05, random_state=1, format="csr")
    A = A @ A.T + sp.identity(n)
    return A.tocsr(), rng.normal(size=(n, 3))


def upper(A: sp.csr_matrix) -> sp.csr_matrix:
    U = sp.triu(A, format="csr")
    U.sort_indices()
    return U


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_peers_solve_alike(name):
    A, b = system()
    U = upper(A)
    try:
        solver = linear_solver(U.indptr, U.indices, name)
    except (ImportError, OSError):
        pytest.skip(f"{name} is not installed")
    for scale in (1.0, 3.0):
        solver.factorise(scale * U.data)
        np.testing.assert_allclose(solver.solve(b), np.linalg.solve(scale * A.toarray(), b), atol=1e-9)
    np.testing.assert_allclose(solver.solve(b[:, 0]), np.linalg.solve(3 * A.toarray(), b[:, 0]), atol=1e-9)


@pytest.mark.parametrize("name", ["pardiso", "cholmod"])
def test_cholesky_notices_an_indefinite_matrix(name):
    A, _ = system()
    U = upper((A - 5.0 * sp.identity(A.shape[0])).tocsr())
    try:
        solver = linear_solver(U.indptr, U.indices, name)
    except (ImportError, OSError):
        pytest.skip(f"{name} is not installed")
    with pytest.raises(NotPositiveDefiniteError):
        solver.factorise(U.data)


def test_symmetric_product():
    A, b = system()
    U = upper(A)
    np.testing.assert_allclose(symmetric_product(U.indptr, U.indices, U.data, b), A @ b, rtol=1e-12)
