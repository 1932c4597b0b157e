"""Elements: rigid motion, patch test, order of interpolation, symmetric tangent, the energy's derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import block, untouched
from numba import typeof

from limbfit.fe import ELEMENTS, OgdenQLV, Problem, Support, System
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.observables import compute_element_fields
from limbfit.fe.solution.control import StepControl
from limbfit.fe.solution.stepping import iterate
from limbfit.fe.system import Increment

NAMES = sorted(ELEMENTS)
TISSUE = OgdenQLV(0.005, 4.8, 3.6, 0.3)
LINES = np.linspace(0.0, 4.0, 4)


def body(name: str, fixed=None, supports=(), jitter: float = 0.25, lines=LINES) -> Problem:
    mesh = block(ELEMENTS[name].cell_type, lines, lines, lines, jitter=jitter)
    fixed = mesh.node_sets["bottom"] if fixed is None else fixed
    return untouched(mesh, TISSUE, fixed=fixed, supports=supports, element=name)


def prepared(name: str) -> tuple[System, Laws, Increment]:
    problem = body(name)
    system, laws = System(problem), problem.build_laws()
    history = 1e-3 * np.random.default_rng(3).normal(size=(*system.weights.shape, 6))
    return system, laws, Increment(0.0, 0.0, np.array([2.5, 2.5]), history, 1.0)


def full(system: System, data: np.ndarray) -> np.ndarray:
    K = np.zeros((system.unknowns, system.unknowns))
    for i in range(system.unknowns):
        row = slice(system.indptr[i], system.indptr[i + 1])
        K[i, system.indices[row]] = data[row]
    return K + np.triu(K, 1).T


def rotation(seed: int) -> np.ndarray:
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def test_kernels_are_compiled_once_for_all_elements_with_and_without_prestretch():
    """Each memory layout of an array would be compiled anew, which takes ten seconds and more."""
    problems = [replace(body(name), prestretch=G) for name in NAMES for G in (None, np.diag([1.1, 1.0, 0.9]))]
    assert len({typeof(System(problem).elements(slice(None))) for problem in problems}) == 1


@pytest.mark.parametrize("name", NAMES)
def test_rigid_motion_leaves_no_force(name):
    system, laws, increment = prepared(name)
    at_rest = Increment(0.0, 0.0, increment.scale, np.zeros_like(increment.history), 1.0)
    X = system.points
    at = system.evaluate(X @ rotation(0).T + [3.0, -2.0, 5.0] - X, laws, at_rest)
    strained = system.evaluate(0.1 * X, laws, at_rest)
    assert np.abs(at.residual).max() < 1e-12 * np.abs(strained.residual).max() + 1e-14
    assert abs(at.energy) < 1e-12 * strained.energy


@pytest.mark.parametrize("name", NAMES)
def test_residual_turns_with_the_body(name):
    system, laws, increment = prepared(name)
    X, Q = system.points, rotation(1)
    u = 0.03 * np.random.default_rng(2).normal(size=X.shape)
    plain = system.evaluate(u, laws, increment)
    turned = system.evaluate((X + u) @ Q.T - X, laws, increment)
    np.testing.assert_allclose(
        turned.residual, plain.residual @ Q.T, atol=1e-11 * np.abs(plain.residual).max()
    )
    assert turned.energy == pytest.approx(plain.energy, rel=1e-11)


@pytest.mark.parametrize("rest", [True, False], ids=["rest", "random"])
@pytest.mark.parametrize("name", NAMES)
def test_residual_and_tangent_are_derivatives_of_the_energy(name, rest):
    system, laws, increment = prepared(name)
    rng = np.random.default_rng(4)
    u = np.zeros_like(system.points) if rest else 0.03 * rng.normal(size=system.points.shape)
    d = rng.normal(size=u.shape)
    d.ravel()[np.setdiff1d(np.arange(d.size), system.free)] = 0.0
    h = 1e-5
    here = system.evaluate(u, laws, increment)
    ahead, back = (system.evaluate(u + s * h * d, laws, increment) for s in (1, -1))
    work, size = (here.residual * d).sum(), np.abs(here.residual * d).sum()
    assert (ahead.energy - back.energy) / (2 * h) == pytest.approx(work, abs=1e-7 * size)
    change = ((ahead.residual - back.residual) / (2 * h)).ravel()[system.free]
    product = full(system, here.data) @ d.ravel()[system.free]
    np.testing.assert_allclose(product, change, atol=1e-7 * np.abs(change).max())


@pytest.mark.parametrize("name", NAMES)
def test_patch(name):
    """A boundary that moves affinely moves every node affinely, at one stress, on a distorted mesh."""
    gradient = np.array([[0.9, 0.1, 0.0], [0.0, 1.05, 0.1], [0.05, 0.0, 1.02]]) - np.eye(3)
    mesh = body(name).mesh
    X = mesh.points
    edge = np.flatnonzero((X <= 1e-9).any(axis=1) | (X >= 4.0 - 1e-9).any(axis=1))
    target = X @ gradient.T
    supports = tuple(Support(np.array([n]), i, target[n, i]) for n in edge for i in range(3))
    problem = body(name, (), supports)
    run = list(iterate(problem, StepControl(times=(0.5, 1.0), tolerance=1e-9)))
    np.testing.assert_allclose(run[-1].state.u, target, atol=1e-8)
    fields = compute_element_fields(System(problem), problem.build_laws(), run[-1].state)
    spread = fields.cauchy - fields.cauchy.mean(axis=0)
    assert np.abs(spread).max() < 1e-7 * np.abs(fields.cauchy).max()
    np.testing.assert_allclose(fields.J, np.linalg.det(gradient + np.eye(3)), rtol=1e-8)


def bending(X: np.ndarray) -> np.ndarray:
    """A smooth, curved displacement of the unit cube, mm."""
    x, y, z = X.T
    return 0.05 * np.column_stack([np.sin(2 * y + z), np.sin(2 * z + x), np.sin(2 * x + y)])


@pytest.mark.parametrize(("name", "order"), [("tet4", 1), ("tet10", 2), ("hex8", 1)])
def test_interpolated_energy_converges(name, order):
    """The energy of an interpolated smooth field converges at twice the order of its gradient."""
    laws = Laws.build([TISSUE, TISSUE])
    energies = []
    for n in (2, 4, 8) if order == 2 else (4, 8, 16):
        lines = np.linspace(0.0, 1.0, n + 1)
        system = System(body(name, lines=lines, jitter=0.0))
        rest = Increment(0.0, 0.0, np.ones(2), np.zeros((*system.weights.shape, 6)), 1.0)
        energies.append(system.evaluate(bending(system.points), laws, rest).energy)
    changes = np.abs(np.diff(energies))
    assert np.log2(changes[-2] / changes[-1]) > 2 * order - 0.35
