"""Pressure and shear of rigid bodies on the tissue, and that they balance what is stated."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import COARSE_Z, FINE_Z, punch

from limbfit.fe import History, Indenter, Motion, RigidBody, StepControl, solve
from limbfit.fe.observables import compute_contact_pressure, compute_nodal_forces
from limbfit.fe.tractions import compute_tractions


@pytest.mark.parametrize(
    ("friction", "n", "z"), [(0.3, 3, COARSE_Z), pytest.param("sticky", 4, FINE_Z, marks=pytest.mark.slow)]
)
def test_tractions_balance_the_forces_and_moments_that_are_stated(friction, n, z):
    """A ball pressed and dragged by forces, its turns free but one: at every step, and on the supports."""
    ball = Indenter("sphere", 24.0, centre=(1.0, 2.0, 0.3), axis=(0.1, 0.0, -1.0))
    force = {"z": [0.0, 3.0, 3.0], "x": [0.0, 0.0, 0.4], "turn_x": 0.0, "turn_y": [0.0, 0.0, 2.0]}
    plain = punch("tet10", n, 1, z=z)
    body = RigidBody(
        ball, plain.contact_faces, Motion.of([0.0, 1.0, 2.0], force=force), friction, pivot=(0, 0, 5)
    )
    still = History(np.array([0.0, 2.0]), np.zeros(2))
    problem = replace(plain, indenter=None, bodies=(body,), history=still)
    found = solve(problem, StepControl(times=(0.5, 1.0, 1.5, 2.0), penalty=200.0), store="all")
    assert found.completed, found.reason
    assert found.imbalance.shape == (5, 1)
    assert (found.imbalance[1:] < 1e-3).all()
    state, laws = found.states[-1], problem.build_laws()
    on = compute_tractions(found.system, laws, state)
    frame = ball.frame
    np.testing.assert_allclose(frame @ on.force, found.reactions[-1, 0, :3], atol=1e-6)
    np.testing.assert_allclose(frame @ on.force, [0.4, found.reactions[-1, 0, 1], 3.0], atol=3e-3)
    pivot = np.array([0.0, 0.0, 5.0]) + found.coordinates[-1, 0, :3] @ frame
    np.testing.assert_allclose((frame @ on.moment(pivot))[:2], [0.0, 2.0], atol=0.03)
    total = 1e-3 * ((on.pressure_kPa[..., None] * on.normals + on.shear_kPa) * on.areas[..., None])
    np.testing.assert_allclose(total.sum(axis=(0, 1)), on.force, atol=1e-9)
    assert (on.pressure_kPa > -1e-9).all()
    slides = np.linalg.norm(on.shear_kPa, axis=-1)
    if friction == 0.3:
        assert (slides <= 0.3 * 1.001 * on.pressure_kPa + 1e-6).all()
    assert slides.max() > 0.1 * on.pressure_kPa.max()
    held = compute_nodal_forces(found.system, laws, state)[problem.fixed].sum(axis=0)
    np.testing.assert_allclose(held, -on.force, atol=3e-3)
    pressure, shear = on.average_at_nodes(len(problem.mesh.points))
    assert shear.shape == (len(pressure), 3)
    old = 1e3 * compute_contact_pressure(found.system, laws, state)
    assert pressure.max() == pytest.approx(old.max(), rel=0.25)
    assert 0.0 < on.contact_area < 450.0
