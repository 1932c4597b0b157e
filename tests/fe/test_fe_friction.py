"""Coulomb friction: its law, its limits, derivatives, and what it does not do (creep)."""

from dataclasses import replace

import numpy as np
import pytest
from blocks import FINE_Z, block, check_derivatives, check_sensitivities, drive, punch

from limbfit.errors import ProblemError
from limbfit.fe import (
    History,
    Indenter,
    NeoHookean,
    OgdenQLV,
    Problem,
    StepControl,
    Support,
    System,
    solve,
)
from limbfit.fe.contact.friction import Coulomb
from limbfit.fe.contact.tool import Tool
from limbfit.fe.solution.simulation import SteppedRun
from limbfit.fe.system import Increment


class Dragged:
    """A punch that presses and is dragged: its system, and the potential of the step that follows."""

    def __init__(self, rule: str, shape: str = "sphere", mu: float = 0.3) -> None:
        tool = Indenter(shape, 20.0, 1.0, centre=(0.3, -0.4, 2.0), axis=(0.1, 0.05, -1.0))
        problem = punch("tet10", 4, 1, indenter=tool, contact_rule=rule, start="as-given", friction=mu)
        self.system, self.laws = System(problem), problem.build_laws()
        self.rest = np.zeros((*self.system.weights.shape, 6))
        self.rng = np.random.default_rng(1)
        self.u = self.field(0.01)
        start = self.system.bodies.tools(self.u, drive(3.2))[0]
        grip = Coulomb.begin(mu, self.system.bodies.first_body.surface).advance(start, None)
        self.u = self.u + self.field(0.05)
        self.grip = self.renew(grip, self.u)

    def field(self, size: float) -> np.ndarray:
        return size * self.rng.normal(size=self.system.points.shape) * ~self.system.supported

    def increment(self, advance: float, grip: Coulomb) -> Increment:
        return Increment(0.0, advance, np.zeros(2), self.rest, 0.5, drive(advance, 0.03, 0.02), (grip,))

    def renew(self, grip: Coulomb, u: np.ndarray) -> Coulomb:
        return grip.renew(self.tool(u))

    def tool(self, u: np.ndarray) -> Tool:
        return self.system.bodies.tools(u, drive(3.3, 0.03, 0.02))[0]

    def at(self, u: np.ndarray, advance: float = 3.3, grip: Coulomb | None = None):
        return self.system.evaluate(u, self.laws, self.increment(advance, grip or self.grip))


@pytest.mark.parametrize(("rule", "shape"), [("nodes", "sphere"), ("gauss", "square")])
def test_forces_and_stiffness_of_friction_are_derivatives_of_its_energy(rule, shape):
    one = Dragged(rule, shape)
    u, h = one.u, 1e-6
    here, _ = check_derivatives(one.system, one.at, u, one.field(1.0))
    free = one.at(u, grip=replace(one.grip, held=np.zeros_like(one.grip.held)))
    assert np.abs(here.residual - free.residual).max() > 0.01 * np.abs(free.residual).max()
    rise = (one.at(u, 3.3 + h).energy - one.at(u, 3.3 - h).energy) / (2 * h)
    assert rise == pytest.approx(here.force, rel=1e-5)


@pytest.mark.parametrize("mu", [0.05, 30.0])
def test_coupling_is_what_a_step_holds_constant(mu):
    """Contact forces with planes and bounds renewed at every displacement: springs and coupling together."""
    one = Dragged("gauss", mu=mu)
    system, u, h = one.system, one.u, 1e-6
    d = one.field(1.0)
    ahead, back = (
        system.contact_force(v, one.increment(3.3, one.renew(one.grip, v))) for v in (u + h * d, u - h * d)
    )
    change = ((ahead - back) / (2 * h)).reshape(-1, 1)[system.free]
    tool, bodies = one.tool(u), system.bodies
    coupling = (0.5 * tool.surface.areas)[..., None, None] * one.grip.coupling(tool)
    coupling = (tool.body.frame.T @ coupling @ tool.body.frame).reshape(-1, 3, 3)
    moved = bodies.move_springs(d.reshape(-1, 1)[system.free])
    lagged = bodies.spread_forces(coupling @ moved)
    assert np.abs(lagged).max() > (0.0 if mu > 1.0 else 0.02) * np.abs(change).max()  # little where all stick
    found = bodies.spread_forces(one.at(u).touch.blocks @ moved) + lagged
    np.testing.assert_allclose(found, change, atol=1e-5 * np.abs(change).max())


