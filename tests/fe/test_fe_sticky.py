"""Sticky contact: no slip once in touch, derivatives, release, and what sticking does to the force."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import block, check_derivatives, check_sensitivities, drive, punch, symmetry

from limbfit.fe import History, Indenter, NeoHookean, Problem, StepControl, System, iterate, solve
from limbfit.fe.contact.friction import Anchors
from limbfit.fe.system import Increment


@pytest.mark.parametrize("rule", ["nodes", "gauss"])
def test_forces_and_stiffness_of_anchors_are_derivatives_of_their_energy(rule):
    tool = Indenter("sphere", 20.0, centre=(0.3, -0.4, 0.4), axis=(0.1, 0.05, -1.0))
    problem = punch("tet10", 4, 1, indenter=tool, contact_rule=rule, start="as-given", friction="sticky")
    system, laws = System(problem), problem.build_laws()
    rest, rng, h = np.zeros((*system.weights.shape, 6)), np.random.default_rng(1), 1e-6
    u = 0.01 * rng.normal(size=system.points.shape) * ~system.supported
    d = rng.normal(size=u.shape) * ~system.supported
    anchors = Anchors.begin(system.bodies.first_body.surface).advance(
        system.bodies.tools(u, drive(1.6))[0], None
    )
    assert anchors.held.sum() > 4

    def at(u, advance):
        return system.evaluate(
            u, laws, Increment(0.0, advance, np.zeros(2), rest, 0.5, drive(advance), (anchors,))
        )

    u = u + 0.1 * d
    here, _ = check_derivatives(system, lambda u: at(u, 1.7), u, d)
    rise = (at(u, 1.7 + h).energy - at(u, 1.7 - h).energy) / (2 * h)
    assert rise == pytest.approx(here.force, rel=1e-5)


def test_anchors_neither_push_nor_pull_along_the_normal():
    """Points drawn straight off a flat face: no force is left, however far they were held before."""
    problem = punch("tet10", 4, 1, friction="sticky")
    system, laws = System(problem), problem.build_laws()
    rest, u = np.zeros((*system.weights.shape, 6)), np.zeros_like(system.points)
    anchors = Anchors.begin(system.bodies.first_body.surface).advance(
        system.bodies.tools(u, drive(0.5))[0], None
    )
    at = system.evaluate(u, laws, Increment(0.0, -0.5, np.zeros(2), rest, 0.5, drive(-0.5), (anchors,)))
    assert anchors.held.any()
    assert at.force == 0.0
    assert np.abs(at.touch.blocks).max() > 0.0
    np.testing.assert_allclose(at.touch.stick, at.touch.blocks, atol=1e-12)
    np.testing.assert_allclose(at.residual, 0.0, atol=1e-12)


def slip_and_force(friction: str) -> tuple[float, np.ndarray]:
    """How far pressed points move across the axis of a ball from step to step, mm at most; the forces."""
    tool = Indenter("sphere", 40.0, centre=(0.0, 0.0, 1.0))
    problem = punch("hex8", 2, 1, friction=friction, indenter=tool, contact_rule="nodes")
    system = System(problem)
    nodes = system.bodies.first_body.surface.faces[:, 0]
    slip, forces, pressed, u = 0.0, [], np.zeros(len(nodes), dtype=bool), np.zeros_like(system.points)
    for step in iterate(problem, StepControl(load_steps=5, unload_steps=4)):
        gaps = system.bodies.tools(step.state.u, step.state.drives)[0].gaps[:, 0]
        now = gaps < -0.1 * step.penetration
        moved = np.linalg.norm((step.state.u - u)[nodes, :2], axis=1)
        slip = max(slip, moved[pressed & now].max(initial=0.0))
        forces.append(step.force)
        pressed, u = now, step.state.u
    return slip, np.array(forces)


def test_what_touches_does_not_slip_and_lets_go_at_the_end():
    slip, free = slip_and_force("frictionless")
    left, stuck = slip_and_force("sticky")
    assert left < 0.05 * slip
    assert stuck.max() > 1.02 * free.max()
    assert stuck[-1] == 0.0


@pytest.mark.parametrize(
    ("shape", "element"), [pytest.param("square", "tet4", marks=pytest.mark.slow), ("sphere", "tet10")]
)
def test_sensitivities_of_sticky_contact_equal_central_differences(shape, element):
    """Along one direction in the space of all eight parameters."""
    tight = StepControl(load_steps=3, unload_steps=2, tolerance=1e-10)
    tool = Indenter(shape, 30.0, 2.0 * (shape == "square"), axis=(0.05, 0.02, -1.0), centre=(0, 0, 3.0))
    problem = punch(element, 2, 1, indenter=tool, friction="sticky")
    check_sensitivities(problem, tight, 1e-4)


def stiffening(nu: float) -> float:
    """How much sticking adds to the force on a flat round punch, 10 mm wide, on a large elastic block."""
    lines = np.concatenate([np.arange(0.0, 6.1, 1.25), [9.0, 14.0, 24.0, 45.0]])
    mesh = block("tet10", lines, lines, -lines[::-1])
    law = NeoHookean(0.01, kappa_ratio=2.0 * (1.0 + nu) / (3.0 * (1.0 - 2.0 * nu)))
    tool = Indenter("cylinder", 10.0, centre=(0.0, 0.0, 1.0))
    push = History(np.array([0.0, 1.0]), np.array([0.0, 0.02]))
    problem = Problem(
        mesh, {"skin": law, "muscle": law}, mesh.node_sets["bottom"], mesh.face_sets["top"], tool, push,
        supports=symmetry(mesh),
    )  # fmt: skip
    control = StepControl(times=(0.01, 1.0))
    free, stuck = (solve(replace(problem, friction=name), control) for name in ("frictionless", "sticky"))
    assert stuck.completed
    return stuck.peak_force / free.peak_force


@pytest.mark.slow
@pytest.mark.parametrize("nu", [0.0, 0.4995])
def test_sticking_stiffens_a_flat_punch_as_in_theory(nu):
    """Spence (1968): ``F_stuck / F_free = (1 - nu) ln(3 - 4 nu) / (1 - 2 nu)``, 1.099 at 0 and 1 at 1/2."""
    theory = (1.0 - nu) * np.log(3.0 - 4.0 * nu) / (1.0 - 2.0 * nu)
    assert stiffening(nu) == pytest.approx(theory, abs=0.01)
