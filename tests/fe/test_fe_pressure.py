"""Follower pressure: its derivatives, tubes and spheres in closed form, and a tube of FEBio."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import block, boundary, check_sensitivities, punch, sector, untouched
from scipy.integrate import quad
from scipy.optimize import brentq

from limbfit.errors import ProblemError
from limbfit.fe import (
    ELEMENTS,
    History,
    NeoHookean,
    OgdenQLV,
    Pressure,
    StepControl,
    Support,
    System,
    solve,
)
from limbfit.fe.kernel.laws import Laws
from limbfit.fe.observables import compute_nodal_forces
from limbfit.fe.pressure import PressedSurface
from limbfit.fe.solution.linear import multiply_symmetric
from limbfit.fe.system import Increment
from limbfit.mesh import Mesh

STILL = History(np.array([0.0, 1.0]), np.zeros(2))


@pytest.mark.parametrize("cell_type", ["tet4", "tet10", "hex8"])
def test_volume_forces_and_their_derivatives(cell_type):
    lines = np.linspace(0.0, 1.0, 3)
    mesh = block(cell_type, lines, lines, lines, jitter=0.05)
    pressed = PressedSurface(ELEMENTS[cell_type], mesh.points, boundary(mesh.cells, cell_type))
    volume, gradient, forces = pressed.volume(mesh.points)
    assert volume == pytest.approx(1.0, rel=1e-12)
    np.testing.assert_allclose(gradient, forces, atol=1e-12)  # nothing differs where there is no rim
    top = PressedSurface(ELEMENTS[cell_type], mesh.points, mesh.face_sets["top"])
    rng, h = np.random.default_rng(0), 1e-5
    x = mesh.points + 0.05 * rng.normal(size=mesh.points.shape)
    d = rng.normal(size=x.shape)
    here, ahead, back = (top.volume(x + step * d) for step in (0.0, h, -h))
    assert (ahead[0] - back[0]) / (2 * h) == pytest.approx((here[1] * d).sum(), rel=1e-8)
    hessian, slope = (top.matrix(blocks, len(x)) @ d.ravel() for blocks in (top.hessian(x), top.slope(x)))
    np.testing.assert_allclose(hessian, ((ahead[1] - back[1]) / (2 * h)).ravel(), atol=1e-9)
    np.testing.assert_allclose(slope, ((ahead[2] - back[2]) / (2 * h)).ravel(), atol=1e-9)
    assert np.abs(slope - hessian).max() > 1e-3


def test_forces_and_tangent_of_a_pressed_block_are_derivatives_of_its_energy():
    problem = punch("tet10", 4, 1, indenter=None)
    pressures = (Pressure(problem.contact_faces, [0.0, 1.0], [0.0, 0.004]),)
    system, laws = System(replace(problem, pressures=pressures)), problem.build_laws()
    rng, h = np.random.default_rng(1), 1e-6
    u, d = (size * rng.normal(size=system.points.shape) * ~system.supported for size in (0.05, 1.0))
    rest, rims = np.zeros((*system.weights.shape, 6)), system.pressures.compute_rims(u, (0.004,))

    def at(u):
        return system.evaluate(
            u, laws, Increment(0.0, 0.0, np.zeros(2), rest, 0.5, pressures=(0.004,), rims=rims)
        )

    here, ahead, back = at(u), at(u + h * d), at(u - h * d)
    assert (ahead.energy - back.energy) / (2 * h) == pytest.approx((here.residual * d).sum(), rel=1e-5)
    K_d = multiply_symmetric(system.indptr, system.indices, here.data, d.reshape(-1, 1)[system.free])
    change = ((ahead.residual - back.residual) / (2 * h)).reshape(-1, 1)[system.free]
    np.testing.assert_allclose(K_d, change, atol=1e-6 * np.abs(change).max())
    pressed = system.pressures.all[0].volume(system.points + u)[2]
    np.testing.assert_allclose(here.residual - at_without(system, laws, u), 0.004 * pressed, atol=1e-12)


def at_without(system: System, laws: Laws, u: np.ndarray) -> np.ndarray:
    """The residual at ``u`` without a pressure."""
    rest = np.zeros((*system.weights.shape, 6))
    return system.evaluate(u, laws, Increment(0.0, 0.0, np.zeros(2), rest, 0.5)).residual


def held(mesh: Mesh) -> tuple[Support, ...]:
    sets = mesh.node_sets
    return Support(sets["y0"], 1), Support(sets["x0"], 0), Support(sets["ends"], 2)


@pytest.mark.parametrize("law", [NeoHookean(0.01, kappa_ratio=1e4), OgdenQLV(0.01, 6.0, 0.0, 1.0, 1e4)])
def test_inflation_of_a_tube_is_the_closed_form(law):
    """Plane strain, incompressible: ``p = int (sigma_tt - sigma_rr) / r dr``, within 0.5 %.

    The difference is ``mu (k^2 - k^-2)`` of the stretch k around for the neo-Hookean tube, and
    ``2 c / m (k^m - k^-m)`` for Ogden's.
    """
    a, b, mu = 10.0, 20.0, 0.01

    def pressure(inner: float) -> float:
        """At the inner radius ``inner``."""
        grown = inner**2 - a**2

        def density(r: float) -> float:
            around = r / np.sqrt(r**2 - grown)  # stretch, of an incompressible tube
            if isinstance(law, OgdenQLV):
                return 2.0 * law.c / law.m * (around**law.m - around**-law.m) / r
            return mu * (around**2 - around**-2) / r

        return quad(density, inner, np.sqrt(b**2 + grown))[0]

    p = 0.5 * mu
    expected = brentq(lambda inner: pressure(inner) - p, a, 3 * a)
    mesh = sector(np.linspace(a, b, 11), 12)
    pressures = (Pressure(mesh.face_sets["inside"], [0.0, 1.0], [0.0, p]),)
    problem = untouched(mesh, law, STILL, supports=held(mesh), pressures=pressures)
    found = solve(problem, StepControl(times=(0.25, 0.5, 0.75, 1.0), tolerance=1e-7), store="all")
    assert found.completed, found.reason
    inner = np.unique(mesh.face_sets["inside"])
    radius = np.linalg.norm((mesh.points + found.states[-1].u)[inner, :2], axis=1)
    assert expected > 1.2 * a
    np.testing.assert_allclose(radius - a, expected - a, rtol=0.005)


def test_derivatives_of_the_force_beside_a_pressure_with_a_free_rim():
    """An indenter on a half-pressed surface: its force by sensitivities and by central differences."""
    problem = punch("hex8", 2, 1, history=History(np.array([0.0, 2.0]), np.array([0.0, 2.0])))
    middle = problem.mesh.points[problem.contact_faces].mean(axis=1)
    pressed = problem.contact_faces[middle[:, 0] > 0.0]
    problem = replace(problem, pressures=(Pressure(pressed, [0.0, 2.0], [0.0, 0.004]),))
    control = StepControl(times=(0.7, 1.4, 2.0), tolerance=1e-9, penalty=200.0, hold_penalty=True)
    check_sensitivities(problem, control, 1e-3)


def test_a_pressure_that_stays_is_stepped_to_where_it_is_reached_and_leaves_no_force_at_free_nodes():
    problem = punch("hex8", 2, 1, indenter=None, history=History(np.array([0.0, 3.0]), np.zeros(2)))
    problem = replace(problem, pressures=(Pressure(problem.contact_faces, [0.0, 1.0], [0.0, 0.002]),))
    problem = replace(problem, contact_faces=problem.contact_faces[:0])
    found = solve(problem, StepControl(unload_steps=3))
    assert found.completed, found.reason
    assert np.isclose(found.times, 1.0).any()
    forces = compute_nodal_forces(found.system, problem.build_laws(), found.deepest)
    free = np.setdiff1d(np.arange(len(forces)), problem.fixed)
    assert np.abs(forces[free]).max() < 1e-3 * np.linalg.norm(forces[problem.fixed].sum(axis=0))


def test_a_pressure_that_cannot_be_is_refused():
    with pytest.raises(ProblemError, match="as many values"):
        Pressure(np.zeros((1, 6), int), [0.0, 1.0], [1.0])
    with pytest.raises(ProblemError, match="do not grow from 0"):
        Pressure(np.zeros((1, 6), int), [0.5, 1.0], [1.0, 1.0])
    flat = punch("hex8", 2, 1, pressures=(Pressure(np.zeros((1, 3), int), [0.0, 1.0], [0.0, 1.0]),))
    with pytest.raises(ProblemError, match="pressed faces have shape"):
        System(flat)