def dragged_block(mu: float | str, history: History) -> Problem:
    """A block of 20 x 20 x 10 mm under a plate that is wider than it will ever be dragged."""
    lines = np.linspace(0.0, 20.0, 5)
    mesh = block("hex8", lines, lines, np.linspace(-10.0, 0.0, 4))
    plate = Indenter("square", 60.0, centre=(10.0, 10.0, 0.0), axis=(0, 0, -1), edge=(1, 0, 0))
    material = NeoHookean(0.01)
    return Problem(
        mesh, {"skin": material, "muscle": material}, mesh.node_sets["bottom"], mesh.face_sets["top"], plate,
        history, friction=mu,
    )  # fmt: skip


PRESS_AND_DRAG = History(
    np.array([0.0, 1.0, 3.0]), np.array([0.0, 1.0, 1.0]), np.array([[0.0, 0.0], [0.0, 0.0], [8.0, 0.0]])
)
DRAG_TIMES = tuple(np.concatenate([np.linspace(0.25, 1.0, 4), np.linspace(1.2, 3.0, 10)]))


def test_at_full_slip_the_friction_is_mu_times_the_normal_force():
    mu = 0.5  # with 0.8 a block this soft rolls before it slips
    result = solve(dragged_block(mu, PRESS_AND_DRAG), StepControl(times=DRAG_TIMES))
    assert result.completed, result.reason
    assert not result.doubts
    across = np.linalg.norm(result.reaction[:, :2], axis=1)
    assert across[-1] == pytest.approx(mu * result.force[-1], rel=1e-3)
    assert (across <= mu * result.force * (1.0 + 1e-3)).all()
    np.testing.assert_allclose(result.reaction[:, 2], result.force)


def test_what_sticks_does_not_creep():
    """Half of what it takes to slip, held for 16 steps: the force across stays as it is."""
    history = History(
        np.array([0.0, 1.0, 2.0, 100.0]), np.array([0.0, 1.0, 1.0, 1.0]),
        np.array([[0.0, 0.0], [0.0, 0.0], [0.4, 0.0], [0.4, 0.0]]),
    )  # fmt: skip
    times = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, *np.linspace(10.0, 100.0, 16))
    result = solve(dragged_block(0.8, history), StepControl(times=times))
    assert result.completed, result.reason
    held = result.times >= 2.0
    force = result.reaction[held, 0]
    assert force[0] < 0.6 * 0.8 * result.force[-1]
    np.testing.assert_allclose(force, force[0], rtol=1e-3)


def test_stepwise_sticking_slips_on_by_a_like_share_in_every_step():
    """The law of FEBio: held for 12 steps, the force across falls by the share that the tissue has of the
    stiffness of tissue and contact in series, in every step the same; the steps' lengths do not matter."""
    history = History(
        np.array([0.0, 1.0, 2.0, 100.0]), np.array([0.0, 1.0, 1.0, 1.0]),
        np.array([[0.0, 0.0], [0.0, 0.0], [0.1, 0.0], [0.1, 0.0]]),
    )  # fmt: skip
    problem = replace(dragged_block(20.0, history), sticking="stepwise")
    times = (0.5, 1.0, 1.5, 2.0, *np.geomspace(4.0, 100.0, 12))
    result = solve(problem, StepControl(times=times, penalty=2.0, hold_penalty=True, penetration=1.0))
    assert result.completed, result.reason
    across = result.reaction[result.times >= 2.0, 0]
    shares = across[1:] / across[:-1]
    assert across[0] > 0.0
    assert 0.5 < shares[0] < 0.99
    np.testing.assert_allclose(shares, shares[-1], rtol=0.02)


def test_friction_lies_between_frictionless_and_sticky():
    """Without friction and with a very large coefficient it is what those two are."""
    tool = Indenter("sphere", 40.0, centre=(0.0, 0.0, 1.0))
    problem = punch("tet4", 2, 1, indenter=tool, depth=4.0)
    control = StepControl(load_steps=2, unload_steps=2)
    free, none, some, much, stuck = (
        solve(replace(problem, friction=friction), control).force
        for friction in ("frictionless", 1e-6, 0.3, 1e3, "sticky")
    )
    np.testing.assert_allclose(none, free, atol=1e-4 * free.max())
    np.testing.assert_allclose(much, stuck, atol=5e-3 * stuck.max())
    assert free.max() < some.max() < stuck.max()
    np.testing.assert_array_equal(solve(replace(problem, friction=0.0), control).force, free)


@pytest.mark.parametrize(
    ("shape", "mu", "element"),
    [pytest.param("square", 0.5, "tet4", marks=pytest.mark.slow), ("sphere", 0.1, "tet10")],
)
@pytest.mark.parametrize("sticking", ["anchored", pytest.param("stepwise", marks=pytest.mark.slow)])
def test_sensitivities_with_friction_equal_central_differences(shape, mu, element, sticking):
    """Along one direction in the space of all eight parameters, pressing, dragging and letting go."""
    tight = StepControl(load_steps=3, unload_steps=2, tolerance=1e-9)
    tool = Indenter(shape, 30.0, 2.0 * (shape == "square"), axis=(0.05, 0.02, -1.0), centre=(0, 0, 3.0))
    times = np.array([0.0, 4.0, 6.0, 10.0])
    across = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 0.5], [1.0, 0.5]])
    history = History(times, np.array([0.0, 4.0, 4.0, 0.0]), across)
    problem = punch(element, 2, 1, indenter=tool, friction=mu, sticking=sticking, history=history)
    assert not check_sensitivities(problem, tight, 1e-3).doubts


def test_friction_that_is_none_is_refused():
    for friction in ("rough", -0.1, float("nan"), float("inf"), True):
        with pytest.raises(ProblemError, match="unknown friction"):
            solve(punch("tet4", 2, 1, friction=friction))
    with pytest.raises(ProblemError, match="unknown law of sticking 'glued'"):
        solve(punch("tet4", 2, 1, friction=0.3, sticking="glued"))


def test_a_move_across_needs_two_numbers_for_each_time():
    with pytest.raises(ProblemError, match="across"):
        History(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.zeros((2, 3)))


def partial_slip(mu: float, radius: float, depth: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Drag (mm) and force across (N) of a ball on a half-space from sticking to slipping; its normal force
    and its contact radius.  Half of it is solved, to 100 contact radii away."""
    a = np.sqrt(radius * depth)
    near, far = np.linspace(0.0, 1.32, 12), np.array([1.6, 2.1, 3.0, 4.5, 7.0, 12.0, 22.0, 45.0, 100.0])
    lines = a * np.concatenate([near, far])
    z = a * np.array([0.0, 0.1, 0.2, 0.32, 0.46, 0.65, 0.9, 1.3, 1.9, 2.9, 4.5, 7.0, 12.0, 22.0, 45.0, 100.0])
    mesh = block("hex8", np.concatenate([-lines[:0:-1], lines]), lines, -z[::-1])
    X = mesh.points
    far_off = np.flatnonzero((np.abs(X[:, :2]) > lines[-1] - 1e-9).any(axis=1) | (X[:, 2] < 1e-9 - z[-1]))
    middle = (Support(np.flatnonzero(np.abs(X[:, 1]) < 1e-9), 1),)
    law, limit = NeoHookean(0.01), 1.5 * mu * depth
    history = History(
        np.array([0.0, 1.0, 2.0]), np.array([0.0, depth, depth]),
        np.array([[0.0, 0.0], [0.0, 0.0], [1.2 * limit, 0.0]]),
    )  # fmt: skip
    tool = Indenter("sphere", 2.0 * radius, axis=(0, 0, -1), edge=(1, 0, 0))
    problem = Problem(
        mesh, {"skin": law, "muscle": law}, far_off, mesh.face_sets["top"], tool, history, supports=middle,
        friction=mu, start="as-given", contact_rule="nodes",
    )  # fmt: skip
    result = solve(problem, StepControl(times=(0.5, 1.0, *np.linspace(1.1, 2.0, 10)), penalty=2000.0))
    assert result.completed, result.reason
    drag = np.array([np.interp(t, history.times, history.across[:, 0]) for t in result.times])[2:]
    return drag, 2.0 * result.reaction[2:, 0], 2.0 * result.force[2], a


@pytest.mark.slow
def test_partial_slip_of_a_ball_is_that_of_cattaneo_and_mindlin():
    """Johnson, Contact Mechanics, eq. 7.42, of a rigid ball on a half-space:
    ``drag = 3 mu P (2 - nu) / (16 a G) (1 - (1 - Q / (mu P))^(2/3))``, full slip beyond."""
    mu, G, nu = 0.3, 0.01, (3 * 100.0 - 2) / (2 * (3 * 100.0 + 1))
    drag, Q, P, a = partial_slip(mu, 100.0, 0.04)
    limit = 3 * mu * P * (2 - nu) / (16 * a * G)
    expected = mu * P * (1.0 - np.maximum(1.0 - drag / limit, 0.0) ** 1.5)
    assert drag[-1] > limit
    np.testing.assert_allclose(Q, expected, atol=0.03 * mu * P)


def test_iterations_that_lead_nowhere_count_and_a_step_keeps_to_the_bound():
    """A tolerance that rounding never meets: friction's own search fails again and again in one step."""
    most = 20
    across = np.array([[0.0, 0.0], [0.0, 0.0], [6.0, 0.0]])
    history = History(np.array([0.0, 1.0, 2.0]), np.array([0.0, 4.0, 4.0]), across)
    problem = replace(punch("hex8", 2, 1), history=history, friction=0.5)
    found = solve(problem, StepControl(times=(1.0, 2.0), tolerance=1e-15, most_iterations=most))
    assert found.reason.endswith(f"no more than {most} Newton iterations were allowed")
    assert found.statistics["newton_iterations"] <= most


def test_points_that_stick_slip_and_turn_round_are_found_in_few_iterations():
    """On a skin so soft that it slips within a ten-thousandth of a mm.

    With the second derivative alone it takes 217 iterations, and where every step has to lower the residual,
    which rises first, 27 lead nowhere.
    """
    laws = {"skin": OgdenQLV(1e-4, 10.0, 0.2, 1.0), "muscle": OgdenQLV(4.5e-3, 11.0, 0.05, 0.3)}
    problem = punch("hex8", 2, 1, 2.0, z=FINE_Z, friction=0.3, materials=laws)
    run = SteppedRun(problem, StepControl(), False, None)
    assert len(list(run.run())) == 18
    assert not run.reason
    assert run.counts["newton_iterations"] <= 150
    assert run.counts["vain_iterations"] <= 9


def test_the_tangent_of_slip_is_convex_whatever_its_dual():
    one = Dragged("gauss")
    pulls = one.rng.normal(size=one.grip.pulls.shape) * one.grip.bounds.max()
    led = replace(one.grip, pulls=pulls)
    here, exact = one.at(one.u, grip=led), one.at(one.u)
    assert here.energy == exact.energy
    np.testing.assert_array_equal(here.residual, exact.residual)
    stick = here.touch.stick
    assert np.abs(stick - exact.touch.stick).max() > 0.1 * np.abs(exact.touch.stick).max()
    assert np.linalg.eigvalsh(stick).min() > -1e-12 * np.abs(stick).max()


def test_the_dual_foreseen_is_the_slip_that_comes():
    """To first order, and never beyond the bound."""
    one = Dragged("gauss")
    d = one.field(1.0)

    def missed(h: float) -> float:
        come = one.grip.predict(one.tool(one.u + h * d), 0.0 * d).pulls
        return float(np.abs(one.grip.predict(one.tool(one.u), h * d).pulls - come).max())

    assert missed(1e-5) < 0.02 * missed(1e-4)
    far = one.grip.predict(one.tool(one.u), d)
    assert (np.linalg.norm(far.pulls, axis=-1) <= far.bounds * (1.0 + 1e-12)).all()
